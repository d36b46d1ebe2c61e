"""A class sampled into many tables on disk: one zarr chunk per material, resumable, written by any number of workers.

A chunk is written to a temporary file and renamed, so it exists only when it is whole; the material and its random
stream depend on (seed, index) alone. Hence a killed run goes on where it stopped, and workers need no coordination:
should two of them simulate one material, they write the same bytes.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BytesCodec, Crc32cCodec, ZstdCodec

from nma import sources
from nma.errors import DatasetError
from nma.params import Population
from nma.table import ISOTROPIC, Tables, stream_keys, tabulate

FORMAT = 1
# Materials simulated by one kernel launch; has no influence on the result.
_BLOCK = 16


@dataclass(frozen=True)
class Settings:
    """What determines every number of a dataset."""

    class_name: str
    materials: int
    walks: int
    seed: int
    population: Population = "mixed"
    format: int = FORMAT


def draw_params(settings: Settings, indices: NDArray[np.integer] | Sequence[int]) -> NDArray[np.float64]:
    """Parameter vectors of the materials `indices`, each from its own stream."""
    space = sources.get(settings.class_name).space
    rows = [np.random.default_rng((settings.seed, int(i), 0x9A7A)) for i in indices]
    return np.concatenate([space.sample(rng, 1, settings.population) for rng in rows])


def _fingerprint(settings: Settings) -> str:
    """Changes when another version of the package draws other parameters from the same seed."""
    ends = draw_params(settings, [0, settings.materials - 1]).astype(np.float32)
    return hashlib.sha256(ends.tobytes()).hexdigest()[:16]


def simulate_block(settings: Settings, indices: NDArray[np.integer] | Sequence[int]) -> Tables:
    """Parameters and tables, without errors, of the materials `indices`."""
    source = sources.get(settings.class_name)
    return tabulate(
        source, draw_params(settings, indices), settings.walks, stream_keys(settings.seed, indices), error=False
    )


class Dataset:
    """A dataset on disk. `Dataset.create` or `Dataset.open`, then `write` to complete it, `load` to use it."""

    def __init__(self, path: Path, settings: Settings, table: zarr.Array):
        self.path, self.settings, self._table = path, settings, table

    @staticmethod
    def create(path: str | Path, settings: Settings) -> Dataset:
        """Opens the dataset at `path` if it was made with the same settings, or creates it. Raises `DatasetError`."""
        path = Path(path)
        if (path / "zarr.json").exists():
            found = Dataset.open(path)
            if found.settings != settings:
                raise DatasetError(
                    f"{path} was made with {found.settings}, asked for are {settings}; choose another folder or the same settings"
                )
            return found
        path.parent.mkdir(parents=True, exist_ok=True)
        table = zarr.create_array(
            store=path,
            shape=(settings.materials, *ISOTROPIC.shape),
            chunks=(1, *ISOTROPIC.shape),
            dtype="float16",
            serializer=BytesCodec(),
            compressors=[ZstdCodec(level=1), Crc32cCodec()],
            attributes={"nma_dataset": asdict(settings), "nma_params": _fingerprint(settings)},
        )
        return Dataset(path, settings, table)

    @staticmethod
    def open(path: str | Path) -> Dataset:
        """The dataset at `path`; `DatasetError` if there is none."""
        path = Path(path)
        try:
            table = zarr.open_array(path, mode="r+")
            settings = Settings(**table.attrs["nma_dataset"])
            fingerprint = table.attrs["nma_params"]
        except Exception as e:
            raise DatasetError(f"{path} is not a dataset of tables ({e}); `nma dataset CLASS {path}` makes one") from None
        if settings.format != FORMAT:
            raise DatasetError(f"{path} has format {settings.format}, this version reads {FORMAT}; generate it again")
        if fingerprint != _fingerprint(settings):
            raise DatasetError(f"{path} was made by a version that drew other parameters from its seed; generate it again")
        return Dataset(path, settings, table)

    def _chunk(self, index: int) -> Path:
        return self.path / "c" / "/".join([str(index)] + ["0"] * len(ISOTROPIC.shape))

    def missing(self) -> NDArray[np.int64]:
        """Indices of the materials that are not on disk yet."""
        return np.array([i for i in range(self.settings.materials) if not self._chunk(i).exists()], np.int64)

    def write(self, progress: Callable[[int], None] = lambda done: None) -> None:
        """Simulates and stores what is missing, calling `progress` with the number of materials done."""
        blocks = np.array_split(np.arange(self.settings.materials), -(-self.settings.materials // _BLOCK))
        # Each worker takes the blocks in an order of its own, so that several of them seldom meet.
        order = np.random.default_rng(os.getpid()).permutation(len(blocks))
        for b in order:
            todo = np.array([i for i in blocks[b] if not self._chunk(i).exists()], np.int64)
            if len(todo):
                values = simulate_block(self.settings, todo).values.astype(np.float16)
                for i, value in zip(todo, values, strict=True):
                    self._table[int(i)] = value
            progress(self.settings.materials - len(self.missing()))

    def load(self, indices: NDArray[np.integer] | range | None = None) -> Tables:
        """The tables (float16) of `indices`, or of all materials. A missing or damaged chunk raises `DatasetError`."""
        indices = np.arange(self.settings.materials) if indices is None else np.asarray(indices)
        values = np.empty((len(indices), *ISOTROPIC.shape), np.float16)
        for row, i in enumerate(indices):
            if not self._chunk(i).exists():
                raise DatasetError(
                    f"{self.path}: material {i} is missing ({len(self.missing())} are); "
                    f"run `nma dataset {self.settings.class_name} {self.path}` with its settings to complete it"
                )
            try:
                values[row] = self._table[int(i)]
            except Exception as e:
                raise DatasetError(
                    f"{self.path}: chunk {self._chunk(i)} is damaged ({e}); delete that file and run `nma dataset` again"
                ) from None
        walks = np.full(len(indices), ISOTROPIC.walks(self.settings.walks), np.int64)
        return Tables(draw_params(self.settings, indices), values, walks)


def stream(settings: Settings, block: int = _BLOCK, first: int = 0) -> Iterator[Tables]:
    """Fresh materials for ever, `block` at a time, from index `first` on; nothing is stored."""
    for start in itertools.count(first, block):
        yield simulate_block(settings, range(start, start + block))
