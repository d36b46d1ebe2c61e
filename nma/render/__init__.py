"""Rendering in Mitsuba 3. Importing this package makes its BSDFs `nma` and `layered` known there:

    import mitsuba as mi
    import nma.render

    mi.set_variant("llvm_ad_rgb")

They exist in the variant in use and in every one chosen later, so the order of these lines does not matter.
"""

from __future__ import annotations

import contextlib

from nma.errors import MissingDependencyError, ParamError
from nma.llvm import ensure_llvm
from nma.native import build
from nma.render import register as _plugins

__all__ = ["use"]

# Mitsuba loads Dr.Jit, which then wants its libLLVM chosen. Where there is none, scalar_rgb and GPUs remain.
with contextlib.suppress(MissingDependencyError):
    ensure_llvm()
_plugins.register()


def use(variant: str = "auto") -> str:
    """Choose Mitsuba's variant, and return its name.

    Args:
        variant: one of `mi.variants()`, or "auto": cuda_ad_rgb where there is an NVIDIA GPU, else llvm_ad_rgb. The
            plugins for scalar_rgb are compiled when it is first chosen. Our BSDFs run in these three.

    Raises:
        ParamError: Mitsuba has no such variant.
        MissingDependencyError: the variant needs libLLVM, and it is missing or too old; or a C++ compiler, or an
            NVIDIA GPU.
    """
    import drjit as dr
    import mitsuba as mi

    if variant == "auto":
        variant = "cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"
    if variant not in mi.variants():
        raise ParamError(f"Mitsuba has no variant {variant!r}; it has {', '.join(mi.variants())}")
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise MissingDependencyError(
            f"{variant} needs an NVIDIA GPU and its driver, `nma doctor` says what is missing; llvm_ad_rgb needs none"
        )
    if variant.startswith("llvm"):
        ensure_llvm()
    if variant == "scalar_rgb":
        build.build_mitsuba()
    mi.set_variant(variant)
    return variant
