"""From sources that know their value to tables, and back.

The value of a bin is the mean of f cos(theta_o) over it, from fixed points in it. A table is itself a source, one that
knows a value for each bin.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import TableError
from nma.jit import dr
from nma.ops import Color, Float, Vec3
from nma.sources.base import Values
from nma.sources.lookup import Lookup
from nma.table import quadrature
from nma.table.grid import ISOTROPIC, Grid, Tables

# Points of a bin, unless asked for otherwise. Bins around the mirror direction get so many times more, crowded towards
# it: there are few of them, and they hold the peaks of smooth materials.
POINTS = 128
_NEAR = 32
# How many bins away from the mirror direction's elevation that is.
_REACH = 4.5

# Independent sets that a bin's points are divided into; their spread is its standard error.
_SETS = 4
# Points come in so many: as many of them in each set, and within a set pairs in both mirror halves.
_MULTIPLE = 16
# Points keep this share of a bin's width off its edges, where rounding might move them into the next.
_EDGE = 1e-5

# Weights whose variance is below do not differ but by rounding.
_UNWEIGHTED = 1e-4

# Bins of one launch: bounds the memory, has no influence on the result.
_BINS_PER_LAUNCH = 1 << 20

# The number of walks of a table without any noise.
_NOISELESS = 1 << 40


def tabulate_values(values: Values, *, grid: Grid = ISOTROPIC, points: int = POINTS) -> Tables:
    """The table of one source, whose parameters are an empty vector, (1, 0).

    `points` per bin, a multiple of 16, are spread evenly over it; around the mirror direction there are 32 times
    more, crowded down to the narrowest lobe. Equal arguments give equal tables. `error` is the standard error that
    four independent sets of points show, rounding aside; it knows nothing of the source's own faults, such as the
    noise of a measurement. `walks` says how many random walks would leave the median bin with the same error, at most
    2^40.

    Raises `TableError` for an anisotropic source on an isotropic grid, another number of points, and values that are
    not finite.
    """
    if not (values.isotropic or grid.phi_i):
        raise TableError(
            f"{values.name} is anisotropic, the grid is not; give one with azimuths of wi, such as "
            "nma.table.ANISOTROPIC"
        )
    if points < 1 or points % _MULTIPLE:
        raise TableError(f"cannot tabulate from {points} point(s) per bin; take a multiple of {_MULTIPLE}")
    mean = np.empty((grid.bins, 3), np.float32)
    error = np.empty_like(mean)
    for first in range(0, grid.bins, _BINS_PER_LAUNCH):
        bins = np.arange(first, min(first + _BINS_PER_LAUNCH, grid.bins))
        near = _near_mirror(bins, grid)
        for chosen, count, crowded in ((bins[~near], points, False), (bins[near], points * _NEAR, True)):
            if len(chosen):
                mean[chosen], error[chosen] = _means(values, chosen, count // _SETS, crowded, grid)
    shape = (1, *grid.shape)
    walks = np.array([_equal_walks(mean, error, grid)], np.int64)
    return Tables(np.zeros((1, 0)), mean.reshape(shape), walks, error.reshape(shape))


def _near_mirror(bins: NDArray, grid: Grid) -> NDArray[np.bool_]:
    """Which bins lie close to the mirror direction of some wi of theirs."""
    i, a, o, b = _indices(bins, grid)
    near_o = _apart(i, grid.theta_i, o, grid.theta_o) < _REACH
    # Where both directions are close to the normal, half vectors are so at every azimuth.
    top = (i == grid.theta_i - 1) & (o == grid.theta_o - 1)
    if not grid.phi_i:
        return near_o & (b >= grid.phi_o - 2) | top
    return near_o & (_apart(a, grid.phi_i, b + grid.phi_o / 2, grid.phi_o, True) < 1.5) | top


def _apart(a: NDArray, n: int, b: NDArray, m: int, periodic: bool = False) -> NDArray[np.float64]:
    """How far apart the middles of bins `a` of `n` and `b` of `m` of one interval lie, in mean widths of a bin."""
    distance = (a + 0.5) / n - (b + 0.5) / m
    if periodic:
        distance = distance - np.round(distance)
    return np.abs(distance) / (0.5 / n + 0.5 / m)


def _indices(bins: Any, grid: Grid) -> tuple[Any, Any, Any, Any]:
    """(theta_i, phi_i, theta_o, phi_o) of flattened bins, on NumPy or Dr.Jit; phi_i is 0 in isotropic grids."""
    b, rest = bins % grid.phi_o, bins // grid.phi_o
    o, row = rest % grid.theta_o, rest // grid.theta_o
    azimuths = max(grid.phi_i, 1)
    return row // azimuths, row % azimuths, o, b


def _means(
    values: Values, bins: NDArray, count: int, crowded: bool, grid: Grid
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and standard error (bins, 3) from `_SETS` sets of `count` points each."""
    sets = np.stack([_moments(values, bins, count, crowded, grid, number) for number in range(_SETS)])
    finite = np.isfinite(sets).all(axis=(0, 2))
    if not finite.all():
        i, a, o, b = (int(k[0]) for k in _indices(bins[~finite], grid))
        place = (i, a, o, b) if grid.phi_i else (i, o, b)
        raise TableError(f"{values.name}: has values that are not finite, first in bin {place}")
    weight, square, value, product = sets[..., :1], sets[..., 1:2], sets[..., 2:5], sets[..., 5:]
    # The mean weight is known to be 1: take off what its deviation explains (a control variate). That makes the mean of
    # what hardly changes within a bin almost exact, whatever the weights.
    variance = np.mean(square - weight * weight, axis=0)
    covariance = np.mean(product - weight * value, axis=0)
    slope = np.where(variance > _UNWEIGHTED, covariance / np.maximum(variance, _UNWEIGHTED), 0.0)
    means = value - slope * (weight - 1.0)
    error = means.std(axis=0, ddof=1) / math.sqrt(_SETS)
    return means.mean(axis=0).astype(np.float32), error.astype(np.float32)


