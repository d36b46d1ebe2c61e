"""Coated metal as OpenPBR writes it, with parameters that follow from the class `layered3` by a stated rule.

The rule, with the class's symbols on the right:
    coat_ior = eta_top, coat_roughness^2 = alpha_top, specular_roughness^2 = alpha_bottom, coat_darkening = 1;
    base_color, and specular_color times Schlick's curve = the conductor's reflectances under the coat, at the cosines
    1 and 1/7;
    coat_color = exp(-2 sigma_t (1 - albedo)): only absorption dims the two ways through the slab, as a coat of OpenPBR
    does not scatter.

Source: the OpenPBR specification, sections Layering, Metal and Coat, whose formulas we read in the text of 2024-04-30.
Its directions have the opposite names: its omega_o is the view, which is our wi.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from figures.peers.lobes import COSINES, Curves, Layered3, albedo, ggx
from nma import microfacet, ops
from nma.jit import dr
from nma.ops import Color, Float, Vec3

_EDGE = 1.0 / 7.0


class CoatedMetal(NamedTuple):
    """The parameters that OpenPBR uses of a metal under a coat."""

    coat_alpha: float
    coat_ior: float
    coat_color: Color
    base_roughness: float
    base_color: Color
    edge: Color  # the reflectance at the cosine 1/7, which is specular_color times Schlick's curve there

    @property
    def base_alpha(self) -> float:
        """The base's width under a rough coat: r_B'^4 = min(1, r_B^4 + 2 r_C^4) (section Coat, Roughening)."""
        return float(np.sqrt(min(1.0, self.base_roughness**4 + 2.0 * self.coat_alpha**2)))


def from_layered3(given: Layered3) -> CoatedMetal:
    """Returns OpenPBR's parameters of a material of the class `layered3`, by the rule above."""
    relative = given.eta / given.eta_top, given.k / given.eta_top
    return CoatedMetal(
        coat_alpha=given.alpha_top,
        coat_ior=given.eta_top,
        coat_color=Color(*(np.exp(-2.0 * given.sigma_t * (1.0 - a)) for a in given.albedo)),
        base_roughness=np.sqrt(given.alpha_bottom),
        base_color=microfacet.fresnel_conductor_rgb(1.0, *relative),
        edge=microfacet.fresnel_conductor_rgb(_EDGE, *relative),
    )


def source(given: Layered3, both_ways: bool = False) -> OpenPbr:
    """Returns a material of the class `layered3` as OpenPBR writes it."""
    return OpenPbr(from_layered3(given), both_ways)


def f82(cosine: Any, f0: Any, edge: Any) -> Any:
    """Returns the F82-tint Fresnel curve, which passes through f0 at 1 and `edge` at 1/7 (section Metal).

    Kutz, Hasan and Edmondson 2021, "Novel aspects of the Adobe Standard Material", section 2.3.
    """
    lowered = (_schlick(_EDGE, f0) - edge) / (_EDGE * (1.0 - _EDGE) ** 6)
    away = 1.0 - cosine
    return ops.clip(
        _schlick(cosine, f0) - lowered * cosine * (away * away * away) * (away * away * away), 0.0, 1.0
    )


def _schlick(cosine: Any, f0: Any) -> Any:
    away = 1.0 - cosine
    return f0 + (1.0 - f0) * (away * away * away * away * away)


def darkening(material: CoatedMetal, base_albedo: Any, cosine: Any) -> Any:
    """Returns (1 - K) / (1 - E_b K): the light lost by reflections between coat and base (section Coat, Darkening).

    K lies between the inner reflection of light from a mirror and from a diffuse base, by the base's roughness.
    """
    ior = material.coat_ior
    smooth = microfacet.fresnel_dielectric(cosine, ior)[0]
    cosines = (np.arange(64) + 0.5) / 64
    average = np.mean(2.0 * cosines * microfacet.fresnel_dielectric(cosines, ior)[0])
    rough = 1.0 - (1.0 - average) / ior**2
    inner = ops.lerp(smooth, rough, material.base_roughness)
    return (1.0 - inner) / (1.0 - base_albedo * inner)


class OpenPbr:
    """A source (`nma.sources.base.Values`) of a coated metal.

    The coat dims the base by 1 - E(wi), as the specification's albedo scaling does (section Layering). `both_ways` also
    dims it by 1 - E(wo), as Adobe's implementation does (adobe/openpbr-bsdf).
    """

    isotropic = True

    def __init__(self, material: CoatedMetal, both_ways: bool = False, name: str = "openpbr"):
        self.name = name
        # The widths of the lobes, for sampling.
        self.widths = (material.coat_alpha, material.base_alpha)
        coat = albedo(
            COSINES, material.coat_alpha, lambda c: microfacet.fresnel_dielectric(c, material.coat_ior)[0]
        )
        passed = 1.0 - coat
        base = [passed * darkening(material, f0, COSINES) for f0 in material.base_color]
        self._base = Curves(np.stack(base, axis=-1))
        self._passed = Curves(np.stack([passed if both_ways else np.ones_like(passed)], axis=-1))
        # Numbers that stand in no kernel: all materials share the compiled kernels.
        opaque = lambda x: dr.opaque(dr.auto.Float, float(x))
        self._ior, self._coat_alpha, self._base_alpha = map(
            opaque, (material.coat_ior, material.coat_alpha, material.base_alpha)
        )
        absorbed = (-np.log(c) for c in material.coat_color)
        self._channels = [
            tuple(map(opaque, c)) for c in zip(absorbed, material.base_color, material.edge, strict=True)
        ]

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        m = ops.normalize(wi + wo)
        cosine = ops.clip(ops.dot(wi, m), 0.0, 1.0)
        coat = microfacet.fresnel_dielectric(cosine, self._ior)[0] * ggx(wi, wo, m, self._coat_alpha)
        base = ggx(wi, wo, m, self._base_alpha) * self._passed.at(wo.z)[0]
        # The medium's transmittance along both refracted ways (section Coat, View-dependent absorption).
        way = 0.5 * (1.0 / self._inside(wi.z) + 1.0 / self._inside(wo.z))
        value = [
            coat + base * passed * ops.exp(-absorbed * way) * f82(cosine, f0, edge)
            for passed, (absorbed, f0, edge) in zip(self._base.at(wi.z), self._channels, strict=True)
        ]
        return ops.select((wi.z > 0) & (wo.z > 0), Color(*value), Color.of(0.0))

    def _inside(self, cosine: Float) -> Float:
        """Returns the cosine of the refracted direction."""
        return ops.safe_sqrt(1.0 - (1.0 - cosine * cosine) / (self._ior * self._ior))
