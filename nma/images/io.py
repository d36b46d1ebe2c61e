"""Images on disk: EXR for linear values, PNG for looking at. Files are written whole or not at all."""

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

# The channels of an image in the order of a pixel's numbers, and those that are its colour.
CHANNELS = ("r", "g", "b", "a")
COLOUR = CHANNELS[:3]


class ImageError(NmaError, ValueError):
    """An image cannot be read or written, has the wrong shape, or holds values that are not finite."""


def as_image(image: ArrayLike, name: str = "image") -> NDArray[np.float32]:
    """Check an image: (height, width, 3), finite.

    Raises:
        ImageError: another shape, NaN or infinity; the message counts them and names the first pixel.
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
    """Linear sRGB radiance to display values in 0..1.

    With x = 2^exposure * radiance: values up to `shoulder` stay as they are, values above it approach 1 as
    s + (1 - s) (1 - exp(-(x - s) / (1 - s))), which has the same slope at s; then the sRGB transfer curve
    (IEC 61966-2-1). Each channel on its own, so very bright colours turn white. `shoulder` = 1 clips, as metrics want.

    Args:
        image: (..., 3) linear sRGB, any value; negative values become 0.
        exposure: stops, a factor 2^exposure.
        shoulder: linear value in (0, 1] where compression starts.
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
    """Display values in 0..1 to bytes, rounded."""
    return (np.clip(np.asarray(display, dtype=np.float32), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def linear(srgb: ArrayLike) -> NDArray[np.float64]:
    """Display values in 0..1 to light: the inverse of the sRGB transfer curve (IEC 61966-2-1)."""
    x = np.asarray(srgb, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def write_png(path: str | Path, image: ArrayLike, *, exposure: float = 0.0, shoulder: float = 0.8) -> Path:
    """Tone-map a linear image (height, width, 3) and write it as an 8-bit sRGB PNG. Bytes are written as they are.

    Raises:
        ImageError: a wrong shape, or values that are not finite.
    """
    from PIL import Image

    array = np.asarray(image)
    if array.dtype != np.uint8:
        array = to_8bit(tonemap(as_image(array, str(path)), exposure=exposure, shoulder=shoulder))
    with whole(path) as file:
        Image.fromarray(array).save(file, format="PNG")
    return Path(path)


def write_exr(path: str | Path, image: ArrayLike, channels: Sequence[str] = ()) -> Path:
    """Write linear values (height, width) or (height, width, channels) as a 32-bit float EXR.

    Three channels are RGB, four RGBA; `channels` names them where they are something else.
    Values that are not finite are kept: an EXR is also for looking into what went wrong.
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
    """The file as Mitsuba's bitmap. Raises `RuntimeError` where Mitsuba cannot decode it, and as `check_size` does."""
    import mitsuba as mi

    check_size(path)
    with _second_thread():
        return mi.Bitmap(str(path))


def check_size(path: str | Path) -> None:
    """Refuses images of too many pixels by their header, before they take memory. Raises `ImageError`."""
    try:
        size = header_size(path)
    except OSError as error:
        raise ImageError(f"image {path} cannot be read: {error.strerror}") from None
    if size and size[0] * size[1] > MOST_PIXELS:
        raise ImageError(
            f"image {path} claims {size[0]} x {size[1]} pixels; at most {MOST_PIXELS:,} are read, 16384 x 8192 for "
            "example: make it smaller"
        )


@contextmanager
def _second_thread() -> Iterator[None]:
    """Where the process has one core, lends Mitsuba a thread: its EXR files wait for a second one, else forever."""
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
    """Read EXR, HDR or PFM (linear as stored) or PNG and JPEG (sRGB, made linear) as (height, width, 3) float32.

    Grey images are repeated over RGB, alpha is dropped. Of an EXR with several layers the first one in colour counts.

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
    """The first layer with red, green and blue, else the first one of a picture in grey or XYZ, else the bitmap."""
    import mitsuba as mi

    kinds = mi.Bitmap.PixelFormat
    layers = [layer for _, layer in bitmap.split()]
    for formats in ((kinds.RGB, kinds.RGBA), (kinds.Y, kinds.YA, kinds.XYZ, kinds.XYZA)):
        for layer in layers:
            if layer.pixel_format() in formats:
                return layer
    return bitmap
