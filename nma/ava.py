"""Points inside the bins of an isotropic table, for Average-vs-Average supervision (paper eq. 6) and for evaluation.

A bin of 2e-3 sr is much wider than a sharp lobe, so uniform points miss it. These points are denser towards the mirror
direction on every scale down to the narrowest lobe, and carry the weights that make the average of any function
unbiased.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.ops import Float, Vec3
from nma.table import ISOTROPIC, Grid

# Points crowd towards the mirror direction down to this microfacet width: half of the narrowest lobe's, as coarser
# points make training broaden such lobes.
FINEST = 0.0005

# Kronecker lattice in three dimensions: powers of the inverse of the root of x^4 = x + 1 (Roberts 2018).
_LATTICE = np.array([1.2207440846057596 ** -(k + 1) for k in range(3)])


class Points(NamedTuple):
    """Pairs of directions; the mean of `weight * f` over a bin's points estimates the mean of f over the bin."""

    wi: Vec3
    wo: Vec3
    weight: Float


def lattice(n: int) -> NDArray[np.float64]:
    """`n` well-spread points (n, 3) in the unit cube, to be shifted at random, modulo 1, for each bin."""
    return (np.arange(n)[:, None] * _LATTICE + 0.5) % 1.0


def bin_points(
    i: Float,
    o: Float,
    p: Float,
    u: tuple[Float, Float, Float],
    grid: Grid = ISOTROPIC,
    finest: float = FINEST,
) -> Points:
    """The point `u` of the unit cube, placed in the bin (theta_i, theta_o, phi) = (i, o, p), given as floats."""
    width = 1.0 / grid.theta_i
    mu_mid = (i + 0.5) * width
    sin_mid = ops.sqrt(1.0 - mu_mid * mu_mid)
    # The difference of the cosines, crowded around 0 where the mirror direction lies. For all pairs of cosines in the
    # bin it has a triangular distribution around `centre`.
    centre = (o - i) * width
    s, s_density = _crowd(u[0], centre - width, centre + width, (2.0 * finest) * sin_mid + 1e-5)
    room = ops.maximum(width - ops.absolute(s - centre), 1e-7 * width)
    # One of the pairs with this difference.
    mu_low = ops.maximum(i * width, o * width - s)
    mu_i = ops.clip(mu_low + u[1] * room, 1e-6, 1.0)
    mu_o = ops.clip(mu_i + s, 1e-6, 1.0)
    # The azimuth away from the mirror direction, crowded around 0 too.
    step = math.pi / grid.phi_o
    low = (grid.phi_o - 1.0 - p) * step
    psi, psi_density = _crowd(u[2], low, low + step, ops.minimum((2.0 * finest) * mu_mid / sin_mid, 1.0))
    weight = room / (s_density * (width * width)) / (psi_density * step)
    return Points(*_directions(mu_i, mu_o, psi), weight)


def _directions(mu_i: Float, mu_o: Float, psi: Float) -> tuple[Vec3, Vec3]:
    """wi at azimuth 0 and wo at azimuth pi - psi, such that sharp half vectors keep their digits."""
    sin_i = ops.safe_sqrt((1.0 - mu_i) * (1.0 + mu_i))
    sin_o = ops.safe_sqrt((1.0 - mu_o) * (1.0 + mu_o))
    return Vec3(sin_i, 0.0 * mu_i, mu_i), Vec3(-sin_o * ops.cos(psi), sin_o * ops.sin(psi), mu_o)


def _crowd(u: Float, low: Float, high: Float, scale: Float) -> tuple[Float, Float]:
    """A number in low..high with density in proportion to 1 / (|x| + scale), and that density."""

    def primitive(x: Float) -> Float:
        magnitude = ops.log1p(ops.absolute(x) / scale)
        return ops.select(x < 0, -magnitude, magnitude)

    start = primitive(low)
    total = primitive(high) - start
    t = start + u * total
    magnitude = scale * (ops.exp(ops.absolute(t)) - 1.0)
    x = ops.select(t < 0, -magnitude, magnitude)
    return x, 1.0 / ((magnitude + scale) * total)


def uniform_bin_points(
    i: Float, o: Float, p: Float, u: tuple[Float, Float, Float], grid: Grid = ISOTROPIC
) -> Points:
    """The point `u` of the unit cube spread uniformly over the bin (i, o, p): the paper's choice."""
    mu_i = ops.clip((i + u[0]) * (1.0 / grid.theta_i), 1e-6, 1.0)
    mu_o = ops.clip((o + u[1]) * (1.0 / grid.theta_o), 1e-6, 1.0)
    psi = (grid.phi_o - p - u[2]) * (math.pi / grid.phi_o)
    return Points(*_directions(mu_i, mu_o, psi), 1.0 + 0.0 * psi)
