"""Where appearance comes from.

A new class of materials to simulate is one file here and one line in `_FACTORIES`; a new kind of file that holds the
values of materials is one file and one line in `_READERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nma.errors import ParamError, SourceError
from nma.sources.base import Source, Values


def _layered3() -> Source:
    from nma.sources.layered import Layered3

    return Layered3()


_FACTORIES: dict[str, Callable[[], Source]] = {"layered3": _layered3}


def names() -> tuple[str, ...]:
    """Names of the classes that can be simulated."""
    return tuple(_FACTORIES)


def get(name: str) -> Source:
    """The source model of a class."""
    if name not in _FACTORIES:
        raise ParamError(f"unknown class '{name}'; known are {', '.join(_FACTORIES)}")
    return _FACTORIES[name]()


def _merl(path: Path, material: str | None) -> Values:
    from nma.sources.merl import Merl

    return Merl.load(path)


def _rgl(path: Path, material: str | None) -> Values:
    from nma.sources.mitsuba_bsdf import measured

    return measured(path)


def _xml(path: Path, material: str | None) -> Values:
    from nma.sources.mitsuba_bsdf import from_xml

    return from_xml(path)


def _nbrdf(path: Path, material: str | None) -> Values:
    from nma.sources import nbrdf

    if material is None:
        names, _ = nbrdf.read(path)
        listed = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        raise SourceError(f"{path}: holds the networks of {len(names)} material(s); say which: {listed}")
    return nbrdf.Nbrdf.load(path, material)


# How a file is read, by the end of its name; `material` chooses in files that hold several.
_READERS: dict[str, Callable[[Path, str | None], Values]] = {
    ".binary": _merl,
    ".bsdf": _rgl,
    ".xml": _xml,
    ".npz": _nbrdf,
}


def endings() -> tuple[str, ...]:
    """How the names of files end that `read` understands."""
    return tuple(_READERS)


def read(path: str | Path, material: str | None = None) -> Values:
    """The values of one material, from a file.

    MERL's `.binary`, RGL's `.bsdf`, a Mitsuba BSDF in `.xml`, or one of the NBRDF networks in an `.npz`. Raises
    `SourceError` for other files, and for those that are missing or damaged.
    """
    path = Path(path)
    if path.suffix not in _READERS:
        raise SourceError(f"{path}: no source reads such files; their names end in {', '.join(_READERS)}")
    return _READERS[path.suffix](path, material)
