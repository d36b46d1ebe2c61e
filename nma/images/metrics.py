"""Measures the error of a rendered image against a reference.

`a` is the test image and `b` the reference, both linear sRGB. Errors are means over pixels and channels, as fractions,
not percent:

    l1     |a - b|                              l2     (a - b)^2
    mape   |a - b| / (|b| + eps)                smape  2 |a - b| / (|a| + |b| + eps)
    mrse   (a - b)^2 / (b^2 + eps)              eps = 0.01
    ssim   Wang et al. 2004 on display values: Gaussian window, sigma 1.5, K1 = .01, K2 = .03, range 1 (scikit-image)
    flip_ldr   mean FLIP of Andersson et al. 2020 on display values, 67 pixels per degree (flip-evaluator)
    flip_hdr   mean HDR-FLIP of Andersson et al. 2021 on linear values, ACES, exposures chosen from the reference

`nma.images.io.tonemap` computes the display values, at exposure `ldr_exposure` and with values above 1 clipped. For two
equal images ssim is 1 and every other metric is 0. ssim, flip_ldr and flip_hdr need the packages of the extra `compare`
(`pip install '.[compare]'`).
"""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nma.errors import MissingDependencyError
from nma.images.io import ImageError, as_image, tonemap

Image = NDArray[np.float32]
EPS = 0.01
SMALLEST = 11  # smallest width and height in pixels, which is the width of ssim's window
METRICS = ("l1", "l2", "mape", "smape", "mrse", "ssim", "flip_hdr", "flip_ldr")


def compare_images(
    test: ArrayLike, reference: ArrayLike, *, ldr_exposure: float = 0.0, eps: float = EPS
) -> dict[str, float]:
    """All metrics of a test image against a reference.

    Args:
        test, reference: (height, width, 3) linear sRGB, finite, of equal shape, at least 11 x 11 for ssim's window.
        ldr_exposure: exposure in stops for ssim and flip_ldr.
        eps: added to the denominators of mape, smape and mrse.

    Returns:
        One value for each name in `METRICS`, in that order.

    Raises:
        ImageError: the shapes differ, the images are too small, or values are NaN or infinite.
    """
    a, b = _pair(test, reference)
    check_size((a.shape[1], a.shape[0]))
    error = errors(a, b, eps=eps)
    error["ssim"] = _ssim(tonemap(a, exposure=ldr_exposure), tonemap(b, exposure=ldr_exposure))
    error["flip_hdr"] = float(flip_map(a, b, hdr=True).mean(dtype=np.float64))
    error["flip_ldr"] = float(flip_map(a, b, exposure=ldr_exposure).mean(dtype=np.float64))
    return {name: error[name] for name in METRICS}


def check_size(size: tuple[int, int]) -> None:
    """Raises `ImageError` for images that are too small for ssim."""
    if min(size) < SMALLEST:
        raise ImageError(
            f"images of {size[0]} x {size[1]} pixels are too small for ssim, which needs {SMALLEST} x {SMALLEST}"
        )


def errors(test: ArrayLike, reference: ArrayLike, *, eps: float = EPS) -> dict[str, float]:
    """The errors l1, l2, mape, smape and mrse, which the module's docstring defines, in double precision."""
    a, b = (image.astype(np.float64) for image in _pair(test, reference))
    difference = np.abs(a - b)
    return {
        "l1": float(difference.mean()),
        "l2": float((difference**2).mean()),
        "mape": float((difference / (np.abs(b) + eps)).mean()),
        "smape": float((2.0 * difference / (np.abs(a) + np.abs(b) + eps)).mean()),
        "mrse": float((difference**2 / (b**2 + eps)).mean()),
    }


