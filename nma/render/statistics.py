"""Statistics of renderings: time and noise over independent seeds, and a test whether two renderings have equal
means."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nma.errors import ParamError
from nma.images.io import ImageError

Array = NDArray[np.float64]


class Measurement(NamedTuple):
    """The result of several runs of one rendering, each with its own seed.

    `mean`: (height, width, 3) float64. `variance`: an array of the same shape, the unbiased estimate of the variance of
    ONE run of `spp` samples, not of the mean. `runs`: number of seeds. `spp`: samples per pixel of a run. `seconds`:
    median wall time of a run. `compile_seconds`: how much longer the warm-up took than a run; 0 without warm-up.
    `times`: seconds of each run.
    """

    mean: Array
    variance: Array
    runs: int
    spp: int
    seconds: float
    compile_seconds: float
    times: tuple[float, ...]

    @property
    def mean_variance(self) -> float:
        """The variance of one run, averaged over pixels and channels."""
        return float(self.variance.mean())

    @property
    def efficiency(self) -> float:
        """Monte Carlo efficiency: 1 / (variance * seconds)."""
        return 1.0 / max(self.mean_variance * self.seconds, 1e-300)


class Agreement(NamedTuple):
    """The result of `zscore_images`.

    `p_values`: the two-sided p-value of each block of pixels, (rows, columns, channels). `level`: the significance
    level of each single test, after Sidak's correction. `passed`: whether no p-value is below `level`. `worst`: the
    index (row, column, channel) of the smallest p-value.
    """

    p_values: Array
    level: float
    passed: bool
    worst: tuple[int, int, int]


def measure(
    scene: Any,
    spp: int,
    seeds: int | Iterable[int] = 5,
    *,
    warmup: bool = True,
    progress: Callable[[], None] = lambda: None,
    **render_options: Any,
) -> Measurement:
    """Render a loaded scene once for each seed. The time of a run ends when all its kernels have finished.

    Args:
        scene: what `mi.load_dict` returned.
        spp: samples per pixel of each run.
        seeds: a number n of seeds, which are then 0 to n - 1, or the seeds themselves; at least 2, all different.
        warmup: whether to render once first, with another seed, so that no measured run includes compilation.
        progress: called after each run, also after the warm-up.
        render_options: passed to `mi.render`, such as `sensor` or `integrator`.

    Raises:
        ParamError: there are fewer than two seeds, or two seeds are equal.
    """
    numbers = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    if len(numbers) < 2 or len(set(numbers)) < len(numbers):
        raise ParamError(
            f"measure: pass at least two seeds, all different, or the number of seeds; got {numbers}"
        )
    first = 0.0
    if warmup:
        first = render_seconds(scene, spp, max(numbers) + 1, **render_options)[1]
        progress()

    # Welford's update needs memory for only one mean and one sum of squares, whatever the number of runs.
    times, mean, squares = [], np.zeros(()), np.zeros(())
    for count, seed in enumerate(numbers, start=1):
        image, seconds = render_seconds(scene, spp, seed, **render_options)
        delta = image - mean
        mean = mean + delta / count
        squares = squares + delta * (image - mean)
        times.append(seconds)
        progress()
    median = float(np.median(times))
    extra = max(first - median, 0.0)
    return Measurement(mean, squares / (len(numbers) - 1), len(numbers), spp, median, extra, tuple(times))


def render_seconds(scene: Any, spp: int, seed: int, **render_options: Any) -> tuple[Array, float]:
    """Renders a scene once. Returns the picture (height, width, channels) as float64, and the wall time in seconds
    until all kernels have finished."""
    import drjit as dr
    import mitsuba as mi

    dr.sync_thread()
    start = time.perf_counter()
    image = mi.render(scene, spp=spp, seed=seed, **render_options)  # type: ignore[arg-type]
    dr.eval(image)
    dr.sync_thread()
    seconds = time.perf_counter() - start
    return np.array(image, dtype=np.float64), seconds


def zscore_images(
    mean_a: ArrayLike,
    variance_a: ArrayLike,
    runs_a: int,
    mean_b: ArrayLike,
    variance_b: ArrayLike,
    runs_b: int,
    *,
    false_alarm: float = 0.01,
    block: int = 1,
    rounding: float = 1e-5,
) -> Agreement:
    """Test whether two renderings have the same expectation everywhere, pixel by pixel and channel by channel.

    The test is Welch's t-test, a Z-test with estimated variances (Jung, Hanika and Dachsbacher 2020). The degrees of
    freedom come from the equation of Welch and Satterthwaite; with many runs the t-distribution approaches the normal
    distribution. Each single test has Sidak's significance level, 1 - (1 - false_alarm)^(1/tests), so that equal images
    fail at least one of the tests with a probability of about `false_alarm`. Where few paths reach the light, runs of
    few samples are far from normally distributed, and equal images fail too often. For scenes in which few paths reach
    the light, use few long runs instead of many short runs.

    This function needs scipy, which comes with the extras `compare` and `train`.

    Args:
        mean_a, variance_a, runs_a: the mean of all runs and the variance of one run, both (height, width, channels),
            and the number of runs.
        mean_b, variance_b, runs_b: the same for the other rendering. For an image without noise, pass variance 0 and
            one run.
        false_alarm: probability that equal renderings are rejected.
        block: side of the squares of pixels that are averaged before the test, so that a small difference in all pixels
            exceeds the noise. Pixels must be independent, as they are with the box filter. Rows and columns at the
            edges that do not fill a square are left out.
        rounding: the relative difference that single precision may cause, which is added to the standard error.

    Raises:
        ImageError: the shapes differ, values are not finite, or a block is larger than the image.
    """
    from scipy.stats import t as student

    arrays = [np.asarray(array, dtype=np.float64) for array in (mean_a, variance_a, mean_b, variance_b)]
    if len({array.shape for array in arrays}) > 1 or arrays[0].ndim != 3:
        raise ImageError(
            f"zscore_images: shapes {[a.shape for a in arrays]} must all be the same (height, width, channels)"
        )
    if not all(np.isfinite(array).all() for array in arrays):
        raise ImageError(
            "zscore_images: means or variances have NaN or infinite pixels; correct these pixels first"
        )
    a, var_a, b, var_b = (_blocks(array, block) for array in arrays)

    # The squared standard errors of the differences between block means, and the degrees of freedom of these errors
    # (Welch and Satterthwaite).
    pixels = block**2
    error = var_a / (runs_a * pixels) + var_b / (runs_b * pixels)
    spread = sum(
        _blocks(variance**2, block) / (runs**2 * pixels**3 * max(runs - 1, 1))
        for variance, runs in ((arrays[1], runs_a), (arrays[3], runs_b))
    )
    freedom = np.where(spread > 0.0, error**2 / np.maximum(spread, 1e-300), 1e9)
    error = error + (rounding * np.maximum(np.abs(a), np.abs(b))) ** 2 + 1e-24
    p_values = 2.0 * student.sf(np.abs(a - b) / np.sqrt(error), freedom)
    level = -np.expm1(np.log1p(-false_alarm) / p_values.size)
    worst = np.unravel_index(int(np.argmin(p_values)), p_values.shape)
    row, column, channel = (int(index) for index in worst)
    return Agreement(p_values, float(level), bool((p_values >= level).all()), (row, column, channel))


def _blocks(image: Array, block: int) -> Array:
    """Means over squares of block x block pixels: (rows, columns, channels)."""
    height, width = (extent // block for extent in image.shape[:2])
    if height == 0 or width == 0:
        raise ImageError(
            f"zscore_images: block {block} is larger than the image, {image.shape[1]} x {image.shape[0]}"
        )
    cut = image[: height * block, : width * block]
    return cut.reshape(height, block, width, block, -1).mean(axis=(1, 3))
