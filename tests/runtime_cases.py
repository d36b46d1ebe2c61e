"""Helpers for tests of the C++ runtime: they compile C++ files and convert arrays for C."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np
from target_cases import stacked

from nma.native.runtime import available
from nma.target import Principled

HERE = Path(__file__).parent
# The count of numbers in a Principled BRDF. The colour is one field of `Principled` but has three numbers.
PRINCIPLED_SIZE = len(Principled._fields) + 2
FLAGS = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2", f"-I{HERE.parent / 'runtime'}"]


def built(compiler, name, folder, *flags):
    """Compiles the C++ file `name` of this folder, and returns it as a loaded shared library."""
    path = folder / f"{name}.so"
    subprocess.run([compiler, *FLAGS, *flags, "-shared", "-fPIC", HERE / name, "-o", path], check=True)
    return ctypes.CDLL(str(path))


def pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


def rows(v):
    """Converts a `Vec3` of arrays (n,) to an array (n, 3)."""
    return np.ascontiguousarray(stacked(v).T)


def facing(cosines):
    """Returns directions (n, 3) at azimuth 0 with the given cosines (n,)."""
    return np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)


def in_single_precision():
    """Lists the instruction sets of this CPU in which the runtime computes with float32."""
    return [name for name in available() if name != "avx512_bf16"]
