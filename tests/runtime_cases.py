"""What tests of the C++ runtime share: bridges to it, and arrays as C takes them."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np
from target_cases import stacked

from nma.native.runtime import available

HERE = Path(__file__).parent
FLAGS = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", f"-I{HERE.parent / 'runtime'}"]


def built(compiler, name, folder, *flags):
    """The file `name` beside this one as a shared library."""
    path = folder / f"{name}.so"
    subprocess.run([compiler, *FLAGS, *flags, "-shared", "-fPIC", HERE / name, "-o", path], check=True)
    return ctypes.CDLL(str(path))


def pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


def rows(v):
    """A `Vec3` of arrays as rows (n, 3)."""
    return np.ascontiguousarray(stacked(v).T)


def facing(cosines):
    """Directions (n, 3) at azimuth 0."""
    return np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)


def in_single_precision():
    """Instruction sets of this CPU that compute in float32."""
    return [name for name in available() if name != "avx512_bf16"]
