"""A rough metal under a clear or tinted coat, in closed form: the analytic coating model of production renderers.

The model is from Weidlich and Wilkie 2007, "Arbitrarily Layered Micro-Facet Surfaces". The model is the sum of two
microfacet reflections: the coat's reflection and the metal's reflection. The metal's reflection is evaluated for the
directions refracted at the mean surface. For each of the two directions, the metal's reflection is multiplied by the
Fresnel transmittance of the coat's surface, and by the transmittance of the absorbing coat. Light that bounces between
coat and metal is left out, so the model is darker than a simulation of the stack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nma import ops
from nma.conductors import load_conductors
from nma.errors import ParamError
from nma.microfacet import fresnel_conductor_rgb, fresnel_dielectric, ggx_d, smith_g1
from nma.ops import Color, Float, Vec3
from nma.params import LAYERED3

_WIDTHS = LAYERED3["alpha_top"].bounds("valid")


@dataclass(frozen=True)
class Coating:
    """The coating model (`Values`): a coat of refractive index `eta` (above 1) over the metal `conductor`.

    `alpha` and `alpha_metal` are the GGX widths of coat and metal, 1e-4 .. 1. `absorption` is the coat's optical depth
    at normal incidence, per channel, at least 0. Raises `ParamError` for a number outside its range, and for a metal
    that `nma.conductors` does not have.
    """

    conductor: str = "Au"
    alpha_metal: float = 0.3
    eta: float = 1.5
    alpha: float = 0.05
    absorption: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "coating"

    isotropic = True

    def __post_init__(self) -> None:
        if self.conductor not in load_conductors().names:
            raise ParamError(f"coating: there is no conductor '{self.conductor}'; try `Cu`, `Au` or `Al`")
        for what in ("alpha", "alpha_metal"):
            if _WIDTHS.bad(np.float64(getattr(self, what))):
                raise ParamError(f"coating: {_WIDTHS.refusal(what, getattr(self, what))}")
        if not self.eta > 1 or not all(0 <= a < np.inf for a in self.absorption):
            raise ParamError(
                f"coating: eta must be above 1 and absorption at least 0, got {self.eta} and {self.absorption}"
            )

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr]."""
        metals = load_conductors()
        row = metals.names.index(self.conductor)
        n, k = (Color(*(index[row] / self.eta).tolist()) for index in (metals.eta, metals.k))
        above = (wi.z > 1e-6) & (wo.z > 1e-6)
        i, o = (Vec3(w.x, w.y, ops.select(above, w.z, 1.0)) for w in (wi, wo))
        coat, fresnel = _lobe(i, o, self.alpha), fresnel_dielectric(_facing(i, o), self.eta)[0]
        (inside_i, loss_i), (inside_o, loss_o) = (_refracted(w, self.eta) for w in (i, o))
        metal = fresnel_conductor_rgb(_facing(inside_i, inside_o), n, k) * _lobe(
            inside_i, inside_o, self.alpha_metal
        )
        path = 1.0 / inside_i.z + 1.0 / inside_o.z
        # Where light leaves the coat, refraction multiplies the solid angle of a beam by eta^2 cos(inside) /
        # cos(outside), where inside and outside are the angles to the normal. So the metal's reflection is divided by
        # eta^2 cos(inside) / cos(outside).
        through = (1.0 - loss_i) * (1.0 - loss_o) * o.z / (self.eta * self.eta * inside_o.z)
        dimmed = Color(
            *(c * through * ops.exp(-a * path) for c, a in zip(metal, self.absorption, strict=True))
        )
        return ops.select(above, dimmed + coat * fresnel, Color.of(0.0))


def _facing(wi: Vec3, wo: Vec3) -> Float:
    """Cosine of the angle between `wi` and the half vector, which equals the angle between `wo` and the half vector."""
    h = wi + wo
    return 0.5 * ops.sqrt(ops.dot(h, h))


def _lobe(wi: Vec3, wo: Vec3, alpha: float) -> Float:
    """A microfacet reflection times cos(theta_o), without its Fresnel term (Walter 2007, eq. 20, separable masking)."""
    h = ops.normalize(wi + wo)
    return ggx_d(h, alpha, alpha) * smith_g1(wi, alpha, alpha) * smith_g1(wo, alpha, alpha) / (4.0 * wi.z)


def _refracted(w: Vec3, eta: float) -> tuple[Vec3, Float]:
    """Refracts `w` at the mean surface.

    Returns the refracted direction, mirrored to point up, and the fraction of the light that the surface reflects.
    """
    loss, cos_t = fresnel_dielectric(w.z, eta)
    return Vec3(w.x / eta, w.y / eta, cos_t), loss
