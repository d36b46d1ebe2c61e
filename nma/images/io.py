"""Reads image files, and writes images as EXR (linear values) or PNG (for viewing).

A file is written completely or not at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nma.errors import NmaError, one_line
from nma.files import whole, write_bytes
from nma.images.size import MOST_PIXELS, header_size

# The names of an image's channels, in the order in which a pixel stores them. The first three channels are the colour
# channels.
CHANNELS = ("r", "g", "b", "a")
COLOUR = CHANNELS[:3]


class ImageError(NmaError, ValueError):
    """An image cannot be read or written, has the wrong shape, or holds values that are not finite."""


def as_image(image: ArrayLike, name: str = "image") -> NDArray[np.float32]:
    """Converts an image to float32, after a check that its shape is (height, width, 3) and that all values are finite.

    Raises:
        ImageError: the shape is wrong, or values are NaN or infinite. The error message has the number of NaN or
            infinite pixels, and the position of the first.
    """
    array = np.asarray(image, dtype=np.float32)
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ImageError(f"{name}: shape {array.shape} is not (height, width, 3); pass linear RGB")
    bad = ~np.isfinite(array).all(axis=2)
    if bad.any():
        y, x = np.argwhere(bad)[0]
        raise ImageError(
            f"{name}: {bad.sum()} of {bad.size} pixels are NaN or infinite, the first at x={x}, y={y}"
        )
    return array


def tonemap(image: ArrayLike, *, exposure: float = 0.0, shoulder: float = 1.0) -> NDArray[np.float32]:
    """Converts linear sRGB radiance to display values (..., 3) in 0..1.

    Let x = 2^exposure * radiance and s = `shoulder`. The function first compresses x. A value of x up to s stays as it
    is. A larger value becomes s + (1 - s) (1 - exp(-(x - s) / (1 - s))), which has slope 1 at s and approaches 1 for
    large x. Then the function applies the sRGB transfer curve (IEC 61966-2-1). Each channel is converted by itself, so
    very bright colours become white. With `shoulder` = 1, values above 1 are clipped, as error metrics require.

    Args:
        image: linear sRGB (..., 3); negative values become 0.
        exposure: exposure in stops; radiance is multiplied by 2^exposure.
        shoulder: linear value, in (0, 1], at which compression starts.
    """
    if not 0.0 < shoulder <= 1.0:
        raise ImageError(f"tonemap: shoulder {shoulder} must lie in (0, 1]")
    x = np.maximum(np.asarray(image, dtype=np.float32) * np.float32(2.0**exposure), 0.0)
    if shoulder < 1.0:
        room = 1.0 - shoulder
        x = np.where(x > shoulder, 1.0 - room * np.exp(-np.maximum(x - shoulder, 0.0) / room), x)
    x = np.clip(x, 0.0, 1.0)
    curve = 1.055 * np.power(np.maximum(x, 1e-8), 1.0 / 2.4) - 0.055
    return np.where(x <= 0.0031308, 12.92 * x, curve).astype(np.float32)


def to_8bit(display: ArrayLike) -> NDArray[np.uint8]:
    """Converts display values in 0..1 to bytes, rounded."""
    return (np.clip(np.asarray(display, dtype=np.float32), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def linear(srgb: ArrayLike) -> NDArray[np.float64]:
    """Converts display values in 0..1 to linear values, by the inverse of the sRGB transfer curve (IEC 61966-2-1)."""
    x = np.asarray(srgb, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def write_png(path: str | Path, image: ArrayLike, *, exposure: float = 0.0, shoulder: float = 0.8) -> Path:
    """Tone-maps a linear image (height, width, 3) and writes it as an 8-bit sRGB PNG.

    An image of bytes is written unchanged.

    Raises:
        ImageError: the shape is wrong, or values are not finite.
    """
    from PIL import Image

    array = np.asarray(image)
    if array.dtype != np.uint8:
        array = to_8bit(tonemap(as_image(array, str(path)), exposure=exposure, shoulder=shoulder))
    with whole(path) as file:
        Image.fromarray(array).save(file, format="PNG")
    return Path(path)


def write_exr(path: str | Path, image: ArrayLike, channels: Sequence[str] = ()) -> Path:
    """Writes linear values (height, width) or (height, width, channels) as a 32-bit float EXR.

    Three channels are written as RGB and four as RGBA; `channels` replaces these channel names. NaN and infinite values
    are written as they are, so that the file shows which pixels are wrong.
    """
    import mitsuba as mi

    array = np.ascontiguousarray(image, dtype=np.float32)
    if array.ndim not in (2, 3) or 0 in array.shape:
        raise ImageError(f"{path}: cannot write an array of shape {array.shape} as an image")
    kind = mi.Bitmap.PixelFormat.MultiChannel if channels else None
    bitmap = mi.Bitmap(array, kind, list(channels))
    content = mi.MemoryStream()
    with _second_thread():
        bitmap.write(content, mi.Bitmap.FileFormat.OpenEXR)
    write_bytes(path, content.raw_buffer())
    return Path(path)


def load_bitmap(path: str | Path) -> Any:
    """Reads a file as a Mitsuba bitmap.

    Raises `RuntimeError` if Mitsuba cannot decode the file, and `ImageError` if the file cannot be opened or the image
    is too large.
    """
    import mitsuba as mi

    check_size(path)
    with _second_thread():
        return mi.Bitmap(str(path))


def check_size(path: str | Path) -> None:
    """Raises `ImageError` if an image has too many pixels.

    Only the file's header is read, which needs little memory.
    """
    try:
        size = header_size(path)
    except OSError as error:
        raise ImageError(f"image {path} cannot be read: {error.strerror}") from None
    if size and size[0] * size[1] > MOST_PIXELS:
        raise ImageError(
            f"image {path} has {size[0]} x {size[1]} pixels according to its header, more than the {MOST_PIXELS:,} "
            "(for example 16384 x 8192) that can be read; make the image smaller"
        )


@contextmanager
def _second_thread() -> Iterator[None]:
    """Gives Dr.Jit a second thread in this context, because with one thread Mitsuba's EXR code would wait forever."""
    import drjit as dr

    if dr.thread_count() > 1:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.set_thread_count(1)


def read_image(path: str | Path) -> NDArray[np.float32]:
    """Reads an image as linear float32 (height, width, 3): EXR, HDR, PFM as stored, PNG and JPEG converted from sRGB.

    Grey is copied to all three channels, and alpha is dropped. Of an EXR file with several layers, only the first
    colour layer is read.

    Raises:
        ImageError: the file does not exist or cannot be decoded.
    """
    import mitsuba as mi

    if not Path(path).is_file():
        raise ImageError(f"image {path} does not exist")
    try:
        bitmap = load_bitmap(path)
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = coloured_layer(bitmap)
        return np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False))
    except RuntimeError as error:
        raise ImageError(f"image {path} cannot be read: {one_line(str(error))}") from error


def coloured_layer(bitmap: Any) -> Any:
    """The bitmap's first RGB layer, or its first grey or XYZ layer if no layer is RGB, or else the bitmap itself."""
    import mitsuba as mi

    kinds = mi.Bitmap.PixelFormat
    layers = [layer for _, layer in bitmap.split()]
    for formats in ((kinds.RGB, kinds.RGBA), (kinds.Y, kinds.YA, kinds.XYZ, kinds.XYZA)):
        for layer in layers:
            if layer.pixel_format() in formats:
                return layer
    return bitmap
