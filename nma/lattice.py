"""Spreads points evenly over the unit cube, for quadrature.

The points are Kronecker lattices. See Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# _ROOTS maps each number of dimensions d to the positive root of x^(d+1) = x + 1.
_ROOTS = {2: 1.324717957244746, 3: 1.2207440846057596, 4: 1.1673039782614187}


def lattice_steps(dimensions: int) -> tuple[float, ...]:
    """The step from one point of the lattice to the next, modulo 1. Component k = 0, 1, ... is root^-(k + 1), with the
    root from `_ROOTS`."""
    return tuple(_ROOTS[dimensions] ** -(k + 1) for k in range(dimensions))


def lattice_points(n: int, dimensions: int = 3) -> NDArray[np.float64]:
    """The first `n` points of the lattice, (n, 2, 3 or 4): 0.5 + k * lattice_steps for k = 0, 1, ..., modulo 1.

    Quadratures shift the points by random numbers, modulo 1, which makes the estimates unbiased.
    """
    return (np.arange(n)[:, None] * np.array(lattice_steps(dimensions)) + 0.5) % 1.0
