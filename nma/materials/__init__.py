"""Reads the named materials of the package, and the material files of users (docs/materials.md)."""

from __future__ import annotations

import math
import os
import re
import reprlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import sources
from nma.conductors import load_conductors
from nma.errors import MaterialError, ParamError, closest, either, one_line
from nma.images.io import CHANNELS, linear
from nma.materials.texture import Texture
from nma.params import Param, ParamSpace

__all__ = ["Material", "Texture", "load", "names"]

FOLDER = Path(__file__).parent
HEADER = ("title", "description", "class", "uv_scale", "parameters")
TEXTURE_OPTIONS = ("texture", "raw", "channel", "scale", "offset", "uv_scale")
# A material file is about a page of text, so a file with more than `MAX_BYTES` is rejected.
MAX_BYTES = 1 << 20

_BARE_POINT = re.compile(r"[=\[,]\s*[-+]?\.\d")  # finds numbers such as .05, which TOML rejects
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60


@dataclass(frozen=True)
class Material:
    """A material of a class: `values` has a number, an RGB triple or a `Texture` for each parameter of the class.

    `uv_scale` is the default for textures that `changed` adds: the number of times that a texture repeats per unit of
    uv.
    """

    name: str
    title: str
    description: str
    class_name: str
    values: dict[str, float | tuple[float, ...] | Texture]
    uv_scale: float = 1.0

    @property
    def space(self) -> ParamSpace:
        """The parameters of the material's class."""
        return sources.space(self.class_name)

    @property
    def textures(self) -> dict[str, Texture]:
        """The textures among the values, by the name of the parameter."""
        return {name: value for name, value in self.values.items() if isinstance(value, Texture)}

    def vector(self) -> NDArray[np.float64]:
        """The parameter vector (columns of the class,). Raises `MaterialError` if a parameter has a texture."""
        if self.textures:
            raise MaterialError(
                f"material '{self.name}' has no single parameter vector: "
                f"{', '.join(self.textures)} come from textures; give numbers instead"
            )
        numbers: dict[str, Any] = dict(self.values)
        return self.space.vector(numbers)

    @staticmethod
    def of_vector(name: str, vector: NDArray[np.float64], space: ParamSpace) -> Material:
        """The material of a parameter vector (size,), such as a row that `ParamSpace.sample` returns."""
        values: dict[str, Any] = {
            param.name: float(vector[columns][0])
            if param.size == 1
            else tuple(np.asarray(vector)[columns].tolist())
            for param, columns in zip(space.params, space.slices.values(), strict=True)
        }
        return Material(name, name.replace("-", " ").capitalize(), "", space.name, values)

    def changed(self, given: Mapping[str, Any], where: str | Path = "changes") -> Material:
        """Returns a copy in which the parameters in `given` have new values.

        The values have the same form as in a material file: numbers, lists, hexadecimal colours, textures, or a metal
        for the key `conductor`. `where` is a path: error messages begin with this path, and texture files are relative
        to its folder. Raises `MaterialError` for a value that is not valid.
        """
        changed = _values(given, self.space, Path(where), self.uv_scale, partial=True)
        return replace(self, values=self.values | changed)


def names() -> tuple[str, ...]:
    """The sorted names of the materials that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def load(name_or_path: str | Path) -> Material:
    """Loads a shipped material by its name, or a material from a file whose name ends in `.toml`.

    The material's values must be physically valid; an adapter checks later whether the values are in the adapter's
    training range. Texture files must exist; `Texture.read` reads them later. Raises `MaterialError`, whose message
    names the file and the fault.
    """
    if str(name_or_path).endswith(".toml"):
        path = Path(name_or_path)
        if not os.path.isfile(path):
            raise MaterialError(f"there is no material file {_short(path)}")
    else:
        path = FOLDER / f"{name_or_path}.toml"
        if str(name_or_path) not in names():
            raise MaterialError(
                f"there is no material '{_short(name_or_path)}'{_suggestion(str(name_or_path), names())}; "
                "`nma materials` lists all of them, and a file's name must end in .toml"
            )
    return _parse(_document(path), path)


def _document(path: Path) -> Mapping[str, Any]:
    """Reads and parses a TOML file."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MaterialError(f"{path}: not a material file, because it has more than {MAX_BYTES:,} bytes")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise MaterialError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise MaterialError(f"{path} is no TOML file: {error}") from error
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise MaterialError(
            f"{path} is not a material file: its lists or tables are nested too deeply"
        ) from None
    except ValueError as error:  # invalid TOML, or a number with too many digits
        hint = "; numbers begin with a digit, 0.05" if _BARE_POINT.search(text) else ""
        raise MaterialError(f"{path} is no TOML file: {one_line(str(error))}{hint}") from error


