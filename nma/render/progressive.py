"""Renders in passes, so that a long rendering can report its progress."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.errors import ParamError, one_line
from nma.images.size import MOST_PIXELS
from nma.render.load import SceneError

# The number of samples of one pass over the whole picture: 16 samples per pixel for 512 x 512 pixels. A pass takes a
# few seconds on two cores. Fewer samples per pass need less memory, but leave more noise, because the sampler
# stratifies only within a pass.
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
    """Render a loaded scene in passes and average the passes: (height, width, channels) float32.

    Equal seeds give equal pictures. Every pass of every seed has its own random stream.

    Args:
        scene: what `mi.load_dict` or `mi.load_file` returned.
        spp: samples per pixel in total. The last pass may have fewer samples than the others.
        integrator: an integrator to use in place of the scene's integrator.
        progress: called after each pass with the samples per pixel of that pass.

    Raises:
        ParamError: spp is below 1, or there are more pixels than `MOST_PIXELS`.
        SceneError: the scene has no integrator, or Mitsuba fails; the message says why.
    """
    import mitsuba as mi

    if spp < 1:
        raise ParamError(f"{spp} samples per pixel are too few; choose at least 1")
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
    """Raises `ParamError` for pictures of more than `MOST_PIXELS` pixels, before memory is allocated."""
    if size[0] * size[1] > MOST_PIXELS:
        raise ParamError(
            f"a picture of {size[0]} x {size[1]} pixels is too large; choose at most {MOST_PIXELS:,} pixels, "
            "16384 x 8192 for example"
        )


def pass_sizes(spp: int, pixels: int) -> list[int]:
    """The samples per pixel of each pass. All passes have the same number of samples, except that the last pass may
    have fewer.

    Where possible, these sample counts fill the grid of the multi-jittered sampler.
    """
    most = max(SAMPLES_PER_PASS // pixels, 1)
    equal = -(-spp // -(-spp // most))
    filling = (n for n in range(equal, equal // 2, -1) if _fills_grid(n) and _fills_grid(spp % n))
    each = next(filling, equal)
    return [each] * (spp // each) + ([spp % each] if spp % each else [])


def sampler(spp: int, pixels: int) -> str:
    """The Mitsuba sampler with the least noise: "multijitter" where all passes fill its grid, else "independent"."""
    return "multijitter" if all(map(_fills_grid, pass_sizes(spp, pixels))) else "independent"


def _fills_grid(samples: int) -> bool:
    """Whether Mitsuba's multi-jittered sampler draws exactly this number of samples. The sampler rounds other sample
    counts up."""
    return samples % max(math.isqrt(samples), 1) == 0


def _pass_seed(seed: int, number: int) -> int:
    """The seed of pass `number`. The seed is a hash of `seed` and `number`. With the sum `seed + number`, pass 1 of one
    seed would repeat pass 0 of the next seed."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
