"""Converts between three forms of a blend: raw network outputs, a `Blend`, and a flat list of numbers.

All lists have the same order: the parameters of instance 1, of instance 2, and so on, then all weights of the blend
except the last. The parameters' ranges are stored in weights files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from nma import ops
from nma.errors import WeightsError
from nma.ops import Color, Float
from nma.target.blend import Blend
from nma.target.interface import Interface
from nma.target.principled import MIN_ALPHA, Principled

Scale = Literal["linear", "log"]
# `encode` keeps values this fraction of a range away from the ends of the range, because no finite raw output decodes
# to an end.
ENCODE_MARGIN = 1e-6


@dataclass(frozen=True)
class TargetParam:
    """A field of `Principled` that the network sets: its size, and the range to which raw outputs are decoded.

    For isotropic classes, the field `anisotropic` may be `in_plane`; no other field may. The x axis of the lobes then
    lies in the plane of incidence (`nma.target.plane`), and the field is multiplied by sin^2(theta_i), because the
    plane of incidence is not defined at normal incidence.
    """

    name: str
    size: int = 1
    low: float = 0.0
    high: float = 1.0
    scale: Scale = "linear"
    in_plane: bool = False

    def decode(self, raw: Float) -> Float:
        """Maps any real number to the range by a sigmoid, which is scaled linearly or logarithmically."""
        unit = ops.sigmoid(raw)
        if self.scale == "log":
            return self.low * ops.exp(math.log(self.high / self.low) * unit)
        return self.low + (self.high - self.low) * unit

    def encode(self, value: Float) -> Float:
        """The inverse of `decode`. The value is first clipped away from the ends of the range, so that the result is
        finite."""
        if self.scale == "log":
            value = ops.maximum(value, self.low)
            return logit(ops.log(value * (1.0 / self.low)) * (1.0 / math.log(self.high / self.low)))
        return logit((value - self.low) * (1.0 / (self.high - self.low)))


# The paper's 11 parameters. The range of `specular` reaches an index of refraction of 2.1; Burley's range ends at 1.8.
# The smallest roughness is the square root of the smallest alpha.
PRINCIPLED_PARAMS: tuple[TargetParam, ...] = (
    TargetParam("base_color", size=3),
    TargetParam("roughness", low=math.sqrt(MIN_ALPHA), scale="log"),
    TargetParam("metallic"),
    TargetParam("specular", high=1.6),
    TargetParam("spec_tint"),
    TargetParam("sheen"),
    TargetParam("sheen_tint"),
    TargetParam("clearcoat"),
    TargetParam("clearcoat_gloss"),
)

# Isotropic materials may have lobes that are wider or narrower in the plane of incidence than a reflection's lobe, for
# example where light is refracted twice. The width of a lobe along the plane is 1/6.4 to 6.9 times its width across the
# plane.
STRETCHED_PARAMS = (*PRINCIPLED_PARAMS, TargetParam("anisotropic", low=-6.0, high=0.95, in_plane=True))

# Instances under an interface, whose width and index the class gives (`nma.target.interface`).
INTERFACE_PARAMS = (
    *(p for p in STRETCHED_PARAMS if p.name in ("base_color", "roughness", "metallic", "anisotropic")),
    TargetParam("flatness"),
    TargetParam("veil"),
    TargetParam("shift", low=-0.5, high=0.5),
)

# Measured materials need three more parameters. A fade is needed for RGL's measurements, for example. These
# measurements are zero where the half vector is tilted by more than about 70 degrees, which the instrument does not
# reach. A wide fade also changes the shape of the diffuse lobe.
MEASURED_PARAMS = (
    *STRETCHED_PARAMS,
    TargetParam("flatness"),
    TargetParam("fade", low=-0.3),
    TargetParam("fade_width", low=0.01, high=1.5, scale="log"),
)
# The parameters for measured anisotropic materials, whose lobes stretch along the x and y axes of the surface, not
# along the plane of incidence.
ANISOTROPIC_PARAMS = tuple(replace(p, in_plane=False) for p in MEASURED_PARAMS)

# Ranges on which fields of the Principled BRDF are defined; all other fields have the range 0 .. 1.
_LIMITS = {
    "specular": (0.0, 12.0),  # 12.5 would be a reflectance of 1, which no index of refraction has
    "anisotropic": (-1e6, 1.0),
    "fade": (-1.0, 1.0),
    "fade_width": (0.0, 1e6),
    "shift": (-1.0, 1e3),
}

TARGETS = {
    "principled": PRINCIPLED_PARAMS,
    "stretched": STRETCHED_PARAMS,
    "interface": INTERFACE_PARAMS,
    "measured": MEASURED_PARAMS,
    "anisotropic": ANISOTROPIC_PARAMS,
}


def params_to_json(params: Sequence[TargetParam]) -> list[dict[str, Any]]:
    """The parameters as JSON data for a weights file."""
    return [asdict(p) for p in params]


def params_from_json(data: Sequence[dict[str, Any]]) -> tuple[TargetParam, ...]:
    """The inverse of `params_to_json`. Raises `WeightsError` for parameters that this version does not support."""
    required = {"name", "size", "low", "high", "scale"}
    try:
        for entry in data:
            if missing := required - entry.keys():
                raise TypeError(f"{sorted(missing)[0]} is missing")
        params = tuple(TargetParam(**entry) for entry in data)
    except (TypeError, AttributeError) as e:
        raise WeightsError(
            f"Target parameters are malformed ({e}); the file needs another version of nma."
        ) from e
    for p in params:
        _check(p)
    names = [p.name for p in params]
    if "base_color" not in names or len(set(names)) < len(names):
        raise WeightsError(f"Target parameters {names} must have a base_color, and no name twice.")
    return params


def _check(p: TargetParam) -> None:
    """Raises `WeightsError` for a parameter that `Principled` does not have, or for a range on which the parameter is
    not defined."""
    size = 3 if p.name == "base_color" else 1
    if p.name not in Principled._fields or type(p.size) is not int or p.size != size:
        raise WeightsError(
            f"Target parameter {p} has a wrong name or size; allowed names are {Principled._fields}."
        )
    if type(p.in_plane) is not bool or (p.in_plane and p.name != "anisotropic"):
        raise WeightsError(f"Target parameter {p} cannot be `in_plane`; only `anisotropic` can.")
    if type(p.low) not in (int, float) or type(p.high) not in (int, float):
        raise WeightsError(f"Target parameter {p} has a range whose ends are not numbers.")
    low, high = limits(p.name)
    scaled = p.scale == "linear" or (p.scale == "log" and p.low > 0)
    if not (scaled and low <= p.low < p.high <= high):
        raise WeightsError(f"Target parameter {p} has no valid range within {low:g} .. {high:g}.")


def needs_interface(params: Sequence[TargetParam]) -> bool:
    """Whether the parameters have a meaning only under an interface."""
    return any(p.name in ("veil", "shift") for p in params)


def limits(field: str) -> tuple[float, float]:
    """The range on which a field of `Principled` is defined. The range of the field's `TargetParam` must lie within
    this range."""
    return _LIMITS.get(field, (0.0, 1.0))


def instance_size(params: Sequence[TargetParam] = PRINCIPLED_PARAMS) -> int:
    """The count of numbers that describe an instance: 11 for the paper's parameters."""
    return sum(p.size for p in params)


