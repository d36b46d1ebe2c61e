"""Points inside the bins of a table: for Average-vs-Average supervision (paper eq. 6), evaluation, and tabulation.

A bin of 2e-3 sr is much wider than a sharp lobe, so uniform points miss it. These points are denser towards the mirror
direction on every scale down to the narrowest lobe, and carry the weights that make the average of any function
unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.jit import dr
from nma.ops import Float, Vec3
from nma.table.grid import ISOTROPIC, Grid

# Points crowd towards the mirror direction down to this microfacet width: half of the narrowest lobe's, as coarser
# points make training broaden such lobes.
FINEST = 0.0005

# Kronecker lattices in d dimensions: powers of the inverse of the root of x^(d+1) = x + 1 (Roberts 2018).
_ROOTS = {3: 1.2207440846057596, 4: 1.1673039782614187}


class Points(NamedTuple):
    """Pairs of directions; the mean of `weight * f` over a bin's points estimates the mean of f over the bin."""

    wi: Vec3
    wo: Vec3
    weight: Float


def lattice(n: int, dimensions: int = 3) -> NDArray[np.float64]:
    """`n` well-spread points (n, 3 or 4) in the unit cube, to be shifted at random, modulo 1, for each bin."""
    steps = np.array([_ROOTS[dimensions] ** -(k + 1) for k in range(dimensions)])
    return (np.arange(n)[:, None] * steps + 0.5) % 1.0


def shifted(x: Float, shift: Float) -> Float:
    """x + shift modulo 1."""
    x = x + shift
    return x - ops.floor(x)


def hashed(number: Any, seed: Any) -> Float:
    """A fixed random number in [0, 1) for each 32-bit `number`, on Dr.Jit. Jarzynski and Olano 2020, "pcg"."""
    state = (number ^ (seed * 0x9E3779B9)) * 747796405 + 2891336453
    word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737
    return dr.auto.Float(((word >> 22) ^ word) >> 8) * (1.0 / 2**24)


def points(
    place: Sequence[Float], u: Sequence[Float], grid: Grid = ISOTROPIC, finest: float | None = FINEST
) -> Points:
    """The point `u` of the unit cube, placed in the bin `place`, (theta_i, phi_i, theta_o, phi_o).

    Isotropic grids take three numbers `u` and ignore phi_i, others four. Points crowd down to lobes of width `finest`;
    without one they spread uniformly.
    """
    i, a, o, b = place
    if grid.phi_i:
        if finest is None:
            return uniform_anisotropic_bin_points(i, a, o, b, tuple(u), grid)
        return anisotropic_bin_points(i, a, o, b, tuple(u), grid, finest)
    if finest is None:
        return uniform_bin_points(i, o, b, tuple(u), grid)
    return bin_points(i, o, b, tuple(u), grid, finest)


def bin_points(
    i: Float,
    o: Float,
    p: Float,
    u: tuple[Float, Float, Float],
    grid: Grid = ISOTROPIC,
    finest: float = FINEST,
) -> Points:
    """The point `u` of the unit cube, placed in the bin (theta_i, theta_o, phi) = (i, o, p), given as floats."""
    near_mu, near_phi = _scales(i, grid, finest)
    mu_i, mu_o, weight = _cosines(i, o, u[0], u[1], grid, near_mu)
    # The azimuth away from the mirror direction, crowded around 0 too.
    step = math.pi / grid.phi_o
    low = (grid.phi_o - 1.0 - p) * step
    psi, psi_density = _crowd(u[2], low, low + step, near_phi)
    return Points(*_directions(mu_i, mu_o, psi), weight / (psi_density * step))


def anisotropic_bin_points(
    i: Float,
    a: Float,
    o: Float,
    b: Float,
    u: tuple[Float, Float, Float, Float],
    grid: Grid,
    finest: float = FINEST,
) -> Points:
    """The point `u` of the unit cube, placed in the bin (theta_i, phi_i, theta_o, phi_o) = (i, a, o, b)."""
    near_mu, near_phi = _scales(i, grid, finest)
    mu_i, mu_o, weight = _cosines(i, o, u[0], u[1], grid, near_mu)
    # The difference of the azimuths, crowded around that of the mirror direction, whichever way round is shorter.
    step_i, step_o = 2.0 * math.pi / grid.phi_i, 2.0 * math.pi / grid.phi_o
    centre = (b + 0.5) * step_o - (a + 0.5) * step_i
    centre = centre - (2.0 * math.pi) * ops.floor(centre * (0.5 * ops.INV_PI)) - math.pi
    low_i = a * step_i
    low_o = low_i + (centre + 0.5 * (step_i - step_o))
    phi_i, psi, psi_weight = _pair(u[2], u[3], (low_i, step_i), (low_o, step_o), centre, near_phi)
    wi, wo = _directions(mu_i, mu_o, -psi)
    return Points(_turned(wi, phi_i), _turned(wo, phi_i), weight * psi_weight)


