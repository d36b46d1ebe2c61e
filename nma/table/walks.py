"""Tables from random walks (paper eq. 9): walks start in every bin of wi and are counted in the bin where they end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import TableError
from nma.jit import dr
from nma.ops import Vec3
from nma.sources.base import Source, Walk
from nma.table.grid import ISOTROPIC, Grid, Tables

# Throughputs are summed as integers in units of 2^-16, because an integer sum does not depend on the order of addition.
_UNIT = 65536.0
# The most walks per row in one kernel launch. A 32-bit counter has room for 65535 walks of throughput 1. The limit is
# three quarters of 65535, because some throughputs may be above 1.
_WALKS_PER_ROW = 49151
# A kernel launch simulates as many materials as have this many bins together, but at least one material. The constant
# limits the memory of a launch, and does not change the result.
_BINS_PER_LAUNCH = 1 << 21


def tabulate(
    source: Source,
    params: NDArray[np.float64],
    walks: int,
    keys: NDArray[np.uint64],
    *,
    grid: Grid = ISOTROPIC,
    error: bool = True,
) -> Tables:
    """The tables of n materials, each from at least `walks` random walks.

    `params` (n, columns) are the materials' parameters. `keys` (n,), made by `stream_keys`, seed the random streams of
    the materials. A material with the same key gets the same table, whatever other materials are in the call. If
    `error` is false, the tables have no standard errors, which halves the memory that the call needs. Raises
    `ParamError` if parameters are not physically valid.
    """
    params = source.space.check(params)
    if walks < 1 or len(keys) != len(params):
        raise TableError(
            f"cannot tabulate {len(params)} material(s) from {walks} walks each with {len(keys)} key(s); "
            "give at least one walk, and one key per material"
        )
    total = grid.walks(walks)
    values = np.empty((len(params), grid.bins, 3), np.float32)
    standard_error = np.empty_like(values) if error else None
    group = max(1, _BINS_PER_LAUNCH // grid.bins)
    for first in range(0, len(params), group):
        part = slice(first, first + group)
        values[part], part_error = _tabulate_group(
            source, params[part], keys[part], total // grid.rows, grid, error
        )
        if standard_error is not None:
            standard_error[part] = part_error
    shape = (len(params), *grid.shape)
    if standard_error is not None:
        standard_error = standard_error.reshape(shape)
    walked = np.full(len(params), total, np.int64)
    return Tables(params, values.reshape(shape), walked, standard_error, source.space.name)


def stream_keys(seed: int, indices: NDArray[np.integer] | Sequence[int]) -> NDArray[np.uint64]:
    """The keys (n,) of the random streams of materials. A key depends only on `seed` and on the material's index."""
    return np.array(
        [np.random.SeedSequence((seed, int(i), 0x77A1)).generate_state(1, np.uint64)[0] for i in indices]
    )