def output_size(n_instances: int, params: Sequence[TargetParam] = PRINCIPLED_PARAMS) -> int:
    """The count of numbers that describe a blend of `n_instances` instances, including n_instances - 1 weights. The
    paper's blend of two instances has 23 numbers."""
    return n_instances * instance_size(params) + n_instances - 1


def logit(unit: Float) -> Float:
    """The inverse of the sigmoid, clipped to finite values."""
    u = ops.clip(unit, ENCODE_MARGIN, 1.0 - ENCODE_MARGIN)
    return ops.log(u / (1.0 - u))


def decode(
    raw: Sequence[Float],
    n_instances: int,
    params: Sequence[TargetParam] = PRINCIPLED_PARAMS,
    cos_theta_i: Float = 0.0,
    interface: Interface | None = None,
) -> Blend:
    """Converts raw network outputs, `output_size` of them, to a blend. `Adapter.decode` calls this function.

    The weights come from stick-breaking: each weight is a fraction of the remainder that the previous weights leave of
    1, and the last weight is the final remainder. `cos_theta_i` is used for parameters that are `in_plane`. `interface`
    is the interface above the instances, if there is one.
    """
    size = instance_size(params)
    instances = tuple(
        _instance(_decoded(raw[k * size : (k + 1) * size], params, cos_theta_i), params)
        for k in range(n_instances)
    )
    left: Float = 1.0
    weights = []
    for x in raw[n_instances * size : output_size(n_instances, params)]:
        share = ops.sigmoid(x)
        weights.append(left * share)
        left = left * (1.0 - share)
    return Blend(instances, (*weights, left), interface=interface)


