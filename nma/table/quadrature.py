"""Points inside the bins of a table, for Average-vs-Average supervision (paper eq. 6), evaluation and tabulation.

A bin of 2e-3 sr is much wider than a sharp lobe, so uniform points would miss the lobe. The points of this module are
denser near the mirror direction, at every scale down to the narrowest lobe. Each point has a weight, which makes the
weighted average of any function unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from nma import ops
from nma.jit import dr
from nma.ops import Float, Vec3
from nma.table.grid import ISOTROPIC, Grid

# The density of points increases towards the mirror direction, down to the scale of a lobe whose microfacet width
# (alpha) is `FINEST`. `FINEST` is half the width of the narrowest lobe, because training with coarser points makes the
# narrowest lobes too broad.
FINEST = 0.0005


class Points(NamedTuple):
    """Weighted pairs of directions. The mean of `weight * f` over a bin's points estimates the mean of f in the bin."""

    wi: Vec3
    wo: Vec3
    weight: Float


def shifted(x: Float, shift: Float) -> Float:
    """x + shift modulo 1."""
    x = x + shift
    return x - ops.floor(x)


def hashed(number: Any, seed: Any) -> Float:
    """Hashes each 32-bit `number` to a Dr.Jit float in [0, 1) (the hash "pcg" of Jarzynski and Olano 2020)."""
    state = (number ^ (seed * 0x9E3779B9)) * 747796405 + 2891336453
    word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737
    return dr.auto.Float(((word >> 22) ^ word) >> 8) * (1.0 / 2**24)


