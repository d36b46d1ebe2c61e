"""Renders adapters, simulated materials and measurements in Mitsuba.

Importing this package registers the BSDF plugins `nma`, `layered` and `values`:

    import mitsuba as mi
    import nma.render

    mi.set_variant("llvm_ad_rgb")

The plugins are registered in the current variant and in every variant that is set later, so `nma.render` may be
imported before or after `mi.set_variant`.
"""

from __future__ import annotations

import contextlib

from nma.errors import MissingDependencyError, ParamError
from nma.llvm import ensure_llvm
from nma.native import build
from nma.render import register as _plugins

__all__ = ["use"]

# Mitsuba loads Dr.Jit, which then looks for libLLVM, so libLLVM must be chosen before Mitsuba is imported. Without
# libLLVM, scalar_rgb and the CUDA variants still work.
with contextlib.suppress(MissingDependencyError):
    ensure_llvm()
_plugins.register()


def use(variant: str = "auto") -> str:
    """Choose Mitsuba's variant and return its name.

    Args:
        variant: one of `mi.variants()`, or "auto", which means cuda_ad_rgb on a machine with an NVIDIA GPU, and
            otherwise llvm_ad_rgb. This package's BSDFs run in llvm_ad_rgb and cuda_ad_rgb. `nma` and `layered` also run
            in scalar_rgb, as plugins in C++ that are compiled when scalar_rgb is first chosen.

    Raises:
        ParamError: Mitsuba has no variant of this name.
        MissingDependencyError: the variant needs an NVIDIA GPU, a C++ compiler or libLLVM that this machine does not
            have, or libLLVM is too old.
    """
    import drjit as dr
    import mitsuba as mi

    if variant == "auto":
        variant = "cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"
    if variant not in mi.variants():
        raise ParamError(f"Mitsuba has no variant {variant!r}; it has {', '.join(mi.variants())}")
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise MissingDependencyError(
            f"{variant} needs an NVIDIA GPU and its driver; run `nma doctor` to see what is missing, or choose "
            "llvm_ad_rgb"
        )
    if variant.startswith("llvm"):
        ensure_llvm()
    if variant == "scalar_rgb":
        build.build_mitsuba()
    mi.set_variant(variant)
    return variant