def _scales(i: Float, grid: Grid, finest: float) -> tuple[Float, Float]:
    """Differences from the mirror direction's cosine and azimuth that a lobe of width `finest` spans."""
    mu = (i + 0.5) * (1.0 / grid.theta_i)
    sin = ops.sqrt(1.0 - mu * mu)
    return (2.0 * finest) * sin + 1e-5, ops.minimum((2.0 * finest) * mu / sin, 1.0)


def _cosines(i: Float, o: Float, u: Float, v: Float, grid: Grid, scale: Float) -> tuple[Float, Float, Float]:
    """cos(theta_i), cos(theta_o) and weight; the difference of the cosines crowds around the mirror direction's, 0."""
    width_i, width_o = 1.0 / grid.theta_i, 1.0 / grid.theta_o
    centre = ((o + 0.5) * (grid.theta_i / grid.theta_o) - (i + 0.5)) * width_i
    mu, s, weight = _pair(u, v, (i * width_i, width_i), (o * width_o, width_o), centre, scale)
    mu_i = ops.clip(mu, 1e-6, 1.0)
    return mu_i, ops.clip(mu_i + s, 1e-6, 1.0), weight


def _pair(
    u: Float, v: Float, x: tuple[Float, float], y: tuple[Float, float], centre: Float, scale: Float
) -> tuple[Float, Float, Float]:
    """A number in the bin `x`, the difference to one in the bin `y`, which crowds around 0, and the weight.

    Bins are (lower end, width), `centre` is the difference of their middles.
    """
    (low_x, width_x), (low_y, width_y) = x, y
    reach = 0.5 * (width_x + width_y)
    s, density = _crowd(u, centre - reach, centre + reach, scale)
    # Of all pairs in the two bins, this share has the difference s: a triangle, or a trapezoid for unequal widths.
    room = ops.minimum(reach - ops.absolute(s - centre), min(width_x, width_y))
    room = ops.maximum(room, 1e-7 * width_x)
    # One of these pairs.
    low = ops.maximum(low_x, low_y - s)
    return low + v * room, s, room / (density * (width_x * width_y))


def _directions(mu_i: Float, mu_o: Float, psi: Float) -> tuple[Vec3, Vec3]:
    """wi at azimuth 0 and wo at azimuth pi - psi, such that sharp half vectors keep their digits."""
    sin_i = ops.safe_sqrt((1.0 - mu_i) * (1.0 + mu_i))
    sin_o = ops.safe_sqrt((1.0 - mu_o) * (1.0 + mu_o))
    return Vec3(sin_i, 0.0 * mu_i, mu_i), Vec3(-sin_o * ops.cos(psi), sin_o * ops.sin(psi), mu_o)


def _turned(w: Vec3, phi: Float) -> Vec3:
    """The direction turned by `phi` about the normal."""
    cos_phi, sin_phi = ops.cos(phi), ops.sin(phi)
    return Vec3(cos_phi * w.x - sin_phi * w.y, sin_phi * w.x + cos_phi * w.y, w.z)


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


def uniform_anisotropic_bin_points(
    i: Float, a: Float, o: Float, b: Float, u: tuple[Float, Float, Float, Float], grid: Grid
) -> Points:
    """The point `u` of the unit cube spread uniformly over the bin (i, a, o, b)."""
    mu_i = ops.clip((i + u[0]) * (1.0 / grid.theta_i), 1e-6, 1.0)
    mu_o = ops.clip((o + u[1]) * (1.0 / grid.theta_o), 1e-6, 1.0)
    phi_i, phi_o = (a + u[2]) * (2.0 * math.pi / grid.phi_i), (b + u[3]) * (2.0 * math.pi / grid.phi_o)
    wi, wo = _directions(mu_i, mu_o, math.pi + phi_i - phi_o)
    return Points(_turned(wi, phi_i), _turned(wo, phi_i), 1.0 + 0.0 * phi_i)
