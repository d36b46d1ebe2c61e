"""Imports Dr.Jit with a libLLVM that is new enough. Modules that always need Dr.Jit import `dr` from here.

Dr.Jit loads a libLLVM when it is first imported. A libLLVM that is too old kills the process when the first kernel is
compiled, so this module chooses a new libLLVM before it imports Dr.Jit. If there is no usable libLLVM and no GPU for
Dr.Jit, importing this module raises `MissingDependencyError`.
"""

import ctypes
import os

from nma.errors import MissingDependencyError
from nma.llvm import ensure_llvm

__all__ = ["dr"]


def _has_gpu() -> bool:
    """Whether Dr.Jit can run on a GPU and so needs no libLLVM.

    This function looks for a driver before it imports Dr.Jit, because importing Dr.Jit without libLLVM prints a warning
    to stderr.
    """
    try:
        ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1")
    except OSError:
        return False
    import drjit

    return bool(drjit.has_backend(drjit.JitBackend.CUDA))


try:
    ensure_llvm()
except MissingDependencyError:
    if not _has_gpu():
        raise

import drjit as dr  # noqa: E402
