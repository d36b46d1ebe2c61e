"""The sources: models and files that say how materials look.

To simulate a new class of materials, add one file to this folder and one line to `_FACTORIES`. To read a new kind of
file with the values of materials, add one file and one line to `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from nma.errors import ParamError, SourceError
from nma.sources.base import Source, Values
from nma.sources.files import Format


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


# The formats, by file extension. Each is given as a module of this folder and the name of its `Format` there.
FORMATS = {
    ".binary": "merl:FORMAT",
    ".bsdf": "mitsuba_bsdf:MEASURED",
    ".xml": "mitsuba_bsdf:XML",
    ".npz": "nbrdf:FORMAT",
}


def formats() -> dict[str, Format]:
    """The formats of files that `read` understands, by the extension of the files."""
    homes = {ending: home.split(":") for ending, home in FORMATS.items()}
    return {
        ending: getattr(import_module(f"nma.sources.{module}"), name)
        for ending, (module, name) in homes.items()
    }


def format_of(path: Path) -> Format:
    """The format of a file, by its extension. Raises `SourceError` if no source reads such files."""
    if path.suffix not in FORMATS:
        raise SourceError(f"{path}: no source reads such files; readable files end in {', '.join(FORMATS)}")
    return formats()[path.suffix]


def read(path: str | Path, material: str | None = None) -> Values:
    """Reads the values of one material from a file.

    The file is a MERL `.binary`, an RGL `.bsdf`, a Mitsuba BSDF in `.xml`, or an `.npz` with NBRDF networks, where
    `material` names the network. Raises `SourceError` for any other file, and for a missing or damaged file.
    """
    path = Path(path)
    found = format_of(path)
    if found.names is None:
        return found.read(path)
    if material is None:
        names = found.names(path)
        listed = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        raise SourceError(f"{path}: holds {len(names)} material(s); say which: {listed}")
    return found.read(path, material)
