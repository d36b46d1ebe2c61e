"""Describes one Principled BRDF with constant parameters for Mitsuba's own plugin `principled`.

The description is a dictionary for `mi.load_dict`, or XML. The plugins that evaluate adapters are in `nma.render`.
"""

from __future__ import annotations

import json
from typing import Any

from nma.errors import ParamError
from nma.target.principled import Principled, specular_eta

# The parameters of `Principled` that have the same names in Mitsuba. `principled_dict` may replace `specular` by `eta`.
_FIELDS = (
    *("roughness", "metallic", "specular", "spec_tint", "sheen", "sheen_tint"),
    *("clearcoat", "clearcoat_gloss", "anisotropic", "flatness"),
)
# The number of significant digits that are written. Mitsuba reads numbers in single precision, which holds about 7
# digits.
_DIGITS = 7
# A `specular` below _MIN_SPECULAR counts as 0 and describes a dielectric without reflection. The `eta` of such a
# dielectric is set to _MIN_ETA instead of 1, because with `eta` 1, Mitsuba 3.9 leaves out the reflection of metals,
# too.
_MIN_SPECULAR, _MIN_ETA = 1e-6, 1.00001


def principled_dict(p: Principled) -> dict[str, Any]:
    """The dictionary that describes `p`. The parameters of `p` must be plain numbers.

    Without `spec_trans`, Mitsuba's plugin is one-sided. Wrap the BSDF in `twosided` for surfaces seen from behind. The
    plugin returns the same values as `nma.target.eval_principled`, with the exceptions listed at the top of
    nma/target/principled.py.

    `specular` is replaced by the `eta` with the same reflectance in two cases: if `specular` is above 1, which is
    Mitsuba's limit, and if `specular` is 0, because Mitsuba then leaves out the reflection of metals. Raises
    `ParamError` for parameters that Mitsuba's plugin does not have, and for values that Mitsuba does not allow.
    """
    values = {name: float(getattr(p, name)) for name in _FIELDS}
    base_color = [float(c) for c in p.base_color]
    unknown = set(p._fields) - {"base_color", *_FIELDS}
    if used := sorted(name for name in unknown if float(getattr(p, name)) != 0.0):
        raise ParamError(f"Mitsuba's principled has no {', '.join(used)}; set it to 0")
    for name, value in (*values.items(), *(("base_color", c) for c in base_color)):
        # `specular` is 12.5 for an infinite index of refraction, so values from 12.5 on have no `eta`.
        high = 12.0 if name == "specular" else 1.0
        if not 0.0 <= value <= high:
            raise ParamError(f"{name} is {value:g}, but Mitsuba's principled allows 0 .. {high:g}")
    specular = values["specular"]
    if not _MIN_SPECULAR <= specular <= 1.0:
        del values["specular"]
        values["eta"] = max(float(specular_eta(specular)), _MIN_ETA)
    colour = {"type": "rgb", "value": [_rounded(c) for c in base_color]}
    return {"type": "principled", "base_color": colour} | {k: _rounded(v) for k, v in values.items()}


def principled_xml(p: Principled) -> str:
    """`principled_dict` as the text of an XML file whose outermost element is <bsdf>."""
    description = principled_dict(p)
    lines = [f'<bsdf version="3.0.0" type="{description.pop("type")}">']
    colour = " ".join(map(repr, description.pop("base_color")["value"]))
    lines.append(f'    <rgb name="base_color" value="{colour}"/>')
    lines += [f'    <float name="{key}" value="{value!r}"/>' for key, value in description.items()]
    return "\n".join((*lines, "</bsdf>", ""))


def principled_json(p: Principled) -> str:
    """`principled_dict` as the text of a JSON file."""
    return json.dumps(principled_dict(p), indent=2) + "\n"


def _rounded(x: float) -> float:
    return float(f"{x:.{_DIGITS}g}")
