"""The analytic BRDF that adapters drive: a blend of Principled BRDFs, written once for every array library."""

from nma.target.blend import Blend, eval, lobe_alphas
from nma.target.decode import (
    PRINCIPLED_PARAMS,
    TargetParam,
    decode,
    encode,
    from_numbers,
    numbers,
    output_size,
)
from nma.target.principled import Principled, eval_principled

__all__ = [
    "PRINCIPLED_PARAMS",
    "Blend",
    "Principled",
    "TargetParam",
    "decode",
    "encode",
    "eval",
    "eval_principled",
    "from_numbers",
    "lobe_alphas",
    "numbers",
    "output_size",
]
