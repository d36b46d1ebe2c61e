"""Layered materials by Belcour 2018, "Efficient Rendering of Layered Materials using an Atomic Decomposition with
Statistical Operators": our own implementation from the paper, for the class `layered3`.

The light that a stack reflects is a sum of GGX lobes, one for each interface. A lobe is known by its moments: energy,
mean direction, which is that of the mirror, and variance. The moments of a stack follow from those of its layers by the
adding method, with one direction on each side of a layer: the one that Snell's law gives for wi.

The paper's medium scatters forwards only. It cannot say what the isotropic medium of `layered3` does, so light that is
scattered once goes on in its direction, and widens no lobe.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from figures.peers.lobes import COSINES, NODES, Curves, Layered3, albedo, ggx, visible
from nma import microfacet, ops
from nma.ops import Color, Vec3

# The greatest width that has a variance.
_WIDEST = 0.9999


def variance(alpha: ArrayLike) -> NDArray:
    """Returns the variance of a GGX lobe of the width `alpha`: the paper's fit alpha^1.1 / (1 - alpha^1.1)."""
    power = np.minimum(alpha, _WIDEST) ** 1.1
    return power / (1.0 - power)


def width(variance: ArrayLike) -> NDArray:
    """Returns the width alpha of a GGX lobe; the inverse of `variance`."""
    variance = np.asarray(variance)
    return np.clip((variance / (1.0 + variance)) ** (1.0 / 1.1), 1e-4, 1.0)


class Layer(NamedTuple):
    """The moments of a layer, or of a stack of layers, for light from above and, with `up`, from below.

    The energies `r` and `t` of reflection and transmission have the shape (cosines, 3). The variances `s_r` and `s_t`
    have the shape (cosines,), as has `spread`: the factor by which refraction widens light on its way up.
    """

    r: NDArray
    t: NDArray
    r_up: NDArray
    t_up: NDArray
    s_r: NDArray
    s_t: NDArray
    s_r_up: NDArray
    s_t_up: NDArray
    spread: NDArray


class Lobe(NamedTuple):
    """Energies (cosines, 3) and widths (cosines,) of a reflected lobe."""

    energy: NDArray
    alpha: NDArray


def _layer(cosines: NDArray, **moments: ArrayLike) -> Layer:
    """Returns a layer whose other moments are those of nothing: it transmits all light and widens no lobe."""
    flat, rgb = np.zeros_like(cosines), np.zeros((len(cosines), 3))
    nothing = {"r": rgb, "t": rgb + 1.0, "r_up": rgb, "t_up": rgb + 1.0}
    nothing |= {"s_r": flat, "s_t": flat, "s_r_up": flat, "s_t_up": flat, "spread": flat + 1.0}
    return Layer(
        **{k: np.asarray(moments.get(k, 0.0)) + (0.0 * v if k in moments else v) for k, v in nothing.items()}
    )


def dielectric(cosines: NDArray, alpha: float, eta: float, trapped: ArrayLike = 0.0) -> Layer:
    """Returns the interface to a medium of the relative index `eta` >= 1, seen from `cosines`.

    `trapped` is the share of the light from below that is totally reflected, although the mean direction is not.
    """
    inside = microfacet.fresnel_dielectric(cosines, eta)[1]
    r = albedo(cosines, alpha, lambda c: microfacet.fresnel_dielectric(c, eta)[0])[:, None]
    kept = np.asarray(trapped).reshape(-1, 1) * (1.0 - r)
    # A facet tilted by a small angle turns refracted light by 1 - 1 / eta of the angle, and by eta - 1 of it on the way
    # up, where a mirror turns it by twice the angle.
    return _layer(
        cosines,
        r=r,
        t=1.0 - r,
        r_up=r + kept,
        t_up=1.0 - r - kept,
        s_r=variance(alpha),
        s_r_up=variance(alpha),
        s_t=variance(0.5 * alpha * (1.0 - 1.0 / eta)),
        s_t_up=variance(0.5 * alpha * (eta - 1.0)),
        spread=eta * inside / cosines,
    )


def medium(cosines: NDArray, sigma_t: float, scattering: ArrayLike) -> Layer:
    """Returns a medium of thickness 1; `scattering` (3,) is the share of its extinction that is scattered forwards.

    Light that is scattered once goes on, and light that is scattered again is lost.
    """
    depth = sigma_t / cosines[:, None]
    t = (1.0 + np.asarray(scattering) * depth) * np.exp(-depth)
    return _layer(cosines, t=t, t_up=t)


def conductor(cosines: NDArray, alpha: float, eta: Color, k: Color, above: ArrayLike) -> Layer:
    """Returns the interface to a conductor, under layers that widen the light by the variance `above`.

    The energy is that of a facet distribution which accounts for this variance, too.
    """
    wide = width(above + variance(alpha))
    r = [albedo(cosines, wide, partial(_metal, e, x)) for e, x in zip(eta, k, strict=True)]
    return _layer(cosines, r=np.stack(r, axis=-1), t=0.0, t_up=0.0, s_r=variance(alpha))


