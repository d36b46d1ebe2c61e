"""Makes tables of sources that can be evaluated (`Values`), and evaluates tables as such sources.

The value of a bin is the mean of f cos(theta_o) over fixed points in the bin. A table can be evaluated, too: the value
at a pair of directions is the value of the bin that contains the pair.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import TableError
from nma.jit import dr
from nma.lattice import lattice_points
from nma.ops import Color, Float, Vec3
from nma.params import MEASURED
from nma.sources.base import Values
from nma.sources.lookup import Lookup
from nma.table import quadrature
from nma.table.grid import ISOTROPIC, Grid, Tables

# The default number of points per bin. Bins near the mirror direction contain the peaks of smooth materials, so they
# get `_NEAR` times as many points, with a density that increases towards the mirror direction. The additional points
# cost little time, because few bins are near the mirror direction.
POINTS = 128
_NEAR = 32
# A bin counts as near the mirror direction if its theta_o is less than `_REACH` bins away from that direction.
_REACH = 4.5

# A bin's points are divided into `_SETS` independent sets. The spread of the sets' means gives the standard error.
_SETS = 4
# The number of points must be a multiple of `_MULTIPLE`, so that all sets have equally many points, and each set has
# equally many pairs of points in both mirror halves of a bin.
_MULTIPLE = 16
# Points keep a distance of `_EDGE` bin widths from the edges of the bin, so that rounding moves no point into the next
# bin.
_EDGE = 1e-5

# If the variance of the weights is below `_UNWEIGHTED`, the weights count as equal, because only rounding makes them
# differ.
_UNWEIGHTED = 1e-4

# The most bins in one kernel launch, which limits the memory and does not change the result.
_BINS_PER_LAUNCH = 1 << 20

# The number of walks (`walks`) of a table without any noise.
_NOISELESS = 1 << 40


def tabulate_values(values: Values, *, grid: Grid = ISOTROPIC, points: int = POINTS) -> Tables:
    """Makes the table of one source. The table's `params` have the shape (1, 0).

    A bin's value is the mean over `points` points (a multiple of 16), evenly spread in the bin. Bins near the mirror
    direction have 32 times as many points, with a density that increases towards the mirror direction, down to the
    scale of the narrowest lobe. Equal arguments give equal tables. The table's `error` is the standard error, estimated
    from four independent sets of points. `error` includes neither rounding nor errors of the source itself, such as the
    noise of a measurement. The table's `walks` is an upper bound of the number of random walks that would give a bin
    the same standard error (`_equal_walks`). The number is the median over all bins, and at most 2^40.

    Raises `TableError` for an anisotropic source on an isotropic grid, for a wrong number of points, and for values
    that are not finite.
    """
    if not (values.isotropic or grid.phi_i):
        raise TableError(
            f"{values.name} is anisotropic, but the grid is isotropic; use a grid with azimuths of wi, such as "
            "nma.table.ANISOTROPIC"
        )
    if points < 1 or points % _MULTIPLE:
        raise TableError(f"cannot tabulate from {points} point(s) per bin; choose a multiple of {_MULTIPLE}")
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
    return Tables(np.zeros((1, 0)), mean.reshape(shape), walks, error.reshape(shape), MEASURED.name)


def _near_mirror(bins: NDArray, grid: Grid) -> NDArray[np.bool_]:
    """Marks the bins whose wo may be close to the mirror direction of their wi."""
    i, a, o, b = _indices(bins, grid)
    near_o = _apart(i, grid.theta_i, o, grid.theta_o) < _REACH
    # If both directions are close to the normal, the half vector is close to the normal, too, whatever the azimuths
    # are. So, if theta_i and theta_o are in the bins nearest to the normal, wo counts as near the mirror direction at
    # every azimuth.
    top = (i == grid.theta_i - 1) & (o == grid.theta_o - 1)
    if not grid.phi_i:
        return near_o & (b >= grid.phi_o - 2) | top
    return near_o & (_apart(a, grid.phi_i, b + grid.phi_o / 2, grid.phi_o, True) < 1.5) | top


def _apart(a: NDArray, n: int, b: NDArray, m: int, periodic: bool = False) -> NDArray[np.float64]:
    """Distance from the middle of bin `a` (of `n` bins) to the middle of bin `b` (of `m` bins), in mean bin widths.

    The `n` bins and the `m` bins divide the same interval.
    """
    distance = (a + 0.5) / n - (b + 0.5) / m
    if periodic:
        distance = distance - np.round(distance)
    return np.abs(distance) / (0.5 / n + 0.5 / m)


def _indices(bins: Any, grid: Grid) -> tuple[Any, Any, Any, Any]:
    """The indices (theta_i, phi_i, theta_o, phi_o) of bins, from their flat indices, in NumPy or Dr.Jit.

    In isotropic grids phi_i is 0.
    """
    b, rest = bins % grid.phi_o, bins // grid.phi_o
    o, row = rest % grid.theta_o, rest // grid.theta_o
    azimuths = max(grid.phi_i, 1)
    return row // azimuths, row % azimuths, o, b


def _means(
    values: Values, bins: NDArray, count: int, crowded: bool, grid: Grid
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The mean and the standard error of each bin, both (bins, 3), from `_SETS` sets of `count` points per bin."""
    sets = np.stack([_moments(values, bins, count, crowded, grid, number) for number in range(_SETS)])
    finite = np.isfinite(sets).all(axis=(0, 2))
    if not finite.all():
        i, a, o, b = (int(k[0]) for k in _indices(bins[~finite], grid))
        place = (i, a, o, b) if grid.phi_i else (i, o, b)
        raise TableError(f"{values.name}: has values that are not finite, first in bin {place}")
    weight, square, value, product = sets[..., :1], sets[..., 1:2], sets[..., 2:5], sets[..., 5:]
    # The weights serve as a control variate, because their expected value is known to be 1. If the mean weight of a set
    # is not 1, the mean value of the set has an error that is correlated with the difference of the mean weight from 1.
    # The correlated part of the error is subtracted. If the source hardly changes within a bin, the mean value becomes
    # almost exact.
    variance = np.mean(square - weight * weight, axis=0)
    covariance = np.mean(product - weight * value, axis=0)
    slope = np.where(variance > _UNWEIGHTED, covariance / np.maximum(variance, _UNWEIGHTED), 0.0)
    means = value - slope * (weight - 1.0)
    error = means.std(axis=0, ddof=1) / math.sqrt(_SETS)
    return means.mean(axis=0).astype(np.float32), error.astype(np.float32)


