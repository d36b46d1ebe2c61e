"""Decodes, evaluates and samples the analytic BRDF whose parameters the networks output.

The analytic BRDF is a blend of Principled BRDFs, on Dr.Jit, JAX or NumPy arrays.
"""

from nma.target.blend import Blend, bounded, eval, eval_pdf, lobe_alphas, pdf, sample
from nma.target.brdf import Brdf
from nma.target.decode import (
    ANISOTROPIC_PARAMS,
    INTERFACE_PARAMS,
    MEASURED_PARAMS,
    PRINCIPLED_PARAMS,
    STRETCHED_PARAMS,
    TARGETS,
    TargetParam,
    decode,
    encode,
    from_numbers,
    needs_interface,
    numbers,
    output_size,
)
from nma.target.interface import Interface
from nma.target.plane import Plane
from nma.target.principled import Principled, eval_principled

__all__ = [
    "ANISOTROPIC_PARAMS",
    "INTERFACE_PARAMS",
    "MEASURED_PARAMS",
    "PRINCIPLED_PARAMS",
    "STRETCHED_PARAMS",
    "TARGETS",
    "Blend",
    "Brdf",
    "Interface",
    "Plane",
    "Principled",
    "TargetParam",
    "bounded",
    "decode",
    "encode",
    "eval",
    "eval_pdf",
    "eval_principled",
    "from_numbers",
    "lobe_alphas",
    "needs_interface",
    "numbers",
    "output_size",
    "pdf",
    "sample",
]