def flip_map(test: ArrayLike, reference: ArrayLike, *, hdr: bool = False, exposure: float = 0.0) -> Image:
    """The FLIP error of each pixel: (height, width) in 0..1.

    Args:
        test, reference: (height, width, 3) linear sRGB; negative values count as 0.
        hdr: if true, compute HDR-FLIP, the maximum over a range of exposures that is chosen from the reference; if
            false, compute LDR-FLIP.
        exposure: exposure in stops, for LDR-FLIP only.
    """
    flip_evaluator = _package("flip_evaluator")
    a, b = _pair(test, reference)
    if hdr:
        a, b = np.maximum(a, 0.0), np.maximum(b, 0.0)
        settings = {"dynamicRangeString": "HDR", "parameters": _exposures(b)}
    else:
        a, b = tonemap(a, exposure=exposure), tonemap(b, exposure=exposure)
        settings = {"dynamicRangeString": "LDR", "parameters": {}}
    error, _, _ = flip_evaluator.evaluate(b, a, applyMagma=False, computeMeanError=False, **settings)
    return np.asarray(error, dtype=np.float32).reshape(b.shape[:2])


def difference_image(
    test: ArrayLike, reference: ArrayLike, *, kind: str = "flip", scale: float = 1.0, exposure: float = 0.0
) -> NDArray[np.uint8]:
    """Shows where two images differ, as an image of bytes (height, width, 3).

    Args:
        test, reference: (height, width, 3) linear sRGB.
        kind: "flip" shows LDR-FLIP in the colour map magma, from black (0) to pale yellow (`scale`). "absolute" shows
            the mean of |a - b| over the channels in the same colour map. "signed" shows the mean of a - b over the
            channels, blue where the test image is darker and red where the test image is brighter.
        scale: the difference that is shown in the last colour of the colour map.
        exposure: exposure in stops, for "flip" only.

    Raises:
        ImageError: the kind is unknown, the shapes differ, or values are NaN or infinite.
    """
    from matplotlib import colormaps

    a, b = _pair(test, reference)
    if kind == "flip":
        colours = colormaps["magma"](np.clip(flip_map(a, b, exposure=exposure) / scale, 0.0, 1.0))
    elif kind == "absolute":
        colours = colormaps["magma"](np.clip(np.abs(a - b).mean(axis=2) / scale, 0.0, 1.0))
    elif kind == "signed":
        colours = colormaps["RdBu_r"](np.clip(0.5 + 0.5 * (a - b).mean(axis=2) / scale, 0.0, 1.0))
    else:
        raise ImageError(f"difference_image: unknown kind {kind!r}; choose flip, absolute or signed")
    return (colours[..., :3] * 255.0 + 0.5).astype(np.uint8)


def _pair(test: ArrayLike, reference: ArrayLike) -> tuple[Image, Image]:
    a, b = as_image(test, "test image"), as_image(reference, "reference image")
    if a.shape != b.shape:
        sizes = " and ".join(f"{image.shape[1]} x {image.shape[0]}" for image in (a, b))
        raise ImageError(f"test and reference differ in size: {sizes} pixels; render both at the same size")
    return a, b


def ensure_packages(ssim: bool = True) -> None:
    """Raises `MissingDependencyError` if a package is missing that the metrics need.

    Call this function before a long rendering, so that the fault is found early.
    """
    for name in ("flip_evaluator", *(["skimage.metrics"] if ssim else [])):
        _package(name)


def _package(name: str) -> Any:
    """Imports an optional package that only the comparison of images needs.

    Raises:
        MissingDependencyError: the package is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"comparing images needs the package {error.name}; "
            "in a checkout of this project run: pip install '.[compare]'"
        ) from error


def _ssim(a: Image, b: Image) -> float:
    settings: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(
        _package("skimage.metrics").structural_similarity(a, b, channel_axis=-1, data_range=1.0, **settings)
    )


def _exposures(reference: Image) -> dict[str, float]:
    """The range of exposures for HDR-FLIP. If the result is empty, the package flip_evaluator chooses the range.

    For a reference that is black or of one colour, flip_evaluator would end the process, so the range is a single
    exposure for such a reference.
    """
    luminance = reference @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    brightest, middle = float(luminance.max()), float(np.median(luminance))
    if brightest > 1e-4 and brightest > 1.001 * middle:
        return {}
    exposure = -math.log2(brightest) if brightest > 1e-4 else 0.0
    return {"startExposure": exposure, "stopExposure": exposure}