def _tabulate_group(
    source: Source, params: NDArray, keys: NDArray, sweeps: int, grid: Grid, error: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Values and standard errors, each (n, bins, 3), from a number of sweeps. A sweep is one walk from every row.

    The sweeps are divided into kernel launches that are short enough for the 32-bit counters of the bins.
    """
    moments = np.zeros((2 if error else 1, len(params), grid.bins, 3))
    for first in range(0, sweeps, _WALKS_PER_ROW):
        moments += _launch(source, params, keys, first, min(_WALKS_PER_ROW, sweeps - first), grid, error)
    weight = sweeps * grid.solid_angle
    if not error:
        return moments[0] / weight, None
    sums, squares = moments
    # If all walks of a row end in one bin with the same throughput, the variance of their throughputs is 0, so the
    # variance of a single hit is used instead.
    variance = np.maximum(squares - sums * sums / sweeps, squares / sweeps)
    return sums / weight, np.sqrt(variance) / weight


def _launch(
    source: Source, params: NDArray, keys: NDArray, first: int, sweeps: int, grid: Grid, error: bool
) -> NDArray:
    """The sums (1, n, bins, 3) of throughputs over the sweeps `first` .. `first + sweeps - 1`.

    With `error`, the array also has the sums of the squared throughputs: (2, n, bins, 3).
    """
    Float, UInt32, UInt64 = dr.auto.Float, dr.auto.UInt32, dr.auto.UInt64
    n, sweeps, first = len(params), sweeps * max(grid.phi_i, 1), first * max(grid.phi_i, 1)
    thread = dr.arange(UInt32, n * sweeps)
    material = thread // dr.opaque(UInt32, sweeps)
    sweep = thread - material * dr.opaque(UInt32, sweeps)
    columns = [dr.gather(Float, Float(np.ascontiguousarray(c, np.float32)), material) for c in params.T]
    gathered = source.gather(columns)
    key = dr.gather(UInt64, UInt64(keys), material)
    # The random stream of a sweep depends only on the material's key and on the sweep's index.
    number = UInt64(sweep) + dr.opaque(UInt64, first)
    rng = dr.auto.PCG32(1, _mix(key ^ (number * 0x9E3779B97F4A7C15)), _mix(key + number))
    counters = [dr.zeros(UInt32, n * grid.bins * 3) for _ in range(2 if error else 1)]
    phi_row = sweep % grid.phi_i if grid.phi_i else UInt32(0)
    _sweep(source, gathered, rng, material * grid.bins, phi_row, counters, grid)
    dr.eval(*counters)
    return np.stack([c.numpy().reshape(n, grid.bins, 3) for c in counters]) / _UNIT


def _mix(x: Any) -> Any:
    """The finaliser of MurmurHash3, which maps neighbouring integers to unrelated integers."""
    x = (x ^ (x >> 33)) * 0xFF51AFD7ED558CCD
    x = (x ^ (x >> 33)) * 0xC4CEB9FE1A85EC53
    return x ^ (x >> 33)


@dataclass
class _State:
    """The state of the loop in which each Dr.Jit lane simulates its walks.

    A lane starts its next walk as soon as the previous walk has ended, so no lane idles.
    """

    rng: Any
    row: Any
    walk: Walk
    phi: Any


def _sweep(
    source: Source, params: Any, rng: Any, offset: Any, phi_row: Any, counters: list[Any], grid: Grid
) -> None:
    """In every lane, runs one walk from every row of theta_i.

    The throughputs are added to the bins of the lane's table, whose first bin has the index `offset`.
    """
    UInt32 = dr.auto.UInt32

    def begin(state: _State, fresh: Any) -> _State:
        """Starts a walk in the lanes `fresh`, from a random wi in the bin of the current row."""
        u_theta, u_phi = state.rng.next_float32(), state.rng.next_float32()
        cos_theta = (dr.auto.Float(state.row) + u_theta) * (1.0 / grid.theta_i)
        sin_theta = ops.safe_sqrt(1.0 - cos_theta * cos_theta)
        phi = (dr.auto.Float(phi_row) + u_phi) * (2.0 * math.pi / grid.phi_i) if grid.phi_i else state.phi
        wi = Vec3(sin_theta, sin_theta * 0.0, cos_theta)
        if grid.phi_i:
            wi = Vec3(sin_theta * dr.cos(phi), sin_theta * dr.sin(phi), cos_theta)
        walk = dr.select(fresh, Walk.arriving_from(wi), state.walk)
        return _State(state.rng, state.row, walk, dr.select(fresh, phi, state.phi))

    def body(state: _State) -> tuple[_State]:
        state = begin(state, ~state.walk.alive)
        walk = source.step(params, state.walk, state.rng)
        over = ~walk.alive
        index = (offset + bin_index(state.row, phi_row, Vec3(*walk.direction), grid)) * 3
        for channel, value in enumerate(walk.throughput):
            counted = over & (value > 0)
            for counter, moment in zip(counters, (value, value * value), strict=False):
                amount = UInt32(moment * _UNIT + 0.5)
                dr.scatter_reduce(dr.ReduceOp.Add, counter, amount, index + channel, counted)
        return (_State(state.rng, state.row + dr.select(over, UInt32(1), UInt32(0)), walk, state.phi),)

    zero = dr.zeros(dr.auto.Float, dr.width(offset))
    walk = Walk((zero, zero, zero), (zero, zero, zero), zero, zero > 1, zero > 1)
    state = _State(rng, dr.zeros(UInt32, dr.width(offset)), walk, zero)
    dr.while_loop((state,), lambda s: s.row < grid.theta_i, body, mode="symbolic", label="walks")


def bin_index(row: Any, phi_row: Any, wo: Vec3, grid: Grid) -> Any:
    """The flat index of the bin that contains wo. `row` and `phi_row` are the indices of the bin of wi."""
    UInt32 = dr.auto.UInt32
    o = dr.minimum(UInt32(dr.maximum(wo.z, 0.0) * grid.theta_o), grid.theta_o - 1)
    phi = ops.atan2(wo.y, wo.x)
    if grid.phi_i:
        turn = dr.select(phi < 0, phi + 2.0 * math.pi, phi) * (grid.phi_o / (2.0 * math.pi))
        row = row * grid.phi_i + phi_row
    else:
        turn = dr.abs(phi) * (grid.phi_o / math.pi)
    p = dr.minimum(UInt32(turn), grid.phi_o - 1)
    return (row * grid.theta_o + o) * grid.phi_o + p
