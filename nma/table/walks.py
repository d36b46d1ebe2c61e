"""Tables from random walks (paper eq. 9): walks start in every bin of wi and are counted where they end."""

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

# Throughputs are counted as integers in units of 2^-16: integer sums do not depend on the order of the additions.
_UNIT = 65536.0
# So many walks of one row fit one 32-bit bin, all of them with throughput 1, and leave room for some above 1.
_WALKS_PER_ROW = 49151
# Bins that one launch counts in, over all of its materials: bounds the memory, has no influence on the result.
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
    """Tables of `params` (n, columns) from at least `walks` walks each.

    `keys` (n,), from `stream_keys`, seed the materials' random streams: equal key, equal table, whatever else is in the
    call. Without `error` no standard errors are counted, which takes half of the memory. Raises `ParamError` for
    parameters that are not physically valid.
    """
    params = source.space.check(params)
    if walks < 1 or len(keys) != len(params):
        raise TableError(
            f"cannot tabulate {len(params)} material(s) from {walks} walks each with {len(keys)} key(s)"
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
    return Tables(params, values.reshape(shape), np.full(len(params), total, np.int64), standard_error)


def stream_keys(seed: int, indices: NDArray[np.integer] | Sequence[int]) -> NDArray[np.uint64]:
    """Random-stream keys of materials: each depends on the seed and the material's own index alone."""
    return np.array(
        [np.random.SeedSequence((seed, int(i), 0x77A1)).generate_state(1, np.uint64)[0] for i in indices]
    )


def _tabulate_group(
    source: Source, params: NDArray, keys: NDArray, sweeps: int, grid: Grid, error: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Values and standard errors (n, bins, 3) from so many sweeps over all rows, in launches that overflow no bin."""
    moments = np.zeros((2 if error else 1, len(params), grid.bins, 3))
    for first in range(0, sweeps, _WALKS_PER_ROW):
        moments += _launch(source, params, keys, first, min(_WALKS_PER_ROW, sweeps - first), grid, error)
    weight = sweeps * grid.solid_angle
    if not error:
        return moments[0] / weight, None
    sums, squares = moments
    # Where every walk hits the bin alike, take the variance of a single hit.
    variance = np.maximum(squares - sums * sums / sweeps, squares / sweeps)
    return sums / weight, np.sqrt(variance) / weight


def _launch(
    source: Source, params: NDArray, keys: NDArray, first: int, sweeps: int, grid: Grid, error: bool
) -> NDArray:
    """Sums of throughputs and, for the error, of their squares (1 or 2, n, bins, 3) over the sweeps from `first` on."""
    Float, UInt32, UInt64 = dr.auto.Float, dr.auto.UInt32, dr.auto.UInt64
    n, sweeps, first = len(params), sweeps * max(grid.phi_i, 1), first * max(grid.phi_i, 1)
    thread = dr.arange(UInt32, n * sweeps)
    material = thread // dr.opaque(UInt32, sweeps)
    sweep = thread - material * dr.opaque(UInt32, sweeps)
    columns = [dr.gather(Float, Float(np.ascontiguousarray(c, np.float32)), material) for c in params.T]
    gathered = source.gather(columns)
    key = dr.gather(UInt64, UInt64(keys), material)
    # A sweep's stream is a function of its material's key and its own number.
    number = UInt64(sweep) + dr.opaque(UInt64, first)
    rng = dr.auto.PCG32(1, _mix(key ^ (number * 0x9E3779B97F4A7C15)), _mix(key + number))
    counters = [dr.zeros(UInt32, n * grid.bins * 3) for _ in range(2 if error else 1)]
    phi_row = sweep % grid.phi_i if grid.phi_i else UInt32(0)
    _sweep(source, gathered, rng, material * grid.bins, phi_row, counters, grid)
    dr.eval(*counters)
    return np.stack([c.numpy().reshape(n, grid.bins, 3) for c in counters]) / _UNIT


def _mix(x: Any) -> Any:
    """Finaliser of MurmurHash3: neighbouring inputs, unrelated outputs."""
    x = (x ^ (x >> 33)) * 0xFF51AFD7ED558CCD
    x = (x ^ (x >> 33)) * 0xC4CEB9FE1A85EC53
    return x ^ (x >> 33)


@dataclass
class _State:
    """A lane's progress through its sweep: it starts its next walk as soon as one is over, so that no lane idles."""

    rng: Any
    row: Any
    walk: Walk
    phi: Any


def _sweep(
    source: Source, params: Any, rng: Any, offset: Any, phi_row: Any, counters: list[Any], grid: Grid
) -> None:
    """One walk from every row of theta_i, in every lane, counted in the table at `offset`."""
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
    """Index in a flattened table of the bin of wo, for wi in the bins `row` of theta_i and `phi_row` of phi_i."""
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
