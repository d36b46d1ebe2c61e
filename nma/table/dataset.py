"""Datasets: tables of many random materials of a class, stored on disk as one zarr chunk per material.

Any number of workers may write a dataset at the same time, and a run that was interrupted can be continued. zarr (3.1.3
or later) first writes a chunk to a temporary file and then renames the file, so a chunk that exists is complete. A
material and its random stream depend only on the dataset's seed and the material's index. So workers need no
coordination: if two workers simulate the same material, they write the same bytes.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec
from zarr.errors import ContainsArrayError

from nma import sources
from nma.errors import DatasetError, shown
from nma.files import cleaning
from nma.params import Population
from nma.table.grid import ISOTROPIC, Tables
from nma.table.walks import stream_keys, tabulate

FORMAT = 1
# The materials that are simulated at once are called a block. A block has at most `_BLOCK` materials, and at most
# `_BLOCK_WALKS` walks unless a single material needs more. An interrupted run loses only the walks of the current
# block. `_BLOCK` and `_BLOCK_WALKS` do not change the result.
_BLOCK = 16
_BLOCK_WALKS = 1 << 27


@dataclass(frozen=True)
class Settings:
    """The settings that determine every value in a dataset. `walks` is the number of random walks per material.

    `nma dataset --help` explains the other settings. Raises `DatasetError` if a setting is out of range.
    """

    class_name: str
    materials: int
    walks: int
    seed: int
    population: Population = "mixed"
    format: int = FORMAT

    def __post_init__(self) -> None:
        counts = {"materials": self.materials, "walks": self.walks, "seed": self.seed}
        for name, count in counts.items():
            if not isinstance(count, int | np.integer) or isinstance(count, bool):
                raise DatasetError(f"a dataset's setting {name} is a whole number; got {shown(count)}")
        if self.materials < 1 or self.walks < 1 or self.seed < 0:
            raise DatasetError(
                "a dataset needs at least one material, at least one walk, and a seed of at least 0; "
                f"got {self.materials} materials, {self.walks} walks, seed {self.seed}"
            )
        if self.population not in get_args(Population) or self.population == "unseen_metals":
            known = ", ".join(p for p in get_args(Population) if p != "unseen_metals")
            # With "unseen_metals", one call of `ParamSpace.sample` draws many materials, and every third of them has a
            # metal held out for tests. A dataset calls `sample` once per material, so it cannot have the population
            # "unseen_metals".
            raise DatasetError(f"a dataset's population is one of {known}; got {shown(self.population)}")


def draw_params(settings: Settings, indices: NDArray[np.integer] | Sequence[int]) -> NDArray[np.float64]:
    """Draws the parameter vectors (n, columns) of materials, each from the random stream of the material's index."""
    space = sources.get(settings.class_name).space
    rows = [np.random.default_rng((settings.seed, int(i), 0x9A7A)) for i in indices]
    return np.concatenate([space.sample(rng, 1, settings.population) for rng in rows])


def _fingerprint(settings: Settings) -> str:
    """A digest of the first and the last material's parameters.

    Versions of the package that draw other parameters from the same seed have another digest.
    """
    ends = draw_params(settings, [0, settings.materials - 1]).astype(np.float32)
    return hashlib.sha256(ends.tobytes()).hexdigest()[:16]


def simulate_block(settings: Settings, indices: NDArray[np.integer] | Sequence[int]) -> Tables:
    """The tables of the materials with the given indices, without standard errors."""
    source = sources.get(settings.class_name)
    return tabulate(
        source,
        draw_params(settings, indices),
        settings.walks,
        stream_keys(settings.seed, indices),
        error=False,
    )