def _metal(eta: float, k: float, cosine: NDArray) -> NDArray:
    return microfacet.fresnel_conductor(cosine, eta, k)


def trapped(cosines: NDArray, alpha: ArrayLike, eta: float) -> NDArray:
    """Returns the share of a lobe, reflected from `cosines` with the width `alpha`, that is totally reflected above."""
    seen = visible(cosines, alpha)
    out = seen.out**2 > 1.0 - 1.0 / eta**2
    return 1.0 - np.sum(seen.weight * out, axis=0) / np.sum(seen.weight, axis=0)


def add(upper: Layer, lower: Layer) -> tuple[Layer, Lobe]:
    """Returns the stack of two layers, and the lobe that the lower one adds to the reflection (the adding method).

    Variances are means over light that was reflected any number of times between the two, weighted by energy.
    """
    bounce = upper.r_up * lower.r
    series = 1.0 / (1.0 - bounce)
    lobe = upper.t * lower.r * upper.t_up * series
    back = lower.t_up * upper.r_up * lower.t * series
    r_up = lower.r_up + back
    again = _mean(bounce * series) * (lower.s_r + upper.s_r_up)
    s_lobe = upper.spread * (upper.s_t + lower.s_r + again) + upper.s_t_up
    s_back = (lower.s_t_up + upper.s_r_up + again) / lower.spread + lower.s_t
    stack = Layer(
        r=upper.r + lobe,
        t=upper.t * lower.t * series,
        r_up=r_up,
        t_up=lower.t_up * upper.t_up * series,
        s_r=_weighted(upper.s_r, upper.r, s_lobe, lobe),
        s_t=(upper.s_t + again) / lower.spread + lower.s_t,
        s_r_up=_weighted(lower.s_r_up, lower.r_up, s_back, back),
        s_t_up=upper.spread * (lower.s_t_up + again) + upper.s_t_up,
        spread=upper.spread * lower.spread,
    )
    return stack, Lobe(lobe, width(s_lobe))


def _mean(energy: NDArray) -> NDArray:
    return energy.mean(axis=-1)


def _weighted(s_a: NDArray, a: NDArray, s_b: NDArray, b: NDArray) -> NDArray:
    """Returns the mean of two variances, weighted by energies."""
    return (_mean(a) * s_a + _mean(b) * s_b) / np.maximum(_mean(a) + _mean(b), 1e-12)


def from_layered3(given: Layered3) -> list[Lobe]:
    """Returns the lobes, at COSINES, of a material of the class `layered3`."""
    alpha_top, alpha_bottom, eta_top = given.alpha_top, given.alpha_bottom, given.eta_top
    inside = microfacet.fresnel_dielectric(COSINES, eta_top)[1]
    above = dielectric(COSINES, alpha_top, eta_top).s_t
    share = trapped(inside, width(above + variance(alpha_bottom)), eta_top)
    top = dielectric(COSINES, alpha_top, eta_top, share)
    coated, _ = add(top, medium(inside, given.sigma_t, list(given.albedo)))
    metal = conductor(inside, alpha_bottom, given.eta / eta_top, given.k / eta_top, above)
    _, base = add(coated, metal)
    return [Lobe(top.r + 0.0 * base.energy, alpha_top + 0.0 * base.alpha), base]


def source(given: Layered3, adjust: Callable[[list[Lobe]], list[Lobe]] = list) -> Belcour:
    """Returns a material of the class `layered3` as a sum of lobes, after `adjust` has changed them."""
    return Belcour(adjust(from_layered3(given)))


def normalised(lobes: list[Lobe]) -> list[Lobe]:
    """Returns the lobes with as much energy as the moments say, although masking takes some from a GGX lobe."""
    return [Lobe(x.energy / albedo(COSINES, x.alpha)[:, None], x.alpha) for x in lobes]


class Belcour:
    """A source (`nma.sources.base.Values`) that is a sum of lobes."""

    isotropic = True

    def __init__(self, lobes: list[Lobe], name: str = "belcour"):
        self.name = name
        # Widths of the lobes, for sampling: towards the normal, and at an oblique angle.
        self.widths = tuple(float(x.alpha[-1]) for x in lobes) + (float(lobes[-1].alpha[NODES // 3]),)
        self._lobes = [Curves(np.column_stack([x.energy, x.alpha])) for x in lobes]

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        m = ops.normalize(wi + wo)
        total = Color.of(0.0 * wi.z)
        for lobe in self._lobes:
            *energy, alpha = lobe.at(wi.z)
            total = total + Color(*energy) * ggx(wi, wo, m, alpha)
        return ops.select((wi.z > 0) & (wo.z > 0), total, Color.of(0.0))
