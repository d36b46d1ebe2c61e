"""Signed errors of brightness over cos(theta_i) and over cos(theta_o).

The energy of a band of directions is the sum of f cos(theta_o) over the band's bins and over R, G and B. All bins have
the same solid angle, so the sum is proportional to the light that a uniform sky reflects there. The signed error of a
band is the energy of the adapter over the energy of the reference, minus 1: positive where the adapter is too bright.
Bins count by their energy, so dark bins with large relative errors do not decide.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The number of bands, which are uniform in the cosine.
BANDS = 5


class Energy(NamedTuple):
    """The energy of tables in each band: (..., BANDS) each, first the band at grazing angles."""

    theta_i: NDArray[np.float64]
    theta_o: NDArray[np.float64]


class Brightness(NamedTuple):
    """Signed errors of brightness, (BANDS,) each, first the band at grazing angles; NaN where the reference is
    black."""

    theta_i: list[float]
    theta_o: list[float]


def band_ends() -> list[tuple[float, float]]:
    """Returns the lowest and the highest cosine of each band."""
    return [(n / BANDS, (n + 1) / BANDS) for n in range(BANDS)]


def energy(table: NDArray) -> Energy:
    """Returns the energies of tables (..., theta_i, theta_o, phi, 3). The bins of a cosine are split evenly."""
    rows = table.astype(np.float64).sum(axis=(-2, -1))
    return Energy(_bands(rows.sum(axis=-1)), _bands(rows.sum(axis=-2)))


def _bands(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values.reshape(*values.shape[:-1], BANDS, -1).sum(axis=-1)


def signed_errors(adapter: Energy, reference: Energy) -> Brightness:
    """Returns the signed errors of brightness. Energies of several materials, (n, BANDS), are added up first."""
    return Brightness(*(_relative(a, b) for a, b in zip(adapter, reference, strict=True)))


def _relative(a: NDArray[np.float64], b: NDArray[np.float64]) -> list[float]:
    a, b = (x.reshape(-1, BANDS).sum(axis=0) for x in (a, b))
    return np.where(b > 0.0, a / np.where(b > 0.0, b, 1.0) - 1.0, np.nan).tolist()
