"""A Principled BRDF as Mitsuba's own plugin `principled`: a dictionary for `mi.load_dict`, or XML."""

from __future__ import annotations

from typing import Any

from nma.errors import ParamError
from nma.target.principled import Principled, specular_eta

# Mitsuba's names are ours. `specular` may become `eta`.
_FIELDS = (
    *("roughness", "metallic", "specular", "spec_tint", "sheen", "sheen_tint"),
    *("clearcoat", "clearcoat_gloss", "anisotropic", "flatness"),
)
# Significant digits: about those of single precision, in which Mitsuba reads them.
_DIGITS = 7
# What `specular` and `eta` say for a dielectric without reflection: at an eta of 1, Mitsuba 3.9 drops metals, too.
_MIN_SPECULAR, _MIN_ETA = 1e-6, 1.00001


def principled_dict(p: Principled) -> dict[str, Any]:
    """The dictionary of `p`, whose parameters are plain numbers.

    It is one-sided, as Mitsuba's plugin is without `spec_trans`; wrap it in `twosided` for surfaces seen from behind.
    A `specular` above 1, where Mitsuba's ends, or of 0, for which Mitsuba leaves out metals, too, is written as the
    `eta` with the same reflectance. The plugin evaluates to what `nma.target.eval_principled` does, but for the
    differences in the head of nma/target/principled.py. Raises `ParamError` for parameters that it does not have or
    allow.
    """
    values = {name: float(getattr(p, name)) for name in _FIELDS}
    base_color = [float(c) for c in p.base_color]
    unknown = set(p._fields) - {"base_color", *_FIELDS}
    if used := sorted(name for name in unknown if float(getattr(p, name)) != 0.0):
        raise ParamError(f"Mitsuba's principled has no {', '.join(used)}; set to 0 what it shall do without")
    for name, value in (*values.items(), *(("base_color", c) for c in base_color)):
        # From 12.5 on there is no such index of refraction.
        high = 12.0 if name == "specular" else 1.0
        if not 0.0 <= value <= high:
            raise ParamError(f"{name} is {value:g}, Mitsuba's principled allows 0 .. {high:g}")
    specular = values["specular"]
    if not _MIN_SPECULAR <= specular <= 1.0:
        del values["specular"]
        values["eta"] = max(float(specular_eta(specular)), _MIN_ETA)
    colour = {"type": "rgb", "value": [_rounded(c) for c in base_color]}
    return {"type": "principled", "base_color": colour} | {k: _rounded(v) for k, v in values.items()}


def principled_xml(p: Principled) -> str:
    """The same as an XML file whose outermost element is <bsdf>."""
    description = principled_dict(p)
    lines = [f'<bsdf version="3.0.0" type="{description.pop("type")}">']
    colour = " ".join(map(repr, description.pop("base_color")["value"]))
    lines.append(f'    <rgb name="base_color" value="{colour}"/>')
    lines += [f'    <float name="{key}" value="{value!r}"/>' for key, value in description.items()]
    return "\n".join((*lines, "</bsdf>", ""))


def _rounded(x: float) -> float:
    return float(f"{x:.{_DIGITS}g}")
