"""Encodings of the network's inputs: each encoding converts a class's parameters and the view direction to numbers of
about unit size.

Encodings are written with `nma.ops`, so training and rendering run the same code. Weights files store the name of the
encoding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from nma import ops
from nma.errors import ParamError, WeightsError, shown
from nma.microfacet import fresnel_conductor, fresnel_dielectric
from nma.ops import Float, Vec3
from nma.params import LAYERED3, ParamSpace
from nma.target.principled import MIN_ALPHA

# An encoder takes one array per parameter column and the view direction, which is None for adapters that ignore it.
# Isotropic encodings use only wi.z, which is cos(theta_i).
Encoder = Callable[[Sequence[Float], Vec3 | None], list[Float]]

# The cosine of 84 degrees, near which the reflectance of metals has a minimum before it rises to 1.
GRAZING = 0.1045
# Cosines of the refracted direction that are smaller than MIN_COS_T are replaced by MIN_COS_T.
MIN_COS_T = 0.05
# Estimates are clipped to LEAST_ESTIMATE .. 1 - LEAST_ESTIMATE. Their logits are divided by ESTIMATE_UNIT, so that they
# are of about unit size.
LEAST_ESTIMATE, ESTIMATE_UNIT = 0.01, 2.5


def raw(columns: Sequence[Float], wi: Vec3 | None) -> list[Float]:
    """The parameters unchanged, followed by cos(theta_i): the paper's input."""
    return [*columns] if wi is None else [*columns, wi.z]


def direction(columns: Sequence[Float], wi: Vec3 | None) -> list[Float]:
    """The input of an adapter for one material: cos(theta_i), scaled to [-1, 1], or the constant 1 without a
    direction."""
    return [1.0] if wi is None else [2.0 * wi.z - 1.0]


def azimuth(columns: Sequence[Float], wi: Vec3 | None) -> list[Float]:
    """The whole direction, for one anisotropic material: wi.z, and the cosine and sine of the azimuth and of its
    double. The cosines and sines are multiplied by a power of sin(theta_i), so that they are 0 at normal incidence,
    where the azimuth is not defined.
    """
    if wi is None:
        raise ParamError("the encoding 'azimuth' needs the view direction; set `directional` in the recipe")
    x, y, z = wi
    return [2.0 * z - 1.0, x, y, x * x - y * y, 2.0 * x * y]


def _scalars(alpha_top: Float, alpha_bottom: Float, eta_top: Float, sigma_t: Float) -> list[Float]:
    """The parameters of `layered3` that are one number, each mapped to [0, 1]."""
    names = ("alpha_top", "alpha_bottom", "eta_top", "sigma_t")
    values = (alpha_top, alpha_bottom, eta_top, sigma_t)
    return [LAYERED3[name].normalise(x) for name, x in zip(names, values, strict=True)]


def layered3(columns: Sequence[Float], wi: Vec3 | None) -> list[Float]:
    """Physical quantities of a coated conductor, all scaled to [-1, 1].

    The quantities are the coat's refractive index, the medium's optical depth and albedo, the conductor's reflectance
    inside the coat at normal incidence and at 84 degrees, and the logarithm of each microfacet width. With the view
    direction, there are also cos(theta_i), the coat's Fresnel reflectance at wi, and the medium's transmittance along
    the refracted direction.
    """
    alpha_top, alpha_bottom, eta_top, *rest = columns
    eta, k, albedo, sigma_t = rest[0:3], rest[3:6], rest[6:9], rest[9]
    unit = _scalars(alpha_top, alpha_bottom, eta_top, sigma_t)
    for cosine in (1.0, GRAZING):
        unit += [fresnel_conductor(cosine, e / eta_top, x / eta_top) for e, x in zip(eta, k, strict=True)]
    unit += albedo
    if wi is not None:
        # Below the horizon, where nothing is reflected, the reflectance at the horizon is used, because the formula
        # might divide by zero.
        fresnel, cos_t = fresnel_dielectric(ops.maximum(wi.z, 0.0), eta_top)
        unit += [wi.z, fresnel, ops.exp(-sigma_t / ops.maximum(cos_t, MIN_COS_T))]
    return [2.0 * x - 1.0 for x in unit]


