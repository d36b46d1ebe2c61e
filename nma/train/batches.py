"""Draws batches of bins from tables in memory, with NumPy.

The batch of a step depends only on the seed and the step.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import Empty, Queue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma.table import ISOTROPIC, Grid, Tables
from nma.table.dataset import Settings, simulate_block
from nma.train.recipe import Recipe

# A stream replaces `STREAM_BLOCK` materials at once, so that the simulation has enough walks to run in parallel.
STREAM_BLOCK = 16


class Batch(NamedTuple):
    """The bins of one step.

    The last axis of an array is that of the rows, so that values per row broadcast along contiguous memory.
    """

    columns: NDArray[np.float32]  # (parameters, rows)
    mu: NDArray[np.float32]  # (rows,) cos(theta_i) at which the network runs, random in the bin `i`
    phi: NDArray[np.float32]  # (rows,) azimuth of wi, 0 for isotropic tables
    i: NDArray[np.float32]  # (rows,) index of the bin of cos(theta_i)
    a: NDArray[np.float32]  # (rows,) index of the bin of phi_i, 0 for isotropic tables
    o: NDArray[np.float32]  # (bins_per_row, rows) index of the bin of cos(theta_o)
    p: NDArray[np.float32]  # (bins_per_row, rows) index of the bin of the azimuth of wo
    shift: NDArray[np.float32]  # (3 or 4, bins_per_row, rows) random shift of the points' lattice
    # (bins_per_row, rows) weights of mean 1 that correct for the uneven choice of bins
    weight: NDArray[np.float32]
    value: NDArray[np.float32]  # (3, bins_per_row, rows) values of the table
    albedo: NDArray[np.float32]  # (3, rows) directional albedo at `mu`
    # (3, 2, rows) random shifts of the samples that estimate the target's albedo
    albedo_shift: NDArray[np.float32]
    quantum: NDArray[np.float32]  # (rows,) what one walk of throughput 1 adds to the value of a bin
    # (2, rows) width and index of the interface above the material, or (0, rows) for a class without an interface
    interface: NDArray[np.float32]


@dataclass
class Pool:
    """Tables from which batches are drawn."""

    params: NDArray[np.float32]
    values: NDArray[np.floating]
    walks: NDArray[np.int64]
    albedo: NDArray[np.float32]  # (materials, theta_i[, phi_i], 3)
    grid: Grid = ISOTROPIC
    interface: tuple[int, ...] = ()  # the columns of `params` that are the interface's width and index

    @staticmethod
    def of(tables: Tables) -> Pool:
        albedo = tables.albedo().astype(np.float32)
        params = tables.params.astype(np.float32)
        columns = tables.space.interface_columns
        return Pool(params, tables.values, tables.walks, albedo, tables.grid, columns)

    @staticmethod
    def numbered(tables: Tables) -> Pool:
        """Tables of materials whose only parameter is their index, as training of latent codes needs."""
        numbers = np.arange(len(tables.values), dtype=np.float32)[:, None]
        return replace(Pool.of(tables), params=numbers, interface=())

    def bins(self, m: NDArray, i: NDArray, a: NDArray, o: NDArray, p: NDArray) -> NDArray:
        """The values (..., 3) of some bins. Negative values become 0, because a BRDF is never negative."""
        rows = (m, i, a) if self.grid.phi_i else (m, i)
        return np.maximum(self.values[(*rows, o, p)], 0.0)

    def albedo_at(self, m: NDArray, i: NDArray, a: NDArray, mu: NDArray) -> NDArray:
        """The directional albedo (rows, 3) of materials `m` at cosines `mu` in the rows `i` (and `a`).

        Within a row, the albedo is interpolated by a straight line. The line's mean is the albedo of the row, and its
        slope is that between the two neighbouring rows.
        """
        last = self.grid.theta_i - 1
        above, below = np.minimum(i + 1, last), np.maximum(i - 1, 0)
        around = (a,) if self.grid.phi_i else ()
        slope = (self.albedo[(m, above, *around)] - self.albedo[(m, below, *around)]) / (above - below)[
            :, None
        ]
        return self.albedo[(m, i, *around)] + slope * (mu * self.grid.theta_i - i - 0.5)[:, None]


class Stream:
    """A pool of simulated materials. Every `refresh` steps, a block of new materials replaces the oldest block.

    The pool of a step depends only on the settings and the step, so that a resumed run gets the same materials.
    `settings.materials` is the size of the pool. A stream must be called with steps in ascending order.
    """

    def __init__(self, settings: Settings, refresh: int, first_step: int = 0):
        self._settings, self._refresh = settings, refresh
        self._block = min(STREAM_BLOCK, settings.materials)
        self._replaced = first_step // refresh
        oldest = self._replaced * self._block
        indices = np.arange(oldest, oldest + settings.materials)
        # Material k is stored at the index k modulo the size of the pool.
        tables = simulate_block(settings, indices[np.argsort(indices % settings.materials)])
        self._pool = Pool.of(tables)
        self._pool.values = self._pool.values.astype(np.float16)

    def __call__(self, step: int) -> Pool:
        """The pool at `step`."""
        while self._replaced < step // self._refresh:
            size, first = self._settings.materials, self._settings.materials + self._replaced * self._block
            indices = np.arange(first, first + self._block)
            tables = simulate_block(self._settings, indices)
            at = indices % size
            self._pool.params[at], self._pool.values[at] = tables.params, tables.values
            self._pool.albedo[at] = tables.albedo()
            self._replaced += 1
        return self._pool


class BinSampler:
    """Chooses bins of wo for rows (bins of wi), and computes the weight of each choice."""

    def __init__(self, law: str, grid: Grid = ISOTROPIC):
        self.grid = grid
        self.uniform_share = 1.0 if law == "uniform" else 0.5
        # In each coordinate, the probability of a bin is that of a Cauchy distribution around the mirror direction,
        # with a scale of 1.5 bins.
        steps = np.arange(grid.theta_o)
        near_o = 1.0 / (1.0 + ((steps[None, :] - steps[:, None]) / 1.5) ** 2)
        self._o = near_o / near_o.sum(axis=1, keepdims=True)
        # Distance in bins from the azimuth of the mirror direction. In isotropic tables, whose azimuths are folded, the
        # mirror direction is in the last bin. In anisotropic tables, the distance is counted in both directions around
        # the circle, and the smaller count is used.
        steps = np.arange(grid.phi_o)
        steps = np.minimum(steps, grid.phi_o - steps) if grid.phi_i else grid.phi_o - 1 - steps
        near_p = 1.0 / (1.0 + (steps / 1.5) ** 2)
        self._p = near_p / near_p.sum()
        self._cdf_o = np.cumsum(self._o, axis=1)
        self._cdf_p = np.cumsum(self._p)

    def draw(
        self, rng: np.random.Generator, i: NDArray, a: NDArray, count: int
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Chooses `count` bins of wo for each row (`i`, `a`), where `i` and `a` are (rows,).

        Returns (o, p, weight), each (count, rows).
        """
        u = rng.random((2, count, len(i)))
        o = (u[0] * self.grid.theta_o).astype(np.int64)
        p = (u[1] * self.grid.phi_o).astype(np.int64)
        split = round(count * self.uniform_share)
        near = np.broadcast_to(self._mirror_o(i), (count - split, len(i)))
        o[split:] = (u[0, split:, :, None] > self._cdf_o[near]).sum(axis=-1)
        p[split:] = np.searchsorted(self._cdf_p, u[1, split:])
        o, p = np.minimum(o, self.grid.theta_o - 1), np.minimum(p, self.grid.phi_o - 1)
        bins = self.grid.theta_o * self.grid.phi_o
        share = split / count
        density = share / bins + (1.0 - share) * self._o[self._mirror_o(i)[None, :], o] * self._p[p]
        if self.grid.phi_i:
            p = (p + self._mirror_p(a)) % self.grid.phi_o
        return o, p, 1.0 / (bins * density)

    def _mirror_o(self, i: NDArray) -> NDArray:
        """The index of the theta_o bin that contains the mirror direction of the middle of the theta_i bin `i`."""
        return (2 * i + 1) * self.grid.theta_o // (2 * self.grid.theta_i)

    def _mirror_p(self, a: NDArray) -> NDArray:
        """The index of the phi_o bin that contains the mirror direction of the middle of the phi_i bin `a`."""
        return (2 * a + 1) * self.grid.phi_o // (2 * self.grid.phi_i) + self.grid.phi_o // 2