def _moments(
    values: Values, bins: NDArray, count: int, crowded: bool, grid: Grid, number: int
) -> NDArray[np.float64]:
    """Means (bins, 8) over one set of points of w, w^2, w f and w^2 f, w the weight and f the value in RGB.

    The points are a lattice, shifted at random for each bin, and their images under u -> 1 - u, which make the means of
    linear functions exact.
    """
    Float, UInt32 = dr.auto.Float, dr.auto.UInt32
    flat = UInt32(bins.astype(np.uint32))
    place = tuple(Float(k) for k in _indices(flat, grid))
    dimensions = 4 if grid.phi_i else 3
    seed, last = dr.opaque(UInt32, number), dr.opaque(UInt32, count)
    shifts = [quadrature.hashed(flat * dimensions + k, seed) for k in range(dimensions)]
    lattice = [Float(x.astype(np.float32)) for x in quadrature.lattice(count // 2, dimensions).T]

    def body(k: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        u = [quadrature.shifted(dr.gather(Float, x, k >> 1), s) for x, s in zip(lattice, shifts, strict=True)]
        u = [dr.select((k & 1) == 0, x, 1.0 - x) * (1.0 - 2.0 * _EDGE) + _EDGE for x in u]
        wi, wo, w = quadrature.points(place, u, grid, quadrature.FINEST if crowded else None)
        if not grid.phi_i:
            # A folded bin is both of its mirror halves: every other pair of points goes to the other one.
            wo = Vec3(wo.x, dr.select((k & 2) == 0, wo.y, -wo.y), wo.z)
        value = values.eval(wi, wo) * w
        return k + 1, [s + x for s, x in zip(sums, (w, w * w, *value, *(value * w)), strict=True)]

    zero = dr.zeros(Float, len(bins))
    state = (dr.zeros(UInt32, len(bins)), [zero] * 8)
    _, sums = dr.while_loop(state, lambda k, sums: k < last, body, mode="symbolic", label="bin means")
    return np.stack([s.numpy() for s in sums], axis=-1).astype(np.float64) / count


def _equal_walks(mean: NDArray, error: NDArray, grid: Grid) -> int:
    """How many walks leave a bin's error as small as it is, for the median of all bins."""
    noisy = (mean > 0) & (error > 0)
    if not noisy.any():
        return _NOISELESS
    # Counting statistics: error^2 = mean * rows / (walks * solid angle).
    walks = (
        mean[noisy].astype(np.float64) * grid.rows / (error[noisy].astype(np.float64) ** 2 * grid.solid_angle)
    )
    return int(np.clip(np.median(walks), 1, _NOISELESS))


class TableValues:
    """A table as a source (`Values`): every pair of directions has the value of its bin.

    Tabulated again it gives the same table. `smooth` interpolates between the middles of bins instead, which shows no
    steps in pictures, but widens peaks and changes the means.
    """

    def __init__(self, tables: Tables, number: int = 0, *, name: str = "table", smooth: bool = False):
        """The `number`-th material of `tables`. Raises `TableError` where there is none."""
        if not 0 <= number < len(tables.values):
            raise TableError(f"{name}: no material {number} among its {len(tables.values)}")
        table = tables.values[number]
        self.name, self.isotropic, self._smooth = name, table.ndim == 4, smooth
        self._sizes = table.shape[:-1]
        periodic = (False,) * 3 if self.isotropic else (False, True, False, True)
        self._lookup = Lookup(table, periodic)

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr]."""
        position = self._isotropic(wi, wo) if self.isotropic else self._anisotropic(wi, wo)
        position = [x * n for x, n in zip(position, self._sizes, strict=True)]
        value = self._lookup.linear(position) if self._smooth else self._lookup.nearest(position)
        return ops.select((wi.z > 0) & (wo.z > 0), Color(*value), Color.of(0.0))

    @staticmethod
    def _isotropic(wi: Vec3, wo: Vec3) -> list[Float]:
        """Position in a folded table, 0 .. 1 in each dimension."""
        azimuth = ops.atan2(wi.x * wo.y - wi.y * wo.x, wi.x * wo.x + wi.y * wo.y)
        return [wi.z, wo.z, ops.absolute(azimuth) * ops.INV_PI]

    @staticmethod
    def _anisotropic(wi: Vec3, wo: Vec3) -> list[Float]:
        """Position in a table of all four angles, 0 .. 1 in each dimension."""
        turns = [ops.atan2(w.y, w.x) * (0.5 * ops.INV_PI) for w in (wi, wo)]
        turns = [ops.select(t < 0, t + 1.0, t) for t in turns]
        return [wi.z, turns[0], wo.z, turns[1]]
