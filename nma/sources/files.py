"""Files with the values of materials: the declaration of their formats, and a function that reads their bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nma.errors import SourceError
from nma.sources.base import Values


@dataclass(frozen=True)
class Measurements:
    """Published measurements of materials, or neural reconstructions of measurements. `kind` says which.

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

    `read(path)` returns the values of the material in a file. If a file holds several materials, `names(path)` lists
    them, and `read(path, name)` returns the values of one. `measurements` are the measurements that are published in
    this format. `identify(path)` reads the whole file and returns the name of its measurements. For a damaged file, the
    format's `name` is used instead. `claims(path)` says whether a file with the right extension has this format.
    """

    name: str
    read: Callable[..., Values]
    names: Callable[[Path], list[str]] | None = None
    measurements: tuple[Measurements, ...] = ()
    identify: Callable[[Path], str] | None = None
    claims: Callable[[Path], bool] = lambda path: True


def content(path: Path, measurements: str) -> bytes:
    """All bytes of a file. Raises `SourceError` if it cannot be read; `measurements` is a name for this message."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise SourceError(
            f"{path}: no such file; `nma data` says where to get {measurements} files"
        ) from None
    except (OSError, ValueError) as e:  # ValueError: the name contains a NUL
        raise SourceError(f"{path}: cannot be read: {getattr(e, 'strerror', e)}") from None