def layered3_bounce(columns: Sequence[Float], wi: Vec3 | None) -> list[Float]:
    """Physical quantities of a coated conductor as in `layered3`, and estimates of two parameters of the first instance
    under the coat.

    The estimates are those of a single bounce: the light refracted into the coat, reflected by the conductor, and
    refracted out. They take the place of the reflectance at 84 degrees and of the transmittance, and need the view
    direction. Each estimate is the raw output that decodes to it, divided by `ESTIMATE_UNIT`.
    """
    if wi is None:
        raise ParamError(
            "the encoding 'layered3_bounce' needs the view direction; set `directional` in the recipe"
        )
    alpha_top, alpha_bottom, eta_top, *rest = columns
    eta = [e / eta_top for e in rest[0:3]]
    k = [x / eta_top for x in rest[3:6]]
    albedo, sigma_t = rest[6:9], rest[9]
    unit = _scalars(alpha_top, alpha_bottom, eta_top, sigma_t)
    unit += [fresnel_conductor(1.0, *index) for index in zip(eta, k, strict=True)]
    cos_theta_i = ops.maximum(wi.z, 0.0)
    fresnel, cos_t = fresnel_dielectric(cos_theta_i, eta_top)
    unit += [*albedo, cos_theta_i, fresnel]
    # The light crosses the interface twice, at about the same angle, and the medium along the refracted view, and then
    # upwards.
    crossed = (1.0 - fresnel) * ops.exp(-sigma_t * (1.0 / ops.maximum(cos_t, MIN_COS_T) + 1.0))
    base_color = [fresnel_conductor(cos_t, *index) * crossed for index in zip(eta, k, strict=True)]
    # Light that the interface refracts twice leaves a lobe that is wider than the conductor's. In slopes, the interface
    # of width alpha_top adds twice the square of (eta - 1) / (2 eta) alpha_top to the square of the conductor's width.
    bend = (eta_top - 1.0) / (2.0 * eta_top) * alpha_top
    alpha = ops.sqrt(alpha_bottom * alpha_bottom + 2.0 * bend * bend)
    # The raw output for a roughness is the logit of its position in the logarithmic range from sqrt(MIN_ALPHA) to 1.
    roughness = 1.0 - ops.log(alpha) * (1.0 / math.log(MIN_ALPHA))
    estimates = [ops.clip(x, LEAST_ESTIMATE, 1.0 - LEAST_ESTIMATE) for x in (*base_color, roughness)]
    logits = [ops.log(x / (1.0 - x)) * (1.0 / ESTIMATE_UNIT) for x in estimates]
    return [2.0 * x - 1.0 for x in unit] + logits


ENCODERS: dict[str, Encoder] = {
    "raw": raw,
    "direction": direction,
    "azimuth": azimuth,
    "layered3": layered3,
    "layered3_bounce": layered3_bounce,
}
# For encodings whose last inputs are estimates: the parameters of the first instance that they estimate.
ESTIMATES = {"layered3_bounce": ("base_color", "roughness")}
# The encoding of each class for targets under an interface.
UNDER_INTERFACE = {"layered3": "layered3_bounce"}
# SINGLE lists the encodings for a single material, which use only the direction. ANISOTROPIC lists the encodings that
# depend on the azimuth of the direction.
SINGLE = ("direction", "azimuth")
ANISOTROPIC = ("azimuth",)


def get(name: str) -> Encoder:
    """The encoder with this name. Raises `WeightsError` if this version has no such encoder."""
    if name not in ENCODERS:
        raise WeightsError(
            f"unknown input encoding {shown(name)}; this version has {', '.join(ENCODERS)}; upgrade the package"
        )
    return ENCODERS[name]


def of_class(space: ParamSpace, under_interface: bool) -> str:
    """The name of the encoding for a class, and for targets that lie under an interface or not."""
    if under_interface and space.name in UNDER_INTERFACE:
        return UNDER_INTERFACE[space.name]
    return space.name if space.name in ENCODERS else "raw"


def size(name: str, space: ParamSpace, directional: bool) -> int:
    """The number of inputs of a network for this class and encoding, with the view direction if `directional` is
    true."""
    return len(get(name)([0.5] * space.size, ops.at_azimuth_0(0.5) if directional else None))
