"""Source materials as data: named ones shipped with the package, and files of the same format (docs/materials.md)."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.data import load_conductors
from nma.errors import MaterialError, ParamError, TextureError
from nma.image_io import load_bitmap
from nma.params import SPACES, Param, ParamSpace

__all__ = ["Material", "Texture", "load", "names"]

FOLDER = Path(__file__).parent
HEADER = ("title", "description", "class", "parameters")
TEXTURE_OPTIONS = ("texture", "raw", "scale", "offset")


@dataclass(frozen=True)
class Texture:
    """An image that drives `parameter`: its value is offset + scale * pixel.

    Pixels of a `raw` image are the numbers in the file, bytes as 0..1; otherwise 8-bit images are sRGB and
    made linear.
    """

    parameter: Param
    path: Path
    raw: bool
    scale: float = 1.0
    offset: float = 0.0

    def read(self) -> NDArray[np.float32]:
        """The parameter's values (height, width, size), row 0 at the top of the image.

        Raises `TextureError` if the file cannot be read, or holds values that are not finite or physically
        invalid.
        """
        values = _read_image(self.path, self.parameter.size, self.raw) * np.float32(self.scale)
        values += np.float32(self.offset)
        low, high = self.parameter.bounds("valid")
        slack = 1e-6  # single precision
        bad = ~((values >= low - slack) & (values <= high + slack)) | ~np.isfinite(values)
        if bad.any():
            row, column, channel = np.argwhere(bad)[0]
            raise TextureError(
                f"{self.path}: {bad.sum()} of {bad.size} values are not allowed for {self.parameter.name} "
                f"({low:g} .. {high:g}), the first is {values[row, column, channel]} at x={column}, y={row}"
            )
        return np.clip(values, low, high)


def _read_image(path: Path, channels: int, raw: bool) -> NDArray[np.float32]:
    """Pixels (height, width, channels), grey if `channels` is 1, linear unless `raw`."""
    import mitsuba as mi

    if not path.is_file():
        raise TextureError(f"texture {path} does not exist")
    try:
        bitmap = load_bitmap(path)
    except RuntimeError as error:
        raise TextureError(f"texture {path} cannot be read: {str(error).splitlines()[0]}") from error
    if raw:
        bitmap.set_srgb_gamma(False)
    pixels = mi.Bitmap.PixelFormat.Y if channels == 1 else mi.Bitmap.PixelFormat.RGB
    array = np.array(bitmap.convert(pixels, mi.Struct.Type.Float32, srgb_gamma=False))
    return array.reshape(*array.shape[:2], channels)


@dataclass(frozen=True)
class Material:
    """A source material: `values` has a number, an RGB triple or a `Texture` for each parameter of its class."""

    name: str
    title: str
    description: str
    class_name: str
    values: dict[str, float | tuple[float, ...] | Texture]

    @property
    def space(self) -> ParamSpace:
        """The parameters of the material's class."""
        return SPACES[self.class_name]

    @property
    def textures(self) -> dict[str, Texture]:
        """The parameters that an image drives."""
        return {name: value for name, value in self.values.items() if isinstance(value, Texture)}

    def vector(self) -> NDArray[np.float64]:
        """The parameters (13,) in the order of the class; `MaterialError` if any is textured."""
        if self.textures:
            raise MaterialError(
                f"material '{self.name}' has no single parameter vector: "
                f"{', '.join(self.textures)} come from textures; give numbers instead"
            )
        numbers: dict[str, Any] = dict(self.values)
        return self.space.vector(numbers)

    @staticmethod
    def of_vector(name: str, vector: NDArray[np.float64], space: ParamSpace) -> Material:
        """The material of a parameter vector, one row of those that `ParamSpace.sample` draws."""
        values: dict[str, Any] = {
            param.name: float(vector[columns][0])
            if param.size == 1
            else tuple(np.asarray(vector)[columns].tolist())
            for param, columns in zip(space.params, space.slices.values(), strict=True)
        }
        return Material(name, name.replace("-", " ").capitalize(), "", space.name, values)

    def changed(self, given: Mapping[str, Any], where: str | Path = "changes") -> Material:
        """A copy with some parameters replaced, given as in a file: numbers, lists, `conductor`, textures.

        Texture paths are relative to the folder of `where`, which errors name. Raises `MaterialError`.
        """
        return replace(self, values=self.values | _values(given, self.space, Path(where), partial=True))


