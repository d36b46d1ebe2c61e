"""BSDF tables with bins uniform in solid angle: their grid, and tables as files.

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

from nma.errors import OutputError, TableError
from nma.files import arrays, whole


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
