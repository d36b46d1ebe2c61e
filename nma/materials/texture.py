"""Reads textures: images that give the parameters of materials their values."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.errors import TextureError, either, one_line
from nma.images.io import CHANNELS, ImageError, coloured_layer, load_bitmap
from nma.params import ROUNDING, Param


@dataclass(frozen=True)
class Texture:
    """An image that gives `parameter` its value at each pixel: offset + scale * pixel.

    The pixels of a `raw` image are the numbers in the file, with bytes scaled to 0..1. If an image is not `raw` and has
    8 bits per channel, it is converted from sRGB to linear values. A parameter of one number needs a grey image, or a
    `channel` of the image (one of `CHANNELS`). The image repeats `uv_scale` times per unit of uv.
    """

    parameter: Param
    path: Path
    raw: bool
    scale: float = 1.0
    offset: float = 0.0
    channel: str | None = None
    uv_scale: float = 1.0

    def read(self) -> NDArray[np.float32]:
        """Reads the parameter's values (height, width, 1 or 3); row 0 is the top of the image.

        Raises `TextureError` if the file cannot be read, if a value is not finite or not valid, or if a parameter of
        one number has a coloured image and no chosen channel.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # values that are not finite raise an error below
            values = self._pixels() * np.float32(self.scale) + np.float32(self.offset)
        allowed = self.parameter.bounds("valid")
        bad = allowed.bad(values)
        if bad.any():
            pixel, place = first_pixel(values, bad)
            raise TextureError(f"{self.path}{place}: {allowed.refusal(self.parameter.name, pixel)}")
        return allowed.moved(values)

    def _pixels(self) -> NDArray[np.float32]:
        """The image's pixels (height, width, channels), linear unless `raw`.

        For a parameter of one number, the result has one channel.
        """

        bitmap = _bitmap(self.path)
        if self.channel == "a" and "A" not in [field.name for field in bitmap.struct_()]:
            raise TextureError(
                f"texture {self.path} has no alpha channel to choose for {self.parameter.name}"
            )
        if self.raw:
            bitmap.set_srgb_gamma(False)
        pixels = _converted(bitmap, self._format(bitmap.pixel_format()))
        if self.parameter.size == 3 or pixels.shape[2] == 1:
            return pixels
        if self.channel is None and is_coloured(pixels):
            raise TextureError(
                f"texture {self.path} is coloured, but {self.parameter.name} is one number; "
                f"choose the channel {either(map(repr, CHANNELS))}, for example "
                f"{{ texture = '{self.path.name}', channel = 'g' }}"
            )
        first = CHANNELS.index(self.channel or "r")
        return pixels[..., first : first + 1]

    def _format(self, own: Any) -> Any:
        """The pixel format to convert the image to.

        Images may be large, so the format has only the channels that are needed.
        """
        import mitsuba as mi

        formats: Any = mi.Bitmap.PixelFormat
        if self.channel == "a":
            return formats.RGBA
        return formats.Y if self.parameter.size == 1 and own in (formats.Y, formats.YA) else formats.RGB


def first_pixel(pixels: NDArray, bad: NDArray[np.bool_]) -> tuple[NDArray, str]:
    """The first bad pixel (channels,) of an image (height, width, channels), and a text with the pixel's position."""
    row, column, _ = np.argwhere(bad)[0]
    if bad.shape[:2] == (1, 1):
        return pixels[0, 0], ""
    count = bad.any(axis=-1).sum()
    more = f", the first of {count} such pixels" if count > 1 else ""
    return pixels[row, column], f" at x={column}, y={row}{more}"


def _converted(bitmap: Any, pixel_format: Any) -> NDArray[np.float32]:
    """The pixels (height, width, channels), converted to linear values if they are sRGB."""
    import mitsuba as mi

    array = np.array(bitmap.convert(pixel_format, mi.Struct.Type.Float32, srgb_gamma=False))
    return array.reshape(*array.shape[:2], -1)


def _bitmap(path: Path) -> Any:
    """Reads a texture file as a Mitsuba bitmap. If the file has several layers, the first colour layer is taken."""
    import mitsuba as mi

    if not os.path.isfile(path):
        raise TextureError(f"texture {path} does not exist")
    try:
        bitmap = load_bitmap(path)
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = coloured_layer(bitmap)
    except RuntimeError as error:
        raise TextureError(f"texture {path} cannot be read: {one_line(str(error))}") from error
    except ImageError as error:
        raise TextureError(str(error)) from error
    if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
        names = ", ".join(field.name for field in bitmap.struct_())
        raise TextureError(f"texture {path} has the channels {names}; a texture needs R, G, B (and A), or Y")
    return bitmap


def is_coloured(rgb: NDArray[np.float32]) -> bool:
    """Whether any pixel is coloured, which means that its channels differ by more than rounding explains.

    The difference of the largest and the smallest channel counts. The limit is `ROUNDING`, or `ROUNDING` times the
    pixel's red value if the red value is above 1. The C++ version is `grey` in runtime/mitsuba/inputs.h.
    """
    with np.errstate(invalid="ignore"):
        spread = np.ptp(rgb, axis=-1)
    return bool((spread > ROUNDING * np.maximum(np.abs(rgb[..., 0]), 1.0)).any())