def names() -> tuple[str, ...]:
    """Names of the materials shipped with the package, sorted."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def load(name_or_path: str | Path) -> Material:
    """A shipped material by its name, or one from a file (anything that ends in `.toml`).

    Values may be anything physically valid; whether an adapter knows them is the adapter's to say. Texture
    files must exist, they are read by `Texture.read`. Raises `MaterialError` that names the file and the
    fault.
    """
    if str(name_or_path).endswith(".toml"):
        path = Path(name_or_path)
        if not path.is_file():
            raise MaterialError(f"there is no material file {path}")
    else:
        path = FOLDER / f"{name_or_path}.toml"
        if str(name_or_path) not in names():
            raise MaterialError(
                f"there is no material '{name_or_path}'{_suggestion(str(name_or_path), names())}; "
                "`nma materials` lists all of them, and a file's name must end in .toml"
            )
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise MaterialError(f"{path} is no TOML file: {error}") from error
    return _parse(document, path)


def _parse(document: Mapping[str, Any], path: Path) -> Material:
    _refuse_unknown(document, HEADER, str(path))
    for key in ("title", "class", "parameters"):
        if key not in document:
            raise MaterialError(f"{path}: '{key}' is missing; a file has {', '.join(HEADER)}")
    class_name = document["class"]
    if class_name not in SPACES:
        raise MaterialError(f"{path}: there is no class '{class_name}'; there is {', '.join(SPACES)}")
    if not isinstance(document["parameters"], Mapping):
        raise MaterialError(f"{path}: 'parameters' must be a table: [parameters], then one line each")
    values = _values(document["parameters"], SPACES[class_name], path)
    title, description = str(document["title"]), str(document.get("description", ""))
    return Material(path.stem, title, description, class_name, values)


def _values(given: Mapping[str, Any], space: ParamSpace, path: Path, partial: bool = False) -> dict[str, Any]:
    """One checked value per parameter of the class, in its order; only those given if `partial`."""
    given = _with_indices(given, path)
    known = [param.name for param in space.params]
    _refuse_unknown(given, (*known, "conductor"), f"{path}, [parameters]")
    if not partial and (missing := [name for name in known if name not in given]):
        raise MaterialError(f"{path}, [parameters]: {', '.join(missing)} missing")
    values = {p.name: _value(given[p.name], p, path) for p in space.params if p.name in given}

    # Textures are checked when they are read; any allowed number stands in for them here, and for what is not given.
    numbers: dict[str, Any] = {param.name: param.low for param in space.params}
    numbers |= {name: value for name, value in values.items() if not isinstance(value, Texture)}
    try:
        space.check(space.vector(numbers))
    except ParamError as error:
        raise MaterialError(f"{path}: {error}") from error
    return values


def _with_indices(given: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Replaces `conductor` by the refractive index of that metal."""
    values = dict(given)
    if "conductor" not in values:
        return values
    if twice := [name for name in ("eta_conductor", "k_conductor") if name in values]:
        raise MaterialError(f"{path}, [parameters]: give either conductor or {' and '.join(twice)}")
    name, metals = values.pop("conductor"), load_conductors()
    if name not in metals.names:
        raise MaterialError(
            f"{path}: there is no conductor '{name}'{_suggestion(str(name), metals.names)}; "
            f"there is {', '.join(metals.names)}"
        )
    row = metals.names.index(name)
    return values | {"eta_conductor": metals.eta[row].tolist(), "k_conductor": metals.k[row].tolist()}


def _value(given: Any, param: Param, path: Path) -> float | tuple[float, ...] | Texture:
    """A number, a triple, or a texture; a number for a triple means grey."""
    if isinstance(given, Mapping):
        return _texture(given, param, path)
    numbers = given if isinstance(given, list) else [given] * param.size
    if len(numbers) != param.size or not all(_is_number(x) for x in numbers):
        kind = "a number" if param.size == 1 else f"a number or a list of {param.size}"
        raise MaterialError(
            f"{path}: {param.name} is {given!r}, but must be {kind} or {{ texture = 'FILE' }}"
        )
    return float(numbers[0]) if param.size == 1 else tuple(float(x) for x in numbers)


def _texture(given: Mapping[str, Any], param: Param, path: Path) -> Texture:
    where = f"{path}, {param.name}"
    _refuse_unknown(given, TEXTURE_OPTIONS, where)
    if not isinstance(given.get("texture"), str):
        raise MaterialError(f"{where}: texture must be a file name, relative to the material's file")
    if not isinstance(given.get("raw", True), bool):
        raise MaterialError(f"{where}: raw must be true or false")
    scale, offset = given.get("scale", 1.0), given.get("offset", 0.0)
    if not (_is_number(scale) and _is_number(offset)):
        raise MaterialError(f"{where}: scale and offset must be numbers")
    image = (path.parent / given["texture"]).resolve()
    if not image.is_file():
        raise MaterialError(f"{where}: there is no texture {image}")
    # Colours are painted in sRGB, everything else is a number.
    raw = given.get("raw", param.name != "albedo")
    return Texture(param, image, raw, float(scale), float(offset))


def _is_number(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool)


def _refuse_unknown(given: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    for key in given:
        if key not in known:
            raise MaterialError(
                f"{where}: unknown key '{key}'{_suggestion(key, known)}; known are {', '.join(known)}"
            )


def _suggestion(given: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(given, known, n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else ""
