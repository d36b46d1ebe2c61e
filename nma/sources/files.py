"""Files with the values of materials: what their formats declare, and how they are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nma.errors import SourceError
from nma.sources.base import Values


@dataclass(frozen=True)
class Measurements:
    """Measured materials that somebody has published, or neural reconstructions of them: `kind` says which.

    `files` describes the files of a complete copy. `known` gives the size in bytes and the SHA-256 of a file by its
    name; files that we had no copy of are not in it.
    """

    name: str
    kind: str
    origin: str
    paper: str
    licence: str
    files: str
    known: dict[str, tuple[int, str]]


@dataclass(frozen=True)
class Format:
    """A format of files with the values of materials. All functions raise `SourceError` for a damaged file.

    `read(path)` returns the values of a file's material. If a file holds several, `names(path)` lists them and
    `read(path, name)` returns one of them. `measurements` are those that are published in this format.
    `identify(path)` reads the whole file and returns the name of its measurements; `name` stands for it where the file
    is damaged. `claims(path)` tells these files from others with the same extension.
    """

    name: str
    read: Callable[..., Values]
    names: Callable[[Path], list[str]] | None = None
    measurements: tuple[Measurements, ...] = ()
    identify: Callable[[Path], str] | None = None
    claims: Callable[[Path], bool] = lambda path: True


def content(path: Path, measurements: str) -> bytes:
    """All bytes of a file of these measurements. Raises `SourceError` if the file cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise SourceError(
            f"{path}: no such file; `nma data` says where to get {measurements} files"
        ) from None
    except (OSError, ValueError) as e:  # ValueError: the name contains a NUL
        raise SourceError(f"{path}: cannot be read: {getattr(e, 'strerror', e)}") from None
