"""Loads scenes, named materials and material files into Mitsuba, with error messages of one line."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nma.adapter import DEFAULT_ADAPTER
from nma.errors import NmaError, ParamError, either, one_line
from nma.images.io import check_size
from nma.materials import Material, Texture
from nma.params import LAYERED3
from nma.render.adapter_bsdf import load_once
from nma.render.textures import bitmap_texture

# The file extensions of the image formats that Mitsuba reads.
_IMAGES = (".exr", ".hdr", ".rgbe", ".pfm", ".ppm", ".png", ".jpg", ".jpeg", ".bmp", ".tga")

MODELS = ("nma", "layered")


class SceneError(NmaError, RuntimeError):
    """Mitsuba cannot load a scene; the message says where and why."""


def material_bsdf(
    material: Material, model: str = "nma", *, adapter: str | Path = DEFAULT_ADAPTER, clamp: bool = False
) -> dict[str, Any]:
    """The Mitsuba dictionary of a material.

    Args:
        material: returned by `nma.materials.load`. This function reads and checks the material's textures.
        model: "nma" (the adapter) or "layered" (the reference).
        adapter: the name of a shipped adapter, or a weights file, which Mitsuba's file resolver finds. Only the model
            "nma" uses this argument.
        clamp: whether parameters outside the adapter's training range are clamped to that range instead of rejected.

    Raises:
        ParamError: the model is unknown, or cannot show the class of the material. "nma" shows the class of its
            adapter, and "layered" shows `layered3`.
        WeightsError: there is no such adapter.
        TextureError: a texture cannot be read, or holds values that are not allowed.
    """
    if model not in MODELS:
        raise ParamError(f"unknown model {model!r}; choose {either(MODELS)}")
    if model == "nma":
        load_once(adapter).check_class(material.class_name, material.name, str(adapter))
    elif material.class_name != LAYERED3.name:
        raise ParamError(
            f"{material.name} is of class {material.class_name}, but the BSDF 'layered' simulates only class "
            f"{LAYERED3.name}; `nma simulate` makes a table of {material.name}, and `nma evaluate` compares an adapter "
            "with this table"
        )
    settings = {"adapter": str(adapter), "clamp": clamp} if model == "nma" else {}
    return {"type": model, **settings} | {name: _value(value) for name, value in material.values.items()}


def load_dict(description: Mapping[str, Any]) -> Any:
    """Calls `mi.load_dict`, and raises `SceneError` if this function fails."""
    import mitsuba as mi

    try:
        return mi.load_dict(dict(description))
    except RuntimeError as error:
        raise SceneError(one_line(str(error))) from error


def load_scene(
    path: str | Path, define: Mapping[str, str] | None = None, size: tuple[int, int] | None = None
) -> Any:
    """A Mitsuba scene from an XML file.

    Args:
        define: values of the parameters that the file writes as `$name`.
        size: width and height in pixels for the first sensor, in place of the size in the file.

    Raises:
        SceneError: there is no such file, or Mitsuba cannot load it.
        ImageError: an image of the scene is too large.
    """
    import mitsuba as mi

    if not os.path.isfile(path):
        raise SceneError(f"there is no scene file {path}")
    _check_images(Path(path))
    try:
        scene = mi.load_file(str(path), **dict(define or {}))  # type: ignore[arg-type]
    except RuntimeError as error:
        raise SceneError(one_line(str(error))) from error
    if not isinstance(scene, mi.Scene):
        raise SceneError(f"{path} contains no scene; the outermost element must be <scene>")
    if not scene.sensors():
        raise SceneError(f"{path} has no sensor; add a <sensor>")
    if size:
        film = mi.traverse(scene.sensors()[0].film())
        film["size"] = size
        film.update()
    return scene


def _check_images(path: Path) -> None:
    """Raises `ImageError` if the scene file names an image that is too large, before Mitsuba allocates its pixels."""
    for name in re.findall(rb'value\s*=\s*"([^"]+)"', path.read_bytes()):
        image = path.parent / os.fsdecode(name)
        if image.suffix.lower() in _IMAGES and image.is_file():
            check_size(image)


def _value(value: float | tuple[float, ...] | Texture) -> Any:
    if isinstance(value, Texture):
        return bitmap_texture(value.read(), scale=value.uv_scale)
    return {"type": "rgb", "value": list(value)} if isinstance(value, tuple) else value