def encode(blend: Blend, params: Sequence[TargetParam] = PRINCIPLED_PARAMS) -> list[Float]:
    """Raw outputs that `decode` converts to nearly this blend, for example as the start of a fit."""
    raw: list[Float] = []
    for p in blend.instances:
        for param in params:
            value = getattr(p, param.name)
            raw += [param.encode(v) for v in (value if param.size > 1 else (value,))]
    left: Float = 1.0
    for weight in blend.weights[:-1]:
        raw.append(logit(weight / ops.maximum(left, ENCODE_MARGIN)))
        left = left - weight
    return raw


def numbers(blend: Blend, params: Sequence[TargetParam] = PRINCIPLED_PARAMS) -> list[Float]:
    """The blend as a flat list: all parameters, then all weights except the last, then the two numbers of the interface
    if there is one. The list does not contain `scale`.

    `Adapter.numbers` and the curves of `nma.render` call this function. The curves can interpolate the flat lists,
    because every convex combination of flat lists describes a valid blend.
    """
    flat: list[Float] = []
    for p in blend.instances:
        for param in params:
            value = getattr(p, param.name)
            flat += list(value) if param.size > 1 else [value]
    return flat + list(blend.weights[:-1]) + list(blend.interface or ())


def from_numbers(
    flat: Sequence[Float], params: Sequence[TargetParam] = PRINCIPLED_PARAMS, under_interface: bool = False
) -> Blend:
    """The inverse of `numbers`, except that `scale` is 1. `Adapter.from_numbers` calls this function, and then computes
    `scale` again if the adapter is bounded.

    The number of instances follows from the length of the list. With `under_interface`, the last two numbers are those
    of the interface.
    """
    interface = None
    if under_interface:
        flat, interface = flat[:-2], Interface(*flat[-2:])
    size = instance_size(params)
    n = (len(flat) + 1) // (size + 1)
    if n < 1 or len(flat) != output_size(n, params):
        raise WeightsError(
            f"{len(flat)} numbers do not describe a blend: n instances need {size} numbers each, and n - 1 weights."
        )
    instances = tuple(_instance(flat[k * size : (k + 1) * size], params) for k in range(n))
    weights = tuple(flat[n * size :])
    return Blend(instances, (*weights, 1.0 - sum(weights)), interface=interface)


def _decoded(raw: Sequence[Float], params: Sequence[TargetParam], cos_theta_i: Float) -> list[Float]:
    ranges = [p for p in params for _ in range(p.size)]
    values = [p.decode(x) for p, x in zip(ranges, raw, strict=True)]
    fade = 1.0 - cos_theta_i * cos_theta_i
    return [v * fade if p.in_plane else v for p, v in zip(ranges, values, strict=True)]


def _instance(values: Sequence[Float], params: Sequence[TargetParam]) -> Principled:
    """An instance from its numbers; fields that are not in `params` are 0."""
    fields: dict[str, Any] = dict.fromkeys(Principled._fields, 0.0)
    first = 0
    for p in params:
        fields[p.name] = Color(*values[first : first + 3]) if p.size == 3 else values[first]
        first += p.size
    return Principled(**fields)