def _parse(document: Mapping[str, Any], path: Path) -> Material:
    _refuse_unknown(document, HEADER, str(path))
    for key in ("title", "class", "parameters"):
        if key not in document:
            raise MaterialError(
                f"{path}: '{key}' is missing; a material file has the keys {', '.join(HEADER)}"
            )
    for key in ("title", "description", "class"):
        if not isinstance(document.get(key, ""), str):
            raise MaterialError(f"{path}: {key} is {_shown(document[key])}, but must be text in quotes")
    class_name = document["class"]
    if class_name not in sources.classes():
        raise MaterialError(
            f"{path}: there is no class {_shown(class_name)}; the classes are {', '.join(sources.classes())}"
        )
    if not isinstance(document["parameters"], Mapping):
        raise MaterialError(
            f"{path}: 'parameters' must be a table: a line [parameters], then one line per parameter"
        )
    uv_scale = _uv_scale(document, 1.0, str(path))
    values = _values(document["parameters"], sources.space(class_name), path, uv_scale)
    title, description = (" ".join(document.get(key, "").split()) for key in ("title", "description"))
    return Material(path.stem, title, description, class_name, values, uv_scale)


def _values(
    given: Mapping[str, Any], space: ParamSpace, path: Path, uv_scale: float, partial: bool = False
) -> dict[str, Any]:
    """Returns the checked values, in the order of the class's parameters. With `partial`, parameters may be missing."""
    given = _with_indices(given, path)
    known = [param.name for param in space.params]
    _refuse_unknown(given, (*known, "conductor"), f"{path}, [parameters]")
    if not partial and (missing := [name for name in known if name not in given]):
        raise MaterialError(f"{path}, [parameters]: no value for {', '.join(missing)}")
    values = {p.name: _value(given[p.name], p, path, uv_scale) for p in space.params if p.name in given}

    # Only numbers are checked here, because textures are checked when they are read. For the check, a valid number
    # takes the place of each texture and of each missing parameter.
    numbers: dict[str, Any] = {param.name: param.low for param in space.params}
    numbers |= {name: value for name, value in values.items() if not isinstance(value, Texture)}
    try:
        space.check(space.vector(numbers))
    except ParamError as error:
        raise MaterialError(f"{path}: {error}") from error
    return values


