"""Encodings of the network's inputs: each encoding converts a class's parameters and the view direction to numbers of
about unit size.

Encodings are written with `nma.ops`, so training and rendering run the same code. Weights files store the name of the
encoding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from nma import ops
from nma.errors import ParamError, WeightsError, shown
from nma.microfacet import fresnel_conductor, fresnel_dielectric
from nma.ops import Float, Vec3
from nma.params import LAYERED3, ParamSpace

# An encoder takes one array per parameter column and the view direction, which is None for adapters that ignore it.
# Isotropic encodings use only wi.z, which is cos(theta_i).
Encoder = Callable[[Sequence[Float], Vec3 | None], list[Float]]

# The cosine of 84 degrees, near which the reflectance of metals has a minimum before it rises to 1.
GRAZING = 0.1045
# Cosines of the refracted direction that are smaller than MIN_COS_T are replaced by MIN_COS_T.
MIN_COS_T = 0.05


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


def layered3(columns: Sequence[Float], wi: Vec3 | None) -> list[Float]:
    """Physical quantities of a coated conductor, all scaled to [-1, 1].

    The quantities are the coat's refractive index, the medium's optical depth and albedo, the conductor's reflectance
    inside the coat at normal incidence and at 84 degrees, and the logarithm of each microfacet width. With the view
    direction, there are also cos(theta_i), the coat's Fresnel reflectance at wi, and the medium's transmittance along
    the refracted direction.
    """
    alpha_top, alpha_bottom, eta_top, *rest = columns
    eta, k, albedo, sigma_t = rest[0:3], rest[3:6], rest[6:9], rest[9]
    ranged = (
        ("alpha_top", alpha_top),
        ("alpha_bottom", alpha_bottom),
        ("eta_top", eta_top),
        ("sigma_t", sigma_t),
    )
    unit = [LAYERED3[name].normalise(x) for name, x in ranged]
    for cosine in (1.0, GRAZING):
        unit += [fresnel_conductor(cosine, e / eta_top, x / eta_top) for e, x in zip(eta, k, strict=True)]
    unit += albedo
    if wi is not None:
        # Below the horizon, where nothing is reflected, the reflectance at the horizon is used, because the formula
        # might divide by zero.
        fresnel, cos_t = fresnel_dielectric(ops.maximum(wi.z, 0.0), eta_top)
        unit += [wi.z, fresnel, ops.exp(-sigma_t / ops.maximum(cos_t, MIN_COS_T))]
    return [2.0 * x - 1.0 for x in unit]


ENCODERS: dict[str, Encoder] = {
    "raw": raw,
    "direction": direction,
    "azimuth": azimuth,
    "layered3": layered3,
}
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


def size(name: str, space: ParamSpace, directional: bool) -> int:
    """The number of inputs of a network for this class and encoding, with the view direction if `directional` is
    true."""
    return len(get(name)([0.5] * space.size, ops.at_azimuth_0(0.5) if directional else None))