class Dataset:
    """A dataset on disk.

    `create` and `open` return a dataset, `write` adds the missing tables, and `load` reads tables.
    """

    def __init__(self, path: Path, settings: Settings, table: zarr.Array):
        self.path, self.settings, self._table = path, settings, table

    @staticmethod
    def create(path: str | Path, settings: Settings) -> Dataset:
        """Opens the dataset at `path`, or creates a dataset there if `path` has none.

        Raises `DatasetError` if the dataset was made with other settings, or if `path` is a folder with other files.
        """
        path = Path(path)
        check_folder(path)
        if not os.path.exists(path / "zarr.json"):
            _create_array(path, settings)
        found = Dataset.open(path)
        if found.settings != settings:
            asked = asdict(settings)
            changed = [
                f"{k} {v} (asked for: {asked[k]})" for k, v in asdict(found.settings).items() if v != asked[k]
            ]
            raise DatasetError(
                f"{path} was made with {', '.join(changed)}; choose another folder or the same settings"
            )
        return found

    @staticmethod
    def open(path: str | Path) -> Dataset:
        """Opens the dataset at `path`. Raises `DatasetError` if `path` has no dataset that this version can read."""
        path = Path(path)
        try:
            # Chunks of zeros are stored, too, because a material counts as simulated if the file of its chunk exists.
            # zarr 3.1.6 ignores the argument `config` of `open_array` for an array that exists.
            with zarr.config.set({"array.write_empty_chunks": True}):
                table = zarr.open_array(path, mode="r+")
            stored: dict[str, Any] = dict(table.attrs["nma_dataset"])  # type: ignore[arg-type]
        except Exception as e:
            raise _no_dataset(path, e) from None
        # A later format may have other fields, so the format is checked before the fields.
        found = stored.get("format", FORMAT)
        if type(found) is not int or found != FORMAT:
            raise DatasetError(
                f"{path} has format {shown(found)}, but this version reads format {FORMAT}; use the version that made "
                "the dataset, or choose another folder"
            )
        try:
            settings = Settings(**stored)
            fingerprint = table.attrs["nma_params"]
        except TypeError as e:
            raise DatasetError(
                f"{path}: the settings of the dataset do not fit this version ({shown(str(e))}); use the version "
                "that made the dataset, or choose another folder"
            ) from None
        except Exception as e:
            raise _no_dataset(path, e) from None
        if settings.class_name not in sources.names():
            raise DatasetError(
                f"{path} is of class {shown(settings.class_name)}; this version simulates "
                f"{', '.join(sources.names())}: use the version that made it"
            )
        if fingerprint != _fingerprint(settings):
            raise DatasetError(
                f"{path} was made by a version that drew other parameters from the same seed; make the dataset again"
            )
        return Dataset(path, settings, table)

    def _chunk(self, index: int) -> str:
        return os.path.join(self.path, "c", str(index), *["0"] * len(ISOTROPIC.shape))

    def _has(self, index: int) -> bool:
        return os.path.exists(self._chunk(index))

    def missing(self) -> NDArray[np.int64]:
        """The indices of the materials whose tables are not on disk yet."""
        return np.array([i for i in range(self.settings.materials) if not self._has(i)], np.int64)

    def write(self, progress: Callable[[int], None] = lambda done: None) -> None:
        """Simulates and stores the missing materials.

        After each block, calls `progress` with the number of materials on disk, including materials of other workers.
        """
        size = max(1, min(_BLOCK, _BLOCK_WALKS // self.settings.walks))
        blocks = np.array_split(np.arange(self.settings.materials), -(-self.settings.materials // size))
        left = self.missing()
        # Each worker takes the blocks in its own random order, so that two workers seldom simulate the same block.
        for b in np.random.default_rng(os.getpid()).permutation(len(blocks)):
            todo = [int(i) for i in blocks[b] if not self._has(i)]
            if todo:
                self._store(todo, simulate_block(self.settings, todo).values.astype(np.float16))
            left = np.array([i for i in left if not self._has(i)], np.int64)
            progress(self.settings.materials - len(left))

    def _store(self, indices: Sequence[int], values: NDArray[np.float16]) -> None:
        try:
            for i, value in zip(indices, values, strict=True):
                with _writing(self._chunk(i)):
                    self._table[i] = value
        except OSError as e:
            raise DatasetError(
                f"{self.path}: cannot write ({e}); run the same command again to continue"
            ) from None

    def load(self, indices: NDArray[np.integer] | range | None = None) -> Tables:
        """The tables (float16) of the materials with the given indices, or of all materials.

        Raises `DatasetError` if a chunk is missing or damaged.
        """
        indices = np.arange(self.settings.materials) if indices is None else np.asarray(indices)
        values = np.empty((len(indices), *ISOTROPIC.shape), np.float16)
        for row, i in enumerate(indices):
            if not 0 <= i < self.settings.materials:
                raise DatasetError(
                    f"{self.path} has {self.settings.materials} materials, but no material {i}"
                )
            if not self._has(i):
                raise DatasetError(
                    f"{self.path}: material {i} is missing ({len(self.missing())} are missing in all); "
                    f"run `nma dataset {self.settings.class_name} {self.path}` with the same settings"
                )
            try:
                values[row] = self._table[int(i)]
            except Exception as e:
                reason = str(e).partition("\n")[0] or type(e).__name__
                raise DatasetError(
                    f"{self.path}: chunk {self._chunk(i)} is damaged ({reason}); "
                    "delete that file and run `nma dataset` again"
                ) from None
        walks = np.full(len(indices), ISOTROPIC.walks(self.settings.walks), np.int64)
        return Tables(draw_params(self.settings, indices), values, walks, None, self.settings.class_name)


def check_folder(path: Path) -> None:
    """Raises `DatasetError` if `path` is a folder that has files but no dataset, because a dataset would be mixed with
    these files."""
    if _has_other_files(path):
        raise DatasetError(
            f"{path}: cannot be written (a folder with other files); choose a dataset, or a new or an empty folder"
        )


def _has_other_files(path: Path) -> bool:
    """Whether `path` is a folder that has files but no dataset. Temporary files do not count, because another worker
    may be creating a dataset."""
    names = os.listdir(path) if os.path.isdir(path) else []
    return "zarr.json" not in names and not all(name.endswith(".partial") for name in names)


def _no_dataset(path: Path, error: Exception) -> DatasetError:
    """The error for a folder without a dataset that can be read."""
    advice = f"`nma dataset CLASS {path}` makes one"
    if os.path.exists(path / "zarr.json"):
        advice = f"choose another folder; a damaged dataset can be deleted and made again: {advice}"
    elif _has_other_files(path) or os.path.isfile(path):
        advice = "choose the folder of a dataset; `nma dataset CLASS FOLDER` makes one in a new folder"
    reason = str(error).partition("\n")[0] or type(error).__name__
    return DatasetError(f"{path} is not a dataset of tables ({reason}); {advice}")


def _create_array(path: Path, settings: Settings) -> None:
    """Creates an empty dataset at `path`, unless another worker has just created it."""
    try:
        with suppress(ContainsArrayError), _writing(path / "zarr.json"):
            zarr.create_array(
                store=path,
                shape=(settings.materials, *ISOTROPIC.shape),
                chunks=(1, *ISOTROPIC.shape),
                dtype="float16",
                serializer=BytesCodec(),
                compressors=[ZstdCodec(level=1), Crc32cCodec()],
                attributes={"nma_dataset": asdict(settings), "nma_params": _fingerprint(settings)},
            )
    except OSError as e:
        raise DatasetError(f"{path}: cannot create a dataset there ({e})") from None


@contextmanager
def _writing(file: str | Path) -> Iterator[None]:
    """A context manager for a `with` block in which a thread of zarr writes `file` by way of a temporary file.

    If a signal ends the process meanwhile, the process waits for at most one second until `file` exists, so that no
    temporary file remains.
    """

    def wait() -> None:
        latest = time.monotonic() + 1.0
        while not os.path.exists(file) and time.monotonic() < latest:
            time.sleep(0.01)

    with cleaning(wait):
        yield