def _with_indices(given: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Returns the values, with the key `conductor` (a metal's name) replaced by the metal's refractive index."""
    values = dict(given)
    if "conductor" not in values:
        return values
    if twice := [name for name in ("eta_conductor", "k_conductor") if name in values]:
        raise MaterialError(f"{path}, [parameters]: give either conductor or {' and '.join(twice)}")
    name, metals = values.pop("conductor"), load_conductors()
    if name not in metals.names:
        raise MaterialError(
            f"{path}: there is no conductor {_shown(name)}{_suggestion(name, metals.names)}; "
            f"the conductors are {', '.join(metals.names)}"
        )
    row = metals.names.index(name)
    return values | {"eta_conductor": metals.eta[row].tolist(), "k_conductor": metals.k[row].tolist()}


def _value(given: Any, param: Param, path: Path, uv_scale: float) -> float | tuple[float, ...] | Texture:
    """The value of a parameter from its TOML value: a number, a list, a hexadecimal colour, or a texture.

    A single number for an RGB parameter means grey.
    """
    if isinstance(given, Mapping):
        return _texture(given, param, path, uv_scale)
    if isinstance(given, str) and given.startswith("#"):
        return _colour(given, param, path)
    numbers = given if isinstance(given, list) else [given] * param.size
    if len(numbers) != param.size or not all(_is_number(x) for x in numbers):
        kind = "a number" if param.size == 1 else f"a number or a list of {param.size}"
        kind += ", a colour '#3366ee'" if _is_colour(param) else ""
        raise MaterialError(
            f"{path}: {param.name} is {_shown(given)}, but must be {kind} or {{ texture = 'FILE' }}"
        )
    return _float(numbers[0]) if param.size == 1 else tuple(_float(x) for x in numbers)


def _colour(given: str, param: Param, path: Path) -> tuple[float, ...]:
    """The linear value of an sRGB colour in hexadecimal digits."""
    if not _is_colour(param):
        raise MaterialError(
            f"{path}: {param.name} is {_shown(given)}, but this parameter is no colour; give numbers"
        )
    if not re.fullmatch("#[0-9a-fA-F]{6}", given):
        raise MaterialError(f"{path}: {param.name} is {_shown(given)}; a colour has six digits, as '#3366ee'")
    return tuple(linear([int(given[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]).tolist())


def _is_colour(param: Param) -> bool:
    """Whether the parameter is a colour, which users choose in sRGB: three numbers in 0..1, such as an albedo."""
    return param.size == 3 and param.bounds("valid") == (0.0, 1.0)


def _texture(given: Mapping[str, Any], param: Param, path: Path, uv_scale: float) -> Texture:
    where = f"{path}, {param.name}"
    _refuse_unknown(given, TEXTURE_OPTIONS, where)
    if not isinstance(given.get("texture"), str):
        raise MaterialError(
            f"{where}: texture must be the name of a file, relative to the material file's folder"
        )
    if not isinstance(given.get("raw", True), bool):
        raise MaterialError(f"{where}: raw must be true or false")
    scale, offset = (
        _option(given, key, default, where) for key, default in (("scale", 1.0), ("offset", 0.0))
    )
    image = path.parent / given["texture"]
    if not os.path.isfile(image):
        raise MaterialError(f"{where}: there is no texture {_short(image)}")
    # By default, an image for a colour is read as sRGB, and any other image as raw numbers.
    raw, channel = given.get("raw", not _is_colour(param)), _channel(given, param, where)
    return Texture(param, image.resolve(), raw, scale, offset, channel, _uv_scale(given, uv_scale, where))


def _channel(given: Mapping[str, Any], param: Param, where: str) -> str | None:
    """The image channel chosen for a parameter of one number, or None if no channel is chosen."""
    channel = given.get("channel")
    if channel is None:
        return None
    if channel not in CHANNELS:
        raise MaterialError(
            f"{where}: channel is {_shown(channel)}, but must be {either(map(repr, CHANNELS))}"
        )
    if param.size > 1:
        raise MaterialError(
            f"{where}: a channel is for parameters of one number, but {param.name} has {param.size} numbers"
        )
    return channel


def _uv_scale(given: Mapping[str, Any], default: float, where: str) -> float:
    """The number of times that an image repeats per unit of uv."""
    uv_scale = _option(given, "uv_scale", default, where)
    if not uv_scale > 0:
        raise MaterialError(f"{where}: uv_scale is {uv_scale:g}, but must be above 0")
    return uv_scale


def _option(given: Mapping[str, Any], key: str, default: float, where: str) -> float:
    """The number given for the option `key`, which must be finite, or else the option's default."""
    value = given.get(key, default)
    if not (_is_number(value) and abs(_float(value)) < 1e38):
        raise MaterialError(f"{where}: {key} is {_shown(value)}, but must be a finite number")
    return _float(value)


def _is_number(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool)


def _float(x: float) -> float:
    """Converts a number to a float.

    TOML allows integers that are too large for a float; such integers become infinite.
    """
    try:
        return float(x)
    except OverflowError:
        return math.inf if x > 0 else -math.inf


def _shown(given: Any) -> str:
    """Converts a value from a file to text for an error message: short, and on one line."""
    try:
        return _REPR.repr(given)
    except ValueError:
        return "a number of too many digits"


def _short(name: object) -> str:
    """Converts a name to text for an error message: short, and on one line."""
    text = repr(str(name))[1:-1]
    return text if len(text) <= 300 else f"{text[:100]}..."


def _refuse_unknown(given: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    for key in given:
        if key not in known:
            raise MaterialError(
                f"{where}: unknown key {_shown(key)}{_suggestion(key, known)}; known keys are {', '.join(known)}"
            )


def _suggestion(given: Any, known: tuple[str, ...]) -> str:
    near = closest(_short(given), known) if isinstance(given, str) else None
    return f" (did you mean '{near}'?)" if near else ""
