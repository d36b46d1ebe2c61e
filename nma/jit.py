"""Dr.Jit, loaded with a libLLVM that it survives: modules of this package take `dr` from here.

Dr.Jit chooses its libLLVM when it is first imported, and an old one kills the process at the first kernel. So the
choice stands here, before that import. Without a usable libLLVM importing this module raises
`MissingDependencyError`, unless Dr.Jit computes on a GPU.
"""

import ctypes
import os

from nma.errors import MissingDependencyError
from nma.llvm import ensure_llvm

__all__ = ["dr"]


def _has_gpu() -> bool:
    """Whether Dr.Jit can do without libLLVM. Looks for a driver first, since Dr.Jit's import complains on stderr."""
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
