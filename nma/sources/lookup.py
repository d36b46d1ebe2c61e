"""Looks up values in a regular grid, at one position per Dr.Jit lane."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from importlib import import_module
from itertools import product
from operator import mul
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.jit import dr
from nma.ops import Float


class Lookup:
    """A regular grid in d dimensions, whose `cells` are an array of shape (n_1, ..., n_d, channels).

    A position is measured in cells: 0 .. n_k in dimension k. A `periodic` dimension wraps around. In a dimension that
    is not periodic, a position below 0 is replaced by 0, and a position above n_k by n_k. Positions may be of Dr.Jit
    types with or without derivatives, so that tabulation and rendering can use the same grid.
    """

    def __init__(self, cells: NDArray, periodic: Sequence[bool]):
        *self._sizes, self._channels = cells.shape
        self._periodic = tuple(periodic)
        # Dr.Jit loads all channels of a cell at once if the number of channels is a power of two, so unused channels
        # are added.
        self._packet = 1 << (self._channels - 1).bit_length()
        filled = np.zeros((*self._sizes, self._packet), np.float32)
        filled[..., : self._channels] = cells
        self._numbers = filled.ravel()
        self._loaded: dict[str, Any] = {}

    def nearest(self, position: Sequence[Float]) -> list[Float]:
        """The values of the cell that contains the position, one array per channel."""
        return self._gather([self._cell(k, dr.floor(x)) for k, x in enumerate(position)])

    def linear(self, position: Sequence[Float]) -> list[Float]:
        """The values at the position, interpolated linearly between the middles of cells, one array per channel."""
        total = [0.0 * position[0]] * self._channels
        for corner in self._corners(position):
            weights, cells = zip(*corner, strict=True)
            weight = reduce(mul, weights)
            total = [t + weight * number for t, number in zip(total, self._gather(cells), strict=True)]
        return total

    def _corners(self, position: Sequence[Float]) -> Iterator[tuple[tuple[Float, Any], ...]]:
        """The 2^d cells around the position. Each cell is given as one pair (weight, index) per dimension."""
        pairs = []
        for k, x in enumerate(position):
            low = dr.floor(x - 0.5)
            t = x - 0.5 - low
            pairs.append(((1.0 - t, self._cell(k, low)), (t, self._cell(k, low + 1.0))))
        return product(*pairs)

    def _cell(self, k: int, floor: Float) -> Any:
        """The index of a cell in dimension `k`, from a position `floor`, which may lie one cell beyond either end."""
        n, types = self._sizes[k], _types(floor)
        if self._periodic[k]:
            floor = dr.select(floor < 0, floor + n, dr.select(floor >= n, floor - n, floor))
        return types.UInt32(dr.clip(floor, 0, n - 1))

    def _gather(self, cells: Sequence[Any]) -> list[Float]:
        """The values of the cells whose indices are given as one array per dimension."""
        index = cells[0]
        for size, cell in zip(self._sizes[1:], cells[1:], strict=True):
            index = index * size + cell
        types = _types(index)
        if types.__name__ not in self._loaded:
            self._loaded[types.__name__] = types.Float(self._numbers)
        shape = (self._packet, dr.width(index))
        packet = dr.gather(types.ArrayXf, self._loaded[types.__name__], index, shape=shape)
        return [packet[c] for c in range(self._channels)]


def _types(lanes: Any) -> Any:
    """The Dr.Jit module that defines the type of the array `lanes`."""
    return import_module(type(lanes).__module__)
