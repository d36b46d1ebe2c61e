"""What the peers share: a GGX lobe, its directional albedo by quadrature, and curves over cos(theta_i).

Directions follow CONVENTIONS.md: wi is the view. Masking is separable, as in the class `layered3`. No peer adds light
for multiple scattering between microfacets, because the walks of `layered3` have none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import nma
from nma import microfacet, ops
from nma.ops import Color, Float, Vec3
from nma.sources.lookup import Lookup

# The number of cosines at which a curve is known, and of visible normals in the quadrature (half the azimuths).
NODES = 256
_AZIMUTHS, _HEIGHTS = 16, 64
COSINES = (np.arange(NODES) + 0.5) / NODES


class Visible(NamedTuple):
    """Reflections at visible normals, (points, cosines): cos(theta) at the facet, cos(theta_o), and their weights."""

    facet: NDArray
    out: NDArray
    weight: NDArray


class Layered3(NamedTuple):
    """The parameters of a material of the class `layered3`."""

    alpha_top: float
    alpha_bottom: float
    eta_top: float
    eta: Color
    k: Color
    albedo: Color
    sigma_t: float


def given(params: NDArray[np.float64]) -> Layered3:
    """Returns the parameters of a material from its vector (13,)."""
    part = {name: params[columns].tolist() for name, columns in nma.LAYERED3.slices.items()}
    return Layered3(
        alpha_top=part["alpha_top"][0],
        alpha_bottom=part["alpha_bottom"][0],
        eta_top=part["eta_top"][0],
        eta=Color(*part["eta_conductor"]),
        k=Color(*part["k_conductor"]),
        albedo=Color(*part["albedo"]),
        sigma_t=part["sigma_t"][0],
    )


def visible(cosines: ArrayLike, alpha: ArrayLike) -> Visible:
    """Returns reflections of light from `cosines` at normals of width `alpha`; the mean weight is the albedo.

    The lobe is symmetric about the plane of incidence, so that half the azimuths are enough.
    """
    wi = ops.at_azimuth_0(np.asarray(cosines, np.float64))
    alpha = np.asarray(alpha, np.float64) + 0.0 * wi.z
    u1, u2 = np.meshgrid(
        0.5 * (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS, (np.arange(_HEIGHTS) + 0.5) / _HEIGHTS
    )
    m = microfacet.sample_visible_normal(wi, alpha, alpha, u1.reshape(-1, 1), u2.reshape(-1, 1))
    facet = np.clip(ops.dot(wi, m), 0.0, 1.0)
    wo = microfacet.reflect(wi, m)
    weight = np.where(wo.z > 0, microfacet.smith_g1(wo, alpha, alpha), 0.0)
    return Visible(facet, wo.z, weight)


def albedo(
    cosines: ArrayLike, alpha: ArrayLike, fresnel: Callable[[NDArray], NDArray] = np.ones_like
) -> NDArray:
    """Returns the directional albedo (cosines,) of a lobe with the Fresnel reflectance `fresnel(cosine)`."""
    seen = visible(cosines, alpha)
    return np.mean(fresnel(seen.facet) * seen.weight, axis=0)


def ggx(wi: Vec3, wo: Vec3, m: Vec3, alpha: Float) -> Float:
    """Returns D G / (4 cos(theta_i)): f cos(theta_o) of a lobe whose Fresnel reflectance is 1 (Walter 2007, eq. 20)."""
    masking = microfacet.smith_g1(wi, alpha, alpha) * microfacet.smith_g1(wo, alpha, alpha)
    return microfacet.ggx_d(m, alpha, alpha) * masking / (4.0 * ops.maximum(wi.z, 1e-7))


class Curves:
    """Numbers that depend on cos(theta_i), known at COSINES (NODES, channels), and linear between them."""

    def __init__(self, values: NDArray):
        self._lookup = Lookup(values, (False,))

    def at(self, cosine: Float) -> list[Float]:
        """Returns a number per channel and Dr.Jit lane."""
        return self._lookup.linear([cosine * float(NODES)])
