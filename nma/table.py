"""BSDF tables with bins uniform in solid angle: accumulated from walks (paper eq. 9), saved, loaded, integrated.

Isotropic tables have shape (n, theta_i, theta_o, phi, 3): bins uniform in cos(theta_i) and cos(theta_o), index 0 at
grazing, and in the azimuth between wi and wo folded to [0, pi], mirror direction last. Anisotropic ones have shape
(n, theta_i, phi_i, theta_o, phi_o, 3) with azimuths over [0, 2 pi). A value is the mean of f cos(theta_o) over its
bin [1/sr].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import OutputError, TableError
from nma.files import arrays, whole
from nma.jit import dr
from nma.ops import Vec3
from nma.sources.base import Source, Walk

# Throughputs are counted as integers in units of 2^-16: integer sums do not depend on the order of the additions.
_UNIT = 65536.0
# So many walks of one row fit one 32-bit bin, all of them with throughput 1, and leave room for some above 1.
_WALKS_PER_ROW = 49151
# Bins that one launch counts in, over all of its materials: bounds the memory, has no influence on the result.
_BINS_PER_LAUNCH = 1 << 21


@dataclass(frozen=True)
class Grid:
    """Resolution of a table. `phi_i == 0` means isotropic and folded."""

    theta_i: int = 40
    theta_o: int = 40
    phi_o: int = 40
    phi_i: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one material's table, RGB last."""
        rows = (self.theta_i, self.phi_i) if self.phi_i else (self.theta_i,)
        return (*rows, self.theta_o, self.phi_o, 3)

    @property
    def rows(self) -> int:
        """Number of bins of wi."""
        return self.theta_i * max(self.phi_i, 1)

    @property
    def bins(self) -> int:
        return self.rows * self.theta_o * self.phi_o

    @property
    def solid_angle(self) -> float:
        """Solid angle of a bin of wo [sr]; a folded bin counts both of its mirror halves."""
        return 2.0 * math.pi / (self.theta_o * self.phi_o)

    def walks(self, wanted: int) -> int:
        """`wanted` rounded up to the same number of walks in every row."""
        return -(-wanted // self.rows) * self.rows


ISOTROPIC = Grid()
ANISOTROPIC = Grid(phi_o=80, phi_i=80)


@dataclass
class Tables:
    """Tables of n materials, float32 `values` (n, *grid.shape), their standard `error` or None, and `walks` of each."""

    params: NDArray[np.float64]
    values: NDArray[np.floating]
    walks: NDArray[np.int64]
    error: NDArray[np.floating] | None = None

    @property
    def grid(self) -> Grid:
        """The resolution, from the shape of `values`."""
        theta_i, *phi_i, theta_o, phi_o, _ = self.values.shape[1:]
        return Grid(theta_i, theta_o, phi_o, *phi_i)

    def albedo(self) -> NDArray[np.float64]:
        """Directional albedo (n, theta_i[, phi_i], 3): 2 pi times the mean over the bins of wo."""
        return 2.0 * math.pi * self.values.mean(axis=(-3, -2), dtype=np.float64)

    def __getitem__(self, chosen: slice | NDArray) -> Tables:
        """The tables of some materials, by a slice or by their numbers."""
        error = None if self.error is None else self.error[chosen]
        return Tables(self.params[chosen], self.values[chosen], self.walks[chosen], error)

    @staticmethod
    def concatenate(parts: Sequence[Tables]) -> Tables:
        """One after the other; all of them with errors, or none."""
        errors = [t.error for t in parts if t.error is not None]
        if errors and len(errors) < len(parts):
            raise TableError("some of the tables have standard errors, others have none")
        return Tables(
            np.concatenate([t.params for t in parts]),
            np.concatenate([t.values for t in parts]),
            np.concatenate([t.walks for t in parts]),
            np.concatenate(errors) if errors else None,
        )

    def save(self, path: str | Path) -> None:
        """Writes the reference-file format of CONVENTIONS.md, atomically."""
        arrays: dict[str, Any] = {"params": self.params, "table": self.values, "walks": self.walks}
        if self.error is not None:
            arrays["error"] = self.error
        with whole(path) as partial, partial.open("wb") as f:
            np.savez_compressed(f, **arrays)

    @staticmethod
    def load(path: str | Path) -> Tables:
        """Reads a reference file; `TableError` says what is wrong with it."""
        path = Path(path)
        try:
            with arrays(path) as f:
                params, values, walks = f["params"], f["table"], f["walks"]
                error = f["error"] if "error" in f else None
        except FileNotFoundError:
            raise TableError(f"{path}: no such file; `nma simulate` writes reference files") from None
        except (KeyError, ValueError, OSError, EOFError) as e:
            raise TableError(
                f"{path}: not a reference file (.npz with params, table and walks): {e}"
            ) from None
        except Exception as e:  # zipfile and zlib raise their own kinds for damaged archives
            raise TableError(f"{path}: damaged archive: {e}") from None
        _check_arrays(path, params, values, walks, error)
        walks = np.broadcast_to(walks, len(params)).astype(np.int64)
        return Tables(params.astype(np.float64), values, walks, error)


def kept(path: Path, make: Callable[[], Tables], params: NDArray[np.float64] | None = None) -> Tables:
    """The tables that an earlier run left in a file, or those of `make`, which are left there for a later one.

    A damaged file is made anew, and so is one of other `params`, if those are given.
    """
    with suppress(TableError):
        found = Tables.load(path)
        if params is None or np.array_equal(found.params, params):
            return found
    made = make()
    try:
        made.save(path)
    except OutputError:
        # Another run for the same output may have ended and taken the folder away.
        made.save(path)
    return made


def _check_arrays(
    path: Path, params: NDArray, values: NDArray, walks: NDArray, error: NDArray | None
) -> None:
    """Refuses arrays that are no reference file, naming the first fault."""
    n = len(params) if params.ndim else 0
    arrays = {"params": params, "table": values, "walks": walks} | ({} if error is None else {"error": error})
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise TableError(f"{path}: {name} holds {array.dtype}, not numbers")
    if params.ndim != 2 or values.ndim not in (5, 6) or values.shape[0] != n or values.shape[-1] != 3:
        raise TableError(f"{path}: params {params.shape} and table {values.shape} do not belong together")
    if error is not None and error.shape != values.shape:
        raise TableError(f"{path}: error has shape {error.shape}, table has {values.shape}")
    if walks.shape not in ((), (1,), (n,)) or not (walks > 0).all():
        raise TableError(f"{path}: walks must be one positive number, or {n}; it has shape {walks.shape}")
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise TableError(f"{path}: {name} of material {row} is not finite; simulate it again")


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