def draw(pool: Pool, sampler: BinSampler, recipe: Recipe, step: int) -> Batch:
    """The batch of one step."""
    rng = np.random.default_rng((recipe.seed, step, 0xB17))
    m = rng.integers(len(pool.params), size=recipe.rows)
    i = rng.integers(pool.grid.theta_i, size=recipe.rows)
    a = rng.integers(pool.grid.phi_i, size=recipe.rows) if pool.grid.phi_i else np.zeros_like(i)
    o, p, weight = sampler.draw(rng, i, a, recipe.bins_per_row)
    mu = (i + rng.random(recipe.rows)) / pool.grid.theta_i
    phi = 0.0 * mu
    if pool.grid.phi_i:
        phi = (a + rng.random(recipe.rows)) * (2.0 * np.pi / pool.grid.phi_i)
    f32 = np.float32
    columns = np.ascontiguousarray(pool.params[m].T)
    return Batch(
        columns,
        mu.astype(f32),
        phi.astype(f32),
        i.astype(f32),
        a.astype(f32),
        o.astype(f32),
        p.astype(f32),
        rng.random((4 if pool.grid.phi_i else 3, *o.shape), dtype=f32),
        weight.astype(f32),
        np.moveaxis(pool.bins(m, i, a, o, p), -1, 0).astype(f32),
        pool.albedo_at(m, i, a, mu).T.astype(f32),
        rng.random((3, 2, recipe.rows), dtype=f32),
        (pool.grid.rows / (pool.walks[m] * pool.grid.solid_angle)).astype(f32),
        columns[list(pool.interface)],
    )


def batches(
    source: Callable[[int], Any], start: int, stop: int, group: int
) -> Generator[tuple[int, Any], None, None]:
    """Yields (first step, stacked batches of `group` steps) from `start` to `stop`.

    A thread prepares the batches in advance. Close the generator to end the thread.
    """
    queue: Queue = Queue(maxsize=2)
    stopped = threading.Event()

    def produce() -> None:
        try:
            for first in range(start, stop, group):
                steps = [source(s) for s in range(first, min(first + group, stop))]
                stacked = type(steps[0])(*(np.stack(parts) for parts in zip(*steps, strict=True)))
                queue.put((first, stacked))
                if stopped.is_set():
                    return
            queue.put(None)
        except BaseException as e:  # the exception is passed to the consumer, which raises it
            queue.put(e)

    thread = threading.Thread(target=produce, daemon=True)
    thread.start()
    try:
        while (item := queue.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        # If the consumer stops early, the thread would wait forever for room in the queue, so the queue is emptied.
        stopped.set()
        while thread.is_alive():
            with suppress(Empty):
                queue.get(timeout=0.01)
