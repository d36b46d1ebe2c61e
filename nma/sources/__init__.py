"""The sources: models and files that say how materials look.

To simulate a new class of materials, add one file to this folder and one line to `_FACTORIES`. To read a new kind of
file with the values of materials, add one file and one line to `_READERS`.
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
    """The source that simulates the class `name`. Raises `ParamError` if there is no such class."""
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


# The function that reads a file, by the file's extension. Its second argument names a material, for files that hold
# several.
_READERS: dict[str, Callable[[Path, str | None], Values]] = {
    ".binary": _merl,
    ".bsdf": _rgl,
    ".xml": _xml,
    ".npz": _nbrdf,
}


def endings() -> tuple[str, ...]:
    """The extensions of the files that `read` understands."""
    return tuple(_READERS)


def read(path: str | Path, material: str | None = None) -> Values:
    """Reads the values of one material from a file.

    The file is a MERL `.binary`, an RGL `.bsdf`, a Mitsuba BSDF in `.xml`, or an `.npz` with NBRDF networks, where
    `material` names the network. Raises `SourceError` for any other file, and for a missing or damaged file.
    """
    path = Path(path)
    if path.suffix not in _READERS:
        raise SourceError(f"{path}: no source reads such files; readable files end in {', '.join(_READERS)}")
    return _READERS[path.suffix](path, material)
