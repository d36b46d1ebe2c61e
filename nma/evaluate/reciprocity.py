"""Measures how far adapters are from being reciprocal: the difference between f(wi, wo) and f(wo, wi).

An adapter's network computes the target's parameters for the view direction, so f(wi, wo) and f(wo, wi) differ.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma.adapter import Adapter
from nma.ops import Vec3, at_azimuth_0
from nma.target import Brdf

SAMPLES = 1 << 14


class Swapped(NamedTuple):
    """Values (3, n) of f at n pairs of directions, divided by the probability density of wo.

    `forward` is f(wi, wo) cos(theta_o) / density, and `swapped` is f(wo, wi) cos(theta_o) / density.
    """

    forward: NDArray
    swapped: NDArray


def non_reciprocity(adapter: Adapter, params: NDArray, samples: int = SAMPLES) -> float:
    """The mean of |f(wi, wo) - f(wo, wi)| over all pairs of directions and RGB, divided by the mean of f.

    Both means are weighted by cos(theta_i) cos(theta_o): by the light that a uniform sky sends from wo to wi. For an
    adapter that reflects no light, the result is 0.
    """
    rng = np.random.default_rng(0)
    found = swapped_pairs(adapter, params, np.sqrt(rng.random(samples)), rng)
    light = found.forward.sum()
    return float(np.abs(found.forward - found.swapped).sum() / light) if light > 0.0 else 0.0


def swapped_pairs(adapter: Adapter, params: NDArray, cosines: NDArray, rng: np.random.Generator) -> Swapped:
    """Draws one light direction from the adapter's blend for each view direction.

    `cosines` (n,) are the cosines of the view directions with the normal.
    """
    n = len(cosines)
    wi = at_azimuth_0(cosines)
    brdf = _prepared(adapter, params, wi)
    # The random numbers that choose a lobe of the blend are stratified.
    u = rng.permutation((np.arange(n) + rng.random(n)) / n), *rng.random((2, n))
    wo, value, pdf = brdf.sample(wi, *u)
    valid = (pdf > 0.0) & (wo.z > 1e-4)
    wo = Vec3(*(np.where(valid, x, up) for x, up in zip(wo, (0.0, 0.0, 1.0), strict=True)))
    # The swapped evaluation returns f(wo, wi) cos(theta_i); the factor wo.z / wi.z makes this f(wo, wi) cos(theta_o).
    back = np.stack(_prepared(adapter, params, wo).eval(wo, wi)) * wo.z / wi.z
    weight = np.where(valid, 1.0 / np.where(valid, pdf, 1.0), 0.0)
    return Swapped(np.stack(value) * weight, back * weight)


def _prepared(adapter: Adapter, params: NDArray, w: Vec3) -> Brdf:
    """Returns the BRDF of one material, with the blend's parameters computed for the view directions `w`."""
    return adapter.prepare([np.full(len(w.z), x) for x in params], w)
