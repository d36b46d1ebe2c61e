"""Lists and tabulates the materials of a collection: a folder of files, or one file with many materials."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from nma import sources
from nma.errors import SourceError
from nma.sources.base import Values
from nma.table.grid import Tables, kept
from nma.table.values import tabulate_values

# The name of a table's file contains `_DIGEST` digits of the SHA-256 of the material's file, so a saved table is no
# longer used if the material's file changes.
_DIGEST = 12


@dataclass(frozen=True)
class Member:
    """One material of a collection.

    If a file holds several materials, `material` is the material's name in the file.
    """

    name: str
    path: Path
    material: str | None = None

    def read(self) -> Values:
        """Reads the material as a source. Raises `SourceError` if the file cannot be read."""
        return sources.read(self.path, self.material)


def members(path: str | Path) -> list[Member]:
    """The materials of one file, or of all files in a folder, in the order of the files' names.

    Files are chosen by their extension, which must be one that `nma.sources.read` understands. In an NBRDF weights file
    each network is a material. Subfolders are not searched, and hidden files, such as the unfinished files of a killed
    run, are left out. Raises `SourceError` if there is no material, or if two materials have the same name.
    """
    path = Path(path)
    if not path.exists():
        raise SourceError(f"{path}: no such folder or file; `nma data` says where to get measured materials")
    files = (
        sorted(f for f in path.iterdir() if f.is_file() and not f.name.startswith("."))
        if path.is_dir()
        else [path]
    )
    found = [member for file in files if file.suffix in sources.FORMATS for member in _of_file(file)]
    if not found:
        raise SourceError(
            f"{path}: holds no material; files of materials end in {', '.join(sources.FORMATS)}"
        )
    name, count = Counter(member.name for member in found).most_common(1)[0]
    if count > 1:
        raise SourceError(f"{path}: {count} materials are called '{name}'; rename or remove one of the files")
    return found


def _of_file(file: Path) -> list[Member]:
    names = sources.format_of(file).names
    return [Member(file.stem, file)] if names is None else [Member(name, file, name) for name in names(file)]


def origin(chosen: Sequence[Member]) -> str:
    """The origin of the materials, for messages and records: a name such as NBRDF-MERL, or the files' extensions."""
    return ", ".join(sorted({_origin(path) for path in {member.path for member in chosen}}))


def _origin(file: Path) -> str:
    found = sources.format_of(file)
    return found.identify(file) if found.names and found.identify else f"*{file.suffix}"


def tables(
    chosen: Sequence[Member], folder: str | Path, progress: Callable[[int], None] = lambda done: None
) -> Tables:
    """The tables of the materials in `chosen`, in the same order.

    Each table is saved in `folder` as soon as it is made, so that an interrupted run can be continued. A later call
    uses a saved table only if the material's file still has the same content. Raises `SourceError` if a file cannot be
    read, and `TableError` if a material is anisotropic.
    """
    digests: dict[Path, str] = {}
    made = []
    for number, member in enumerate(chosen):
        if member.path not in digests:
            digests[member.path] = _digest(member.path)
        file = Path(folder) / f"{member.name}-{digests[member.path]}.npz"
        made.append(kept(file, partial(_table, member)))
        progress(number + 1)
    return Tables.concatenate(made)


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:_DIGEST]
    except OSError as e:
        raise SourceError(f"{path}: cannot be read: {e.strerror}") from None


def _table(member: Member) -> Tables:
    return tabulate_values(member.read())
