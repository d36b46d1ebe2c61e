"""Collections of materials, a folder of files or a file that holds many, and their tables."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from nma import sources
from nma.errors import SourceError
from nma.sources import nbrdf
from nma.sources.base import Values
from nma.table.grid import Tables, kept
from nma.table.values import tabulate_values

# What is in the name of a table beside the material's, so that a table of another file is not taken for its own.
_DIGEST = 12


@dataclass(frozen=True)
class Member:
    """One material of a collection; `material` chooses in a file that holds several."""

    name: str
    path: Path
    material: str | None = None

    def read(self) -> Values:
        """Its values; raises `SourceError`."""
        return sources.read(self.path, self.material)


def members(path: str | Path) -> list[Member]:
    """The materials of a folder's files, or of one file, in the order of their names.

    Files are those that `nma.sources.read` knows by the end of their name; each of the networks in an NBRDF weights
    file is one. What lies in folders further down is not looked at. Raises `SourceError` where there is no material, or
    where two have the same name.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(
            f"{path}: no such folder or file; `nma data` says where measured materials come from"
        )
    endings = sources.endings()
    files = sorted(f for f in path.iterdir() if f.is_file()) if path.is_dir() else [path]
    found = [member for file in files if file.suffix in endings for member in _of_file(file)]
    if not found:
        raise SourceError(f"{path}: holds no material; their files end in {', '.join(endings)}")
    name, count = Counter(member.name for member in found).most_common(1)[0]
    if count > 1:
        raise SourceError(f"{path}: {count} materials are called '{name}'; rename or remove one of the files")
    return found


def _of_file(file: Path) -> list[Member]:
    if file.suffix != ".npz":
        return [Member(file.stem, file)]
    return [Member(name, file, name) for name in nbrdf.read(file)[0]]


def origin(chosen: Sequence[Member]) -> str:
    """What the materials are, for texts and records: NBRDF-MERL, or the kinds of their files."""
    if all(member.material for member in chosen):
        return nbrdf.kind([member.name for member in chosen])
    return ", ".join(sorted({f"*{member.path.suffix}" for member in chosen}))


def tables(
    chosen: Sequence[Member], folder: str | Path, progress: Callable[[int], None] = lambda done: None
) -> Tables:
    """The tables of some materials, each kept in `folder` once it is made, so that a killed run goes on there.

    A table belongs to the content of its file: another file of the same name is tabulated anew. `params` are the
    materials' numbers, (n, 1). Raises `SourceError` and `TableError` for what cannot be read or is anisotropic.
    """
    digests: dict[Path, str] = {}
    made = []
    for number, member in enumerate(chosen):
        if member.path not in digests:
            digests[member.path] = _digest(member.path)
        file = Path(folder) / f"{member.name}-{digests[member.path]}.npz"
        made.append(kept(file, partial(_table, member)))
        progress(number + 1)
    both = Tables.concatenate(made)
    return Tables(np.arange(len(made), dtype=np.float64)[:, None], both.values, both.walks, both.error)


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:_DIGEST]
    except OSError as e:
        raise SourceError(f"{path}: cannot be read: {e.strerror}") from None


def _table(member: Member) -> Tables:
    return tabulate_values(member.read())
