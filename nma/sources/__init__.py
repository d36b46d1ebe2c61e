"""Simulates materials by random walks, and reads BRDF values of materials from files.

To simulate a new class of materials, add one file to this folder, with the class's parameters and its source, and one
line to `CLASSES`. To read a new format of files that store BRDF values, add one file to this folder and one line to
`FORMATS`.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nma.errors import ParamError, SourceError, shown, some
from nma.params import LAYERED3, LIBRARY, MEASURED, ParamSpace

if TYPE_CHECKING:
    from nma.sources.base import Source, Values
    from nma.sources.files import Format

# The entries of `CLASSES` and `FORMATS` have the form `module:name`: a module of this folder, and a name defined in the
# module. The module is imported when the entry is first used. The keys of `CLASSES` are the classes that can be
# simulated, and the values are their sources. The `space` of a source has the parameters of its class.
CLASSES = {"layered3": "layered:Layered3"}
# Formats of files that store BRDF values, by the extension of the files:
FORMATS = {
    ".binary": "merl:FORMAT",
    ".bsdf": "mitsuba_bsdf:MEASURED",
    ".xml": "mitsuba_bsdf:XML",
    ".npz": "nbrdf:FORMAT",
}


# `_SPACES` has the parameters of classes that cannot be simulated, and of the classes of the shipped adapters. Shipped
# adapters must load without Dr.Jit, so their parameters cannot come from a source, which imports Dr.Jit.
_SPACES = {space.name: space for space in (LAYERED3, MEASURED, LIBRARY)}


def classes() -> tuple[str, ...]:
    """Names of all classes: the classes that can be simulated, `measured` and `library`."""
    return tuple(dict.fromkeys((*CLASSES, *_SPACES)))


def space(name: str) -> ParamSpace:
    """The parameters of the class `name`. Raises `ParamError` if there is no such class."""
    if name in _SPACES:
        return _SPACES[name]
    if name not in CLASSES:
        raise ParamError(f"there is no class {shown(name)}; the classes are {', '.join(classes())}")
    return get(name).space


def names() -> tuple[str, ...]:
    """Names of the classes that can be simulated."""
    return tuple(CLASSES)


def get(name: str) -> Source:
    """The source that simulates the class `name`. Raises `ParamError` if there is no such class, or if the key `name`
    of `CLASSES` differs from the name of the source's class."""
    if name not in CLASSES:
        raise ParamError(f"unknown class {shown(name)}; known classes are {', '.join(CLASSES)}")
    source = _at(CLASSES[name])()
    if source.space.name != name:
        raise ParamError(
            f"nma/sources/__init__.py: the key '{name}' of CLASSES is not the name of its class, which is "
            f"'{source.space.name}'; make both names equal"
        )
    return source


def formats() -> dict[str, Format]:
    """The file formats that `read` can read, by file extension."""
    return {ending: _at(home) for ending, home in FORMATS.items()}


def format_of(path: Path) -> Format:
    """The format that a file has according to its extension. Raises `SourceError` if no source reads such files."""
    if path.suffix not in FORMATS:
        raise SourceError(f"{path}: no source reads such files; readable files end in {', '.join(FORMATS)}")
    return _at(FORMATS[path.suffix])


def read(path: str | Path, material: str | None = None) -> Values:
    """Reads the values (`Values`) of one material from a file.

    The file is a MERL `.binary`, an RGL `.bsdf`, a Mitsuba BSDF in `.xml`, or an `.npz` with NBRDF networks, where
    `material` names the network. Raises `SourceError` for any other file, and for a missing or damaged file.
    """
    path = Path(path)
    found = format_of(path)
    if found.names is None:
        return found.read(path)
    if material is None:
        names = found.names(path)
        raise SourceError(f"{path}: holds {len(names)} material(s); say which: {some(names)}")
    return found.read(path, material)


def _at(home: str) -> Any:
    """The object that a registry names as `module:name`."""
    module, name = home.split(":")
    return getattr(import_module(f"nma.sources.{module}"), name)
