"""Reads the indices of refraction of real metals from a table that the package contains."""

import csv
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

__all__ = ["Conductors", "load_conductors"]


@dataclass(frozen=True)
class Conductors:
    """Complex indices of refraction eta + i k of real conductors, in linear sRGB.

    `names` has n entries. `eta` (.038 .. 7.51) and `k` (.114 .. 9.22) are (n, 3) float64, unitless. `held_out` is (n,)
    bool, true for the metals that are excluded from training. All three arrays are read-only.
    """

    names: tuple[str, ...]
    eta: np.ndarray
    k: np.ndarray
    held_out: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def distinct(self) -> np.ndarray:
        """The indices of the table's rows in ascending order, without rows that repeat an earlier row. Some substances
        are in the table twice, under two names."""
        _, first = np.unique(np.hstack([self.eta, self.k]), axis=0, return_index=True)
        return np.sort(first)


@cache
def load_conductors() -> Conductors:
    """The metals of `conductors.csv`, in file order. tools/make_conductors.py wrote that file from Mitsuba's
    data/ior."""
    lines = files(__name__).joinpath("conductors.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))

    def columns(*keys: str) -> np.ndarray:
        values = np.array([[float(row[key]) for key in keys] for row in rows])
        values.flags.writeable = False
        return values

    held_out = columns("held_out")[:, 0] > 0
    held_out.flags.writeable = False
    return Conductors(
        names=tuple(row["name"] for row in rows),
        eta=columns("eta_r", "eta_g", "eta_b"),
        k=columns("k_r", "k_g", "k_b"),
        held_out=held_out,
    )
