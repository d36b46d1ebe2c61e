"""Checks whether numbers and pixels are allowed for a parameter, and writes the error messages."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma.errors import ParamError, TextureError, either
from nma.images.io import COLOUR, linear
from nma.materials.texture import first_pixel, is_coloured
from nma.params import Param, Range


class Allowed(NamedTuple):
    """The allowed values of a parameter: the numbers in its range, or with `clamp` all finite numbers."""

    param: Param
    range: Range
    clamp: bool

    def bad(self, numbers: NDArray) -> NDArray[np.bool_]:
        return self.param.bounds(self.range).bad(numbers, self.clamp)

    def refusal(self, found: NDArray) -> str:
        return self.param.bounds(self.range).refusal(self.param.name, found, self.range)


def check_numbers(allowed: Allowed, value: Any) -> None:
    """Raises `ParamError` for numbers that are not allowed."""
    numbers = _plain(value).ravel()
    name, size = allowed.param.name, allowed.param.size
    if numbers.size not in (1, size):
        raise ParamError(f"{name} needs {size} number(s), got {numbers.size}")
    if allowed.bad(numbers).any():
        raise ParamError(allowed.refusal(numbers))


def check_texture(allowed: Allowed, texture: Any, leaves: list[Any], channel: int | None) -> None:
    """Raises `TextureError` for values that are not allowed, or for a coloured texture of a parameter with one number.

    Args:
        leaves: the texture's arrays of pixels and numbers, as far as they are known before rendering.
        channel: index of the only channel that the parameter uses, or None if no channel was chosen.
    """
    name = f" ({texture.id()})" if texture.id() else ""
    where = f"the texture of {allowed.param.name}{name}"
    for values in map(_plain, leaves):
        pixels = values if values.ndim == 3 else values.reshape(1, 1, -1)
        try:
            _check_pixels(allowed, _decoded(pixels, texture), where, channel)
        except TextureError as error:
            if pixels.dtype != np.uint8:
                raise
            hint = (
                "the pixels are stored as bytes, which hold only 0 to 1; "
                'with `format` "variant" a bitmap keeps floats, which can be edited'
            )
            raise TextureError(f"{error}; {hint}") from None


def _plain(value: Any) -> NDArray:
    """The values of a Dr.Jit array as a NumPy array.

    Colours are converted channel by channel. Converting a whole colour would scatter the colour into one array, which
    cannot be read while Dr.Jit records.
    """
    import mitsuba as mi

    return np.concatenate([np.array(c) for c in value]) if isinstance(value, mi.Color3f) else np.array(value)


def _decoded(pixels: NDArray, texture: Any) -> NDArray:
    """The values to which the texture evaluates. Mitsuba keeps 8-bit files as bytes, in sRGB unless the texture is
    `raw`."""
    if pixels.dtype != np.uint8:
        return pixels
    unit = pixels / 255.0
    return unit if "raw = 1" in str(texture) else linear(unit)


def _check_pixels(allowed: Allowed, pixels: NDArray, where: str, channel: int | None) -> None:
    """Checks pixels (height, width, channels). A single number or colour counts as an image of one pixel."""
    name, size = allowed.param.name, allowed.param.size
    coloured = pixels.shape[-1] >= 3
    if coloured and channel is not None:
        pixels = pixels[..., channel : channel + 1]
    elif size == 1 and coloured and is_coloured(pixels):
        raise TextureError(
            f"{where} is coloured, and {name} is one number per pixel; choose a channel: set `{name}_channel` to "
            f"{either(COLOUR)}"
        )
    bad = allowed.bad(pixels)
    if bad.any():
        pixel, place = first_pixel(pixels, bad)
        raise TextureError(f"{where}{place}: {allowed.refusal(pixel)}")