def _moments(
    values: Values, bins: NDArray, count: int, crowded: bool, grid: Grid, number: int
) -> NDArray[np.float64]:
    """The means (bins, 8) of w, w^2, w f and w^2 f over one set of points; w is the weight and f the RGB value.

    The points are those of a lattice, shifted at random for each bin, and the mirror image 1 - u of each point u. With
    these pairs of points, the means of linear functions are exact.
    """
    Float, UInt32 = dr.auto.Float, dr.auto.UInt32
    flat = UInt32(bins.astype(np.uint32))
    place = tuple(Float(k) for k in _indices(flat, grid))
    dimensions = 4 if grid.phi_i else 3
    seed, last = dr.opaque(UInt32, number), dr.opaque(UInt32, count)
    shifts = [quadrature.hashed(flat * dimensions + k, seed) for k in range(dimensions)]
    lattice = [Float(x.astype(np.float32)) for x in lattice_points(count // 2, dimensions).T]

    def body(k: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        u = [quadrature.shifted(dr.gather(Float, x, k >> 1), s) for x, s in zip(lattice, shifts, strict=True)]
        u = [dr.select((k & 1) == 0, x, 1.0 - x) * (1.0 - 2.0 * _EDGE) + _EDGE for x in u]
        wi, wo, w = quadrature.points(place, u, grid, quadrature.FINEST if crowded else None)
        if not grid.phi_i:
            # A folded bin consists of two mirror halves. Every second pair of points goes to the second mirror half of
            # the bin.
            wo = Vec3(wo.x, dr.select((k & 2) == 0, wo.y, -wo.y), wo.z)
        value = values.eval(wi, wo) * w
        return k + 1, [s + x for s, x in zip(sums, (w, w * w, *value, *(value * w)), strict=True)]

    zero = dr.zeros(Float, len(bins))
    state = (dr.zeros(UInt32, len(bins)), [zero] * 8)
    _, sums = dr.while_loop(state, lambda k, sums: k < last, body, mode="symbolic", label="bin means")
    return np.stack([s.numpy() for s in sums], axis=-1).astype(np.float64) / count


def _equal_walks(mean: NDArray, error: NDArray, grid: Grid) -> int:
    """An upper bound of the number of random walks that would give a bin its standard error: the median over all bins.

    The number is exact for walks of weight 1. Walks of smaller weights have less noise, so fewer walks would do.
    """
    noisy = (mean > 0) & (error > 0)
    if not noisy.any():
        return _NOISELESS
    # For random walks of weight 1, counting statistics give error^2 = mean * rows / (walks * solid angle).
    walks = (
        mean[noisy].astype(np.float64) * grid.rows / (error[noisy].astype(np.float64) ** 2 * grid.solid_angle)
    )
    return int(np.clip(np.median(walks), 1, _NOISELESS))


class TableValues:
    """A table as a source (`Values`): every pair of directions has the value of its bin.

    Without `smooth`, `tabulate_values` of this source returns the same table again. With `smooth`, values are
    interpolated linearly between the middles of the bins. Interpolation avoids steps in rendered images, but it widens
    peaks and changes the means over bins.
    """

    def __init__(self, tables: Tables, number: int = 0, *, name: str = "table", smooth: bool = False):
        """Takes the table of the material with the index `number`. Raises `TableError` if there is no such material."""
        if not 0 <= number < len(tables.values):
            raise TableError(
                f"{name}: no material {number} among its {len(tables.values)} materials, counted from 0"
            )
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
        """The position of a pair of directions in an isotropic table, 0 .. 1 in each dimension."""
        azimuth = ops.atan2(wi.x * wo.y - wi.y * wo.x, wi.x * wo.x + wi.y * wo.y)
        return [wi.z, wo.z, ops.absolute(azimuth) * ops.INV_PI]

    @staticmethod
    def _anisotropic(wi: Vec3, wo: Vec3) -> list[Float]:
        """The position of a pair of directions in an anisotropic table, 0 .. 1 in each dimension."""
        turns = [ops.atan2(w.y, w.x) * (0.5 * ops.INV_PI) for w in (wi, wo)]
        turns = [ops.select(t < 0, t + 1.0, t) for t in turns]
        return [wi.z, turns[0], wo.z, turns[1]]