def points(
    place: Sequence[Float], u: Sequence[Float], grid: Grid = ISOTROPIC, finest: float | None = FINEST
) -> Points:
    """Maps the point `u` of the unit cube to a pair of directions in the bin `place`.

    `place` is the bin's indices (theta_i, phi_i, theta_o, phi_o), as floats. For an isotropic grid, `u` has three
    numbers and phi_i is ignored; for an anisotropic grid, `u` has four numbers. The density of points increases towards
    the mirror direction, down to the scale of a lobe of width `finest`. If `finest` is None, the density is uniform.
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
    """Maps the point `u` of the unit cube to directions in the bin (theta_i, theta_o, phi) = (i, o, p)."""
    near_mu, near_phi = _scales(i, grid, finest)
    mu_i, mu_o, weight = _cosines(i, o, u[0], u[1], grid, near_mu)
    # psi is the azimuth between wo and the mirror direction. Points are denser around psi = 0.
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
    """Maps the point `u` of the unit cube to directions in the bin (theta_i, phi_i, theta_o, phi_o) = (i, a, o, b)."""
    near_mu, near_phi = _scales(i, grid, finest)
    mu_i, mu_o, weight = _cosines(i, o, u[0], u[1], grid, near_mu)
    # psi is the azimuth between wo and the mirror direction: the azimuth of wo minus the azimuth of wi minus pi. Points
    # are denser around psi = 0. `centre` is psi for the middles of the two bins, as an angle from -pi to pi.
    step_i, step_o = 2.0 * math.pi / grid.phi_i, 2.0 * math.pi / grid.phi_o
    centre = (b + 0.5) * step_o - (a + 0.5) * step_i
    centre = centre - (2.0 * math.pi) * ops.floor(centre * (0.5 * ops.INV_PI)) - math.pi
    low_i = a * step_i
    low_o = low_i + (centre + 0.5 * (step_i - step_o))
    phi_i, psi, psi_weight = _pair(u[2], u[3], (low_i, step_i), (low_o, step_o), centre, near_phi)
    wi, wo = _directions(mu_i, mu_o, -psi)
    return Points(_turned(wi, phi_i), _turned(wo, phi_i), weight * psi_weight)


def _scales(i: Float, grid: Grid, finest: float) -> tuple[Float, Float]:
    """The extent of a lobe of width `finest` around the mirror direction, as (extent in cosine, in azimuth [rad])."""
    mu = (i + 0.5) * (1.0 / grid.theta_i)
    sin = ops.sqrt(1.0 - mu * mu)
    return (2.0 * finest) * sin + 1e-5, ops.minimum((2.0 * finest) * mu / sin, 1.0)


def _cosines(i: Float, o: Float, u: Float, v: Float, grid: Grid, scale: Float) -> tuple[Float, Float, Float]:
    """Draws (cos(theta_i), cos(theta_o), weight).

    Small differences of the cosines are more probable, because the difference is 0 at the mirror direction.
    """
    width_i, width_o = 1.0 / grid.theta_i, 1.0 / grid.theta_o
    centre = ((o + 0.5) * (grid.theta_i / grid.theta_o) - (i + 0.5)) * width_i
    mu, s, weight = _pair(u, v, (i * width_i, width_i), (o * width_o, width_o), centre, scale)
    mu_i = ops.clip(mu, 1e-6, 1.0)
    return mu_i, ops.clip(mu_i + s, 1e-6, 1.0), weight


def _pair(
    u: Float, v: Float, x: tuple[Float, float], y: tuple[Float, float], centre: Float, scale: Float
) -> tuple[Float, Float, Float]:
    """Draws a number from the bin `x` and a number from the bin `y`, more densely where these two numbers differ less.

    Returns (number in `x`, number in `y` minus number in `x`, weight). A bin is given as (lower end, width). `centre`
    is the middle of `y` minus the middle of `x`.
    """
    (low_x, width_x), (low_y, width_y) = x, y
    reach = 0.5 * (width_x + width_y)
    s, density = _crowd(u, centre - reach, centre + reach, scale)
    # s is the number in `y` minus the number in `x`. With this s, only an interval of numbers in `x` is possible;
    # `room` is the interval's length. As a function of s, `room` has the shape of a triangle, or of a trapezoid if the
    # widths of the bins differ.
    room = ops.minimum(reach - ops.absolute(s - centre), min(width_x, width_y))
    room = ops.maximum(room, 1e-7 * width_x)
    # Draw the number in `x` uniformly from the interval of length `room`.
    low = ops.maximum(low_x, low_y - s)
    return low + v * room, s, room / (density * (width_x * width_y))


def _directions(mu_i: Float, mu_o: Float, psi: Float) -> tuple[Vec3, Vec3]:
    """Returns wi at azimuth 0 and wo at azimuth pi - psi.

    The formulas are chosen such that half vectors near the normal are precise.
    """
    sin_i = ops.safe_sqrt((1.0 - mu_i) * (1.0 + mu_i))
    sin_o = ops.safe_sqrt((1.0 - mu_o) * (1.0 + mu_o))
    return Vec3(sin_i, 0.0 * mu_i, mu_i), Vec3(-sin_o * ops.cos(psi), sin_o * ops.sin(psi), mu_o)


def _turned(w: Vec3, phi: Float) -> Vec3:
    """The direction `w`, rotated by `phi` about the normal."""
    cos_phi, sin_phi = ops.cos(phi), ops.sin(phi)
    return Vec3(cos_phi * w.x - sin_phi * w.y, sin_phi * w.x + cos_phi * w.y, w.z)


def _crowd(u: Float, low: Float, high: Float, scale: Float) -> tuple[Float, Float]:
    """Draws a number x in low..high with a density proportional to 1 / (|x| + scale). Returns (x, density)."""

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
    """Like `bin_points`, but the points have a uniform density in the bin, as in the paper."""
    mu_i = ops.clip((i + u[0]) * (1.0 / grid.theta_i), 1e-6, 1.0)
    mu_o = ops.clip((o + u[1]) * (1.0 / grid.theta_o), 1e-6, 1.0)
    psi = (grid.phi_o - p - u[2]) * (math.pi / grid.phi_o)
    return Points(*_directions(mu_i, mu_o, psi), 1.0 + 0.0 * psi)


def uniform_anisotropic_bin_points(
    i: Float, a: Float, o: Float, b: Float, u: tuple[Float, Float, Float, Float], grid: Grid
) -> Points:
    """Like `anisotropic_bin_points`, but the points have a uniform density in the bin."""
    mu_i = ops.clip((i + u[0]) * (1.0 / grid.theta_i), 1e-6, 1.0)
    mu_o = ops.clip((o + u[1]) * (1.0 / grid.theta_o), 1e-6, 1.0)
    phi_i, phi_o = (a + u[2]) * (2.0 * math.pi / grid.phi_i), (b + u[3]) * (2.0 * math.pi / grid.phi_o)
    wi, wo = _directions(mu_i, mu_o, math.pi + phi_i - phi_o)
    return Points(_turned(wi, phi_i), _turned(wo, phi_i), 1.0 + 0.0 * phi_i)
