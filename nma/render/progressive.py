"""Rendering in passes, so that a long rendering shows how far it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.errors import ParamError, one_line
from nma.images.size import MOST_PIXELS
from nma.render.load import SceneError

# Samples of one pass over the whole picture: a few seconds on two cores, and a bound on memory. A pixel of 512 x 512
# has 16 of them: the more are laid out together, the less noise they leave.
SAMPLES_PER_PASS = 1 << 22


def render_passes(
    scene: Any,
    spp: int,
    *,
    seed: int = 0,
    sensor: int = 0,
    integrator: Any = None,
    progress: Callable[[int], None] = lambda samples: None,
) -> NDArray[np.float32]:
    """Render a loaded scene in passes of equal size and average them: (height, width, channels).

    Equal seeds give equal pictures. Passes draw from streams of their own, also those of neighbouring seeds.

    Args:
        scene: what `mi.load_dict` or `mi.load_file` returned.
        spp: samples per pixel in total; the last pass may be smaller than the others.
        integrator: another one than the scene's.
        progress: called after each pass with its samples per pixel.

    Raises:
        ParamError: spp below 1, or more pixels than `MOST_PIXELS`.
        SceneError: there is no integrator, or Mitsuba fails; the message says why.
    """
    import mitsuba as mi

    if spp < 1:
        raise ParamError(f"{spp} samples per pixel; take at least 1")
    if integrator is None and scene.integrator() is None:
        raise SceneError('the scene has no integrator; add one, <integrator type="path"/> for example')
    width, height = map(int, scene.sensors()[sensor].film().crop_size())
    check_size((width, height))
    passes = pass_sizes(spp, width * height)
    total = np.zeros(())
    for number, samples in enumerate(passes):
        options: Any = {"sensor": sensor, "integrator": integrator, "seed": _pass_seed(seed, number)}
        try:
            image = mi.render(scene, spp=samples, **options)
        except RuntimeError as error:
            raise SceneError(f"Mitsuba cannot render the scene: {one_line(str(error))}") from error
        total = total + samples * np.array(image, dtype=np.float64)
        progress(samples)
    return (total / spp).astype(np.float32)


def check_size(size: tuple[int, int]) -> None:
    """Refuses pictures that are too large, before they take memory. Raises `ParamError`."""
    if size[0] * size[1] > MOST_PIXELS:
        raise ParamError(
            f"a picture of {size[0]} x {size[1]} pixels is too large; at most {MOST_PIXELS:,} are rendered, "
            "16384 x 8192 for example"
        )


def pass_sizes(spp: int, pixels: int) -> list[int]:
    """Samples per pixel of each pass: equal but for the last, and such that they fill grids where that can be."""
    most = max(SAMPLES_PER_PASS // pixels, 1)
    equal = -(-spp // -(-spp // most))
    filling = (n for n in range(equal, equal // 2, -1) if _fills_grid(n) and _fills_grid(spp % n))
    each = next(filling, equal)
    return [each] * (spp // each) + ([spp % each] if spp % each else [])


def sampler(spp: int, pixels: int) -> str:
    """Mitsuba's sampler that leaves the least noise: multi-jittered where all passes fill a grid, as it demands."""
    return "multijitter" if all(map(_fills_grid, pass_sizes(spp, pixels))) else "independent"


def _fills_grid(samples: int) -> bool:
    """Whether Mitsuba's multi-jittered sampler takes this number as it is; it rounds others up."""
    return samples % max(math.isqrt(samples), 1) == 0


def _pass_seed(seed: int, number: int) -> int:
    """Hashed, as seed + number would repeat passes of the next seed."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
