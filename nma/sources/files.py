"""File formats that store BRDF values: how a format is declared, and a function that reads a file's bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nma.errors import SourceError
from nma.sources.base import Values


@dataclass(frozen=True)
class Measurements:
    """Published measurements of materials, or neural reconstructions of measurements; `kind` tells which of the two.

    `files` describes the files of a complete copy. `known` maps the name of a file to its size in bytes and its
    SHA-256. Files that were not available to us are missing in `known`.
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
    """A format of files that store BRDF values of materials.

    A format's functions raise `SourceError` for a damaged file. `read(path)` returns the values (`Values`) of the
    material in a file. If a file holds several materials, `names(path)` lists their names, and `read(path, name)`
    returns the values of the material `name`. `measurements` are the published measurements that have this format.
    `identify(path)` reads the whole file and returns the name of the measurements that the file belongs to. If the file
    is damaged, the format's `name` is shown instead of the name of the measurements. `claims(path)` tells whether a
    file with the format's extension does have this format, since other formats may have the same extension.
    """

    name: str
    read: Callable[..., Values]
    names: Callable[[Path], list[str]] | None = None
    measurements: tuple[Measurements, ...] = ()
    identify: Callable[[Path], str] | None = None
    claims: Callable[[Path], bool] = lambda path: True


def content(path: Path, measurements: str) -> bytes:
    """Reads all bytes of a file.

    Raises `SourceError` if the file cannot be read; the message contains `measurements`.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise SourceError(
            f"{path}: no such file; `nma data` says where to get {measurements} files"
        ) from None
    except (OSError, ValueError) as e:  # a ValueError means that the name contains a NUL character
        raise SourceError(f"{path}: cannot be read: {getattr(e, 'strerror', e)}") from None
