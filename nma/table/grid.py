"""BSDF tables whose bins have equal solid angles: their grid and their files.

Isotropic tables have shape (n, theta_i, theta_o, phi, 3). The bins of isotropic tables are uniform in cos(theta_i), in
cos(theta_o) and in the azimuth between wi and wo. Index 0 of either cosine is at grazing angles. The azimuth is folded
to [0, pi], so the mirror direction is in the last bin. Anisotropic tables have shape (n, theta_i, phi_i, theta_o,
phi_o, 3), with azimuths over [0, 2 pi). The value of a bin is the mean of f cos(theta_o) over the bin [1/sr].
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

from nma import sources
from nma.errors import OutputError, ParamError, TableError, shown
from nma.files import arrays, whole
from nma.params import ParamSpace


@dataclass(frozen=True)
class Grid:
    """The number of bins of a table in each dimension.

    `phi_i == 0` means an isotropic table, whose azimuth is folded.
    """

    theta_i: int = 40
    theta_o: int = 40
    phi_o: int = 40
    phi_i: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one material's table; the last dimension is RGB."""
        rows = (self.theta_i, self.phi_i) if self.phi_i else (self.theta_i,)
        return (*rows, self.theta_o, self.phi_o, 3)

    @property
    def rows(self) -> int:
        """The number of bins of wi."""
        return self.theta_i * max(self.phi_i, 1)

    @property
    def bins(self) -> int:
        """The number of pairs of a bin of wi and a bin of wo."""
        return self.rows * self.theta_o * self.phi_o

    @property
    def solid_angle(self) -> float:
        """The solid angle [sr] of a bin of wo, including both mirror halves if the bin is folded."""
        return 2.0 * math.pi / (self.theta_o * self.phi_o)

    def walks(self, wanted: int) -> int:
        """The number `wanted`, rounded up to a multiple of `rows`, so that every row gets the same number of walks."""
        return -(-wanted // self.rows) * self.rows


ISOTROPIC = Grid()
ANISOTROPIC = Grid(phi_o=80, phi_i=80)


@dataclass
class Tables:
    """The tables of n materials.

    `params` (n, columns) are the parameters of the materials, and `values` (n, *grid.shape) are their tables. `walks`
    (n,) has the number of random walks of each material. `error` has the standard error of each value, or is None.
    `class_name` is the class of all materials. If no `class_name` is given, the class is found by the number of columns
    of `params`. Raises `TableError` if no class, or more than one class, has this number of columns.
    """

    params: NDArray[np.float64]
    values: NDArray[np.floating]
    walks: NDArray[np.int64]
    error: NDArray[np.floating] | None = None
    class_name: str = ""

    def __post_init__(self) -> None:
        if not self.class_name:
            self.class_name = _class_with(self.params.shape[-1])
        if 0 in self.values.shape[1:]:
            raise TableError(f"the table of shape {self.values.shape} has no bins; choose a larger grid")

    @property
    def grid(self) -> Grid:
        """The grid that the shape of `values` implies."""
        theta_i, *phi_i, theta_o, phi_o, _ = self.values.shape[1:]
        return Grid(theta_i, theta_o, phi_o, *phi_i)

    def albedo(self) -> NDArray[np.float64]:
        """Directional albedo (n, theta_i[, phi_i], 3): 2 pi times the mean value over the bins of wo."""
        return 2.0 * math.pi * self.values.mean(axis=(-3, -2), dtype=np.float64)

    def __getitem__(self, chosen: slice | NDArray) -> Tables:
        """The tables of some materials, given by a slice or by an array of indices."""
        error = None if self.error is None else self.error[chosen]
        return Tables(self.params[chosen], self.values[chosen], self.walks[chosen], error, self.class_name)

    @staticmethod
    def concatenate(parts: Sequence[Tables]) -> Tables:
        """Joins tables of several materials.

        Raises `TableError` if the tables are of different classes, or if only some of the tables have standard errors.
        """
        classes = sorted({t.class_name for t in parts})
        if len(classes) > 1:
            raise TableError(
                f"tables of the classes {', '.join(map(shown, classes))} cannot be joined; join one class at a time"
            )
        errors = [t.error for t in parts if t.error is not None]
        if errors and len(errors) < len(parts):
            raise TableError("tables that have standard errors cannot be joined with tables that have none")
        return Tables(
            np.concatenate([t.params for t in parts]),
            np.concatenate([t.values for t in parts]),
            np.concatenate([t.walks for t in parts]),
            np.concatenate(errors) if errors else None,
            *classes,
        )

    @property
    def space(self) -> ParamSpace:
        """The parameters of the materials' class. Raises `TableError` if this version has no such class."""
        try:
            return sources.space(self.class_name)
        except ParamError as e:
            raise TableError(f"{e}; use the version that made the tables") from None

    def check_params(self) -> None:
        """Raises `ParamError` for parameters outside the range that the source of the class accepts."""
        self.space.check(self.params)

    def save(self, path: str | Path) -> None:
        """Writes a reference file, atomically. CONVENTIONS.md describes the file format."""
        arrays: dict[str, Any] = {"class": self.class_name, "params": self.params}
        arrays |= {"table": self.values, "walks": self.walks}
        if self.error is not None:
            arrays["error"] = self.error
        with whole(path) as partial, partial.open("wb") as f:
            np.savez_compressed(f, **arrays)

    @staticmethod
    def load(path: str | Path) -> Tables:
        """Reads a reference file. Raises `TableError` with the fault if the file is missing or damaged."""
        path = Path(path)
        try:
            with arrays(path) as f:
                params, values, walks = f["params"], f["table"], f["walks"]
                error = f["error"] if "error" in f else None
                class_name = class_entry(f)
        except FileNotFoundError:
            raise TableError(f"{path}: no such file; `nma simulate` writes reference files") from None
        except (KeyError, ValueError, OSError, EOFError) as e:
            raise TableError(
                f"{path}: not a reference file (.npz with the arrays params, table and walks): {e}"
            ) from None
        except Exception as e:  # zipfile and zlib have their own error types, so all are caught
            raise TableError(f"{path}: damaged archive: {e}") from None
        _check_arrays(path, params, values, walks, error)
        walks = np.broadcast_to(walks, len(params)).astype(np.int64)
        try:
            tables = Tables(params.astype(np.float64), values, walks, error, class_name)
            if class_name in sources.classes() and tables.space.size != params.shape[1]:
                raise TableError(
                    f"params have {params.shape[1]} columns, but class {class_name} has {tables.space.size} columns; "
                    "simulate the tables again"
                )
        except TableError as e:
            raise TableError(f"{path}: {e}") from None
        return tables


def check_class(found: str, wanted: str, reader: str, where: str = "") -> None:
    """Raises `TableError` if tables of the class `found` are given to `reader`, which needs the class `wanted`.

    `where` begins the message, for example the name of a file and a colon.
    """
    if found != wanted:
        simulated = f": `nma simulate --class {wanted}`" if wanted in sources.names() else ""
        raise TableError(
            f"{where}the tables are of class {shown(found)}, but {reader} is for class {wanted}; choose tables of "
            f"class {wanted}{simulated}"
        )


def class_entry(arrays: Any) -> str:
    """The class that an .npz file names for its `params`, or "" if the file names no class.

    Files of earlier versions name no class. Raises `ValueError` if the entry `class` is not a name.
    """
    if "class" not in arrays:
        return ""
    entry = arrays["class"]
    if entry.ndim or entry.dtype.kind != "U":
        raise ValueError(
            f"the entry `class` has type {entry.dtype} and shape {entry.shape}, but must be a name"
        )
    return str(entry)


def _class_with(columns: int) -> str:
    """The class whose parameter vectors have `columns` columns.

    Raises `TableError` if no class, or more than one class, has this number of columns.
    """
    sizes = {name: sources.space(name).size for name in sources.classes()}
    fitting = [name for name, size in sizes.items() if size == columns]
    if len(fitting) == 1:
        return fitting[0]
    known = ", ".join(f"{name} {size}" for name, size in sizes.items())
    raise TableError(
        f"the class is not named, and {len(fitting) or 'no'} classes have {columns} columns of parameters (the classes "
        f"have: {known}); name the class (`class` in the file, `class_name` in Python), or leave out the parameters: "
        "shape (n, 0)"
    )


def kept(path: Path, make: Callable[[], Tables], params: NDArray[np.float64] | None = None) -> Tables:
    """Loads tables from the file `path`. If there is no such file, makes the tables with `make` and saves them.

    The tables are made again if the file is damaged, or if `params` are given and differ from the parameters in the
    file.
    """
    with suppress(TableError):
        found = Tables.load(path)
        if params is None or np.array_equal(found.params, params):
            return found
    made = make()
    try:
        made.save(path)
    except OutputError:
        # Another run with the same output may have ended and deleted the folder between two steps of `save`. A second
        # call of `save` makes the folder again.
        made.save(path)
    return made


def _check_arrays(
    path: Path, params: NDArray, values: NDArray, walks: NDArray, error: NDArray | None
) -> None:
    """Raises `TableError` with the first fault if the arrays are not those of a reference file."""
    n = len(params) if params.ndim else 0
    arrays = {"params": params, "table": values, "walks": walks} | ({} if error is None else {"error": error})
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise TableError(f"{path}: {name} holds {array.dtype}, not numbers")
    if params.ndim != 2 or values.ndim not in (5, 6) or values.shape[0] != n or values.shape[-1] != 3:
        raise TableError(
            f"{path}: params {params.shape} and table {values.shape} are not (n, columns) and "
            "(n, theta_i[, phi_i], theta_o, phi, 3)"
        )
    if not n or not values.size:
        what = "bins" if n else "materials"
        raise TableError(
            f"{path}: the table of shape {values.shape} has no {what}; simulate the materials again"
        )
    if error is not None and error.shape != values.shape:
        raise TableError(f"{path}: error has shape {error.shape}, but table has shape {values.shape}")
    if walks.shape not in ((), (1,), (n,)) or not (walks > 0).all():
        raise TableError(
            f"{path}: walks must be one positive number, or {n} positive numbers; its shape is {walks.shape}"
        )
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise TableError(
                f"{path}: {name} of material {row} has values that are not finite; simulate the material again"
            )
