"""Functions for the benches that render whole frames: rendering with independent seeds, variance, error, efficiency.

The quality of a frame is measured by its variance and by its squared error. The variance is computed over frames with
independent seeds, and averaged over pixels and channels; it measures noise only. The squared error is the mean squared
difference between a frame and a converged picture, rendered with the simulation `layered`. The squared error of an
adapter contains noise and bias. The converged picture also has noise. The noise of the converged picture is estimated
from the picture's independent parts, and subtracted from the squared error. `layered` has no bias, so its expected
squared error equals its variance. The efficiency by variance is 1 / (variance x seconds), the efficiency by error is
1 / (squared error x seconds).
"""

from __future__ import annotations

import argparse
import gc
import math
import resource
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import nma.render
from bench.machine import header
from bench.scenes import RR_DEPTH, digest
from figures import common
from nma.cli.console import progress
from nma.render.load import load_dict
from nma.render.progressive import render_passes
from nma.render.statistics import render_seconds

ROOT = Path(__file__).parents[1]
Array = NDArray[np.float64]
Row = Mapping[str, Any]  # times, variances and errors by name; None is an unknown value
SCALAR, VECTORISED = "scalar_rgb", "llvm_ad_rgb"
OUTPUT = Path("out/bench")
REFERENCES = ROOT / "out/bench/references"
# Frames with more than MOST_SAMPLES samples are rendered in several passes, to limit memory use.
MOST_SAMPLES = 1 << 23
# A converged picture is the mean of independent parts; the variance of the parts gives the noise of the mean. PARTS is
# the number of parts for most scenes, TEASER_PARTS the number of parts for the scene of bench/teaser.py.
PARTS, TEASER_PARTS = 4, 16
# Converged pictures use seeds from REFERENCE_SEED upwards, frames use smaller seeds.
REFERENCE_SEED = 1_000_000
EVEN = 1.1  # the verdict is "even" if two efficiencies differ by less than the factor EVEN


class Frames(NamedTuple):
    """Frames of one scene: pictures (runs, height, width, 3), and wall and processor seconds of each frame (runs,)."""

    pictures: Array
    wall: Array
    cpu: Array

    @property
    def seconds(self) -> float:
        return float(np.median(self.wall))

    @property
    def variance(self) -> float:
        return float(self.pictures.var(axis=0, ddof=1).mean())


class Converged(NamedTuple):
    """A picture (height, width, 3) with many samples per pixel, and the mean square of its remaining noise."""

    picture: Array
    noise: float


def in_turns(scenes: Mapping[str, Mapping[str, Any]], spp: int, seeds: Iterable[int]) -> dict[str, Frames]:
    """Renders one frame of every scene for each seed, and returns the frames by the scene's name.

    All scenes are rendered with one seed before the next seed is used, so that other load on the machine slows all
    scenes alike.
    """
    turn = _turns(scenes, spp)
    found: dict[str, list[tuple[Array, float, float]]] = {name: [] for name in scenes}
    for seed in seeds:
        for name in scenes:
            found[name].append(turn(name, seed))
    return {name: Frames(*map(np.asarray, zip(*rows, strict=True))) for name, rows in found.items()}


def _turns(
    scenes: Mapping[str, Mapping[str, Any]], spp: int
) -> Callable[[str, int], tuple[Array, float, float]]:
    """Returns a function that takes a scene's name and a seed, renders a frame, and returns the result of `timed`."""
    import mitsuba as mi

    if mi.variant() == SCALAR:
        loaded = {name: load_dict(description) for name, description in scenes.items()}
        return lambda name, seed: timed(loaded[name], spp, seed)

    def alone(name: str, seed: int) -> tuple[Array, float, float]:
        # A vectorised renderer compiles all BSDFs that are in memory into one kernel, so only one scene may be loaded
        # at a time. The first frame is not measured, because its time includes compiling the kernel or loading the
        # kernel from Dr.Jit's cache.
        gc.collect()
        scene = load_dict(scenes[name])
        timed(scene, spp, seed)
        return timed(scene, spp, seed)

    return alone


def timed(scene: Any, spp: int, seed: int) -> tuple[Array, float, float]:
    """Renders a loaded scene. Returns the picture (height, width, 3), the wall seconds, and the processor seconds
    summed over all threads."""
    width, height = scene.sensors()[0].film().crop_size()
    before, began = processor_seconds(), time.perf_counter()
    if spp * int(width) * int(height) <= MOST_SAMPLES:
        picture, _ = render_seconds(scene, spp, seed)
    else:
        picture = render_passes(scene, spp, seed=seed).astype(np.float64)
    return picture, time.perf_counter() - began, processor_seconds() - before


def processor_seconds() -> float:
    """Returns the processor seconds that all threads of this process have used so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def converged(
    description: Mapping[str, Any],
    spp: int,
    keep: Path | None = None,
    parts: int = PARTS,
    advance: Callable[[], object] = lambda: None,
) -> Converged:
    """Renders a picture with `spp` samples per pixel as the mean of independent parts.

    Args:
        description: the scene, as a dictionary.
        keep: prefix of the paths of the files that store the parts. A part whose file exists is not rendered again.
        parts: number of parts.
        advance: a function that is called after each part.
    """
    pictures, scene = [], None
    for number in range(parts):
        path = keep and keep.with_name(f"{keep.name}_{spp // parts}-spp_{number}.npy")
        if path and path.exists():
            picture = np.load(path)
        else:
            scene = scene or load_dict(description)
            picture = render_passes(scene, spp // parts, seed=REFERENCE_SEED + number)
            if path:
                common.save_array(path, picture)
        pictures.append(picture.astype(np.float64))
        advance()
    return Converged(np.mean(pictures, axis=0), float(np.var(pictures, axis=0, ddof=1).mean()) / parts)


def converged_teaser(description: Mapping[str, Any], arguments: argparse.Namespace) -> Converged:
    """Returns the converged picture of the teaser scene, and stores the picture's parts in the folder REFERENCES."""
    settings = f"{arguments.size}px_rr-{arguments.rr_depth}_{arguments.variant}"
    keep = REFERENCES / f"teaser-{digest()}_{settings}"
    with bar("converged picture", "parts", TEASER_PARTS) as advance:
        return converged(description, arguments.reference_spp, keep, TEASER_PARTS, advance)


def squared_errors(pictures: Array, reference: Converged) -> Array:
    """Returns the squared error of each frame (runs,), averaged over pixels and channels."""
    return ((pictures - reference.picture) ** 2).mean(axis=(1, 2, 3)) - reference.noise


def figures(frames: Frames, reference: Converged | None = None) -> dict[str, float | None]:
    """Returns the median seconds and the variance of the frames, and their mean squared error if a reference is given.

    `doubt` is the standard error of the mean squared error, estimated over the frames, divided by the squared error.
    """
    found: dict[str, float | None] = {"seconds": frames.seconds, "variance": frames.variance}
    if reference is None:
        return found | {"error": None, "doubt": None}
    errors = squared_errors(frames.pictures, reference)
    doubt = errors.std(ddof=1) / math.sqrt(len(errors)) / abs(errors.mean())
    return found | {"error": float(errors.mean()), "doubt": float(doubt)}


def gain(own: Frames, simulation: Frames) -> tuple[float, float | None]:
    """Returns the efficiency by variance relative to the simulation, and its standard error if there are 3 frames.

    The standard error is that of the ratio of variances. It is estimated by the jackknife, from the spread of the
    ratio's logarithm when one frame is left out.
    """

    def log_ratio(kept: Array) -> float:
        simulated, adapted = (f.pictures[kept].var(axis=0, ddof=1).mean() for f in (simulation, own))
        return math.log(simulated / adapted)

    runs = len(own.wall)
    found = float(np.median(simulation.wall / own.wall)) * math.exp(log_ratio(np.full(runs, True)))
    if runs < 3:
        return found, None
    spread = math.sqrt((runs - 1) * np.var([log_ratio(np.arange(runs) != left) for left in range(runs)]))
    return found, found * spread


def ratios(own: Row, simulation: Row) -> dict[str, Any]:
    """Returns time, variance, error and efficiencies divided by those of the simulation; an unknown ratio is None."""
    time, variance, error = (ratio(own[key], simulation[key]) for key in ("seconds", "variance", "error"))
    return {
        "time": time,
        "variance": variance,
        "error": error,
        "efficiency by variance": ratio(1.0, time and variance and time * variance),
        "efficiency by error": ratio(1.0, time and error and time * error),
    }


def ratio(a: float | None, b: float | None) -> float | None:
    """Returns a / b, or None if a or b is None or not positive. Subtracting noise can make a squared error negative."""
    return a / b if a and b and a > 0.0 and b > 0.0 else None


def geometric_mean(values: Iterable[float | None]) -> float | None:
    """Returns the geometric mean of the values that are not None, or None if all values are None."""
    logs = [math.log(value) for value in values if value is not None]
    return math.exp(sum(logs) / len(logs)) if logs else None


def mean_ratios(rows: Sequence[Mapping[str, Row]], simulation: str) -> dict[str, dict[str, Any]]:
    """Returns the results of `ratios` for every BSDF, as geometric means over materials."""
    each = [{name: ratios(row[name], row[simulation]) for name in row} for row in rows]
    return {
        name: {key: geometric_mean(row[name][key] for row in each) for key in each[0][name]}
        for name in each[0]
    }


def mean_doubt(rows: Sequence[Mapping[str, Row]], name: str, simulation: str) -> float | None:
    """Returns the relative standard error of the geometric mean of the ratios of squared errors (`mean_ratios`).

    The result is None if a squared error or its standard error is unknown.
    """
    doubts = [row[bsdf]["doubt"] for row in rows for bsdf in (name, simulation)]
    return None if None in doubts else math.hypot(*doubts) / len(rows)


def verdict(efficiency: float | None) -> str:
    """Returns which BSDF is more efficient: "adapter", "simulation", "even" or "-" (unknown).

    Args:
        efficiency: the adapter's efficiency by error, relative to the simulation's.
    """
    if efficiency is None:
        return "-"
    if 1.0 / EVEN <= efficiency <= EVEN:
        return "even"
    return "adapter" if efficiency > 1.0 else "simulation"


def markdown(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Returns a Markdown table. Columns of text are aligned on the left, columns of numbers on the right."""
    cells = [list(headings), *([_cell(value) for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    text = [all(row[n] == "-" or not _is_number(row[n]) for row in cells[1:]) for n in range(len(headings))]
    lines = [
        "| "
        + " | ".join(c.ljust(w) if t else c.rjust(w) for c, w, t in zip(row, widths, text, strict=True))
        + " |"
        for row in cells
    ]
    rule = "|" + "|".join(
        "-" * (w + 2) if t else "-" * (w + 1) + ":" for w, t in zip(widths, text, strict=True)
    )
    return "\n".join([lines[0], rule + "|", *lines[1:]])


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.2e}" if 0.0 < abs(value) < 0.1 else f"{value:.3g}" if value >= 100.0 else f"{value:.2f}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def parser(doc: str | None, size: int, spp: int, runs: int) -> argparse.ArgumentParser:
    """Returns a parser with the options that all benches of frames share; `doc` is the script's docstring."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--size", type=int, default=size, help="height of the pictures, in pixels")
    made.add_argument("--spp", type=int, default=spp, help="samples per pixel of a frame")
    made.add_argument("--runs", type=int, default=runs, help="frames of each scene, each with its own seed")
    made.add_argument(
        "--rr-depth", type=int, default=RR_DEPTH, help="path depth at which Russian roulette begins"
    )
    made.add_argument("--quick", action="store_true", help="a small, short run, to see that the bench works")
    made.add_argument(
        "--output", type=Path, help=f"folder for the results (default {OUTPUT}; quick: {OUTPUT}/quick)"
    )
    return made


def parse(made: argparse.ArgumentParser, **quick: Any) -> argparse.Namespace:
    """Parses the command line. With --quick, the keyword arguments `quick` replace the options of the same name."""
    arguments = made.parse_args()
    if arguments.quick:
        vars(arguments).update(quick)
    if arguments.runs < 2:
        made.error("--runs: must be at least 2, to estimate a variance")
    arguments.output = arguments.output or (OUTPUT / "quick" if arguments.quick else OUTPUT)
    return arguments


def settings(arguments: argparse.Namespace) -> dict[str, Any]:
    return {key: value for key, value in vars(arguments).items() if key != "output"}


def write(path: Path, head: str, arguments: argparse.Namespace, **data: Any) -> None:
    """Writes a JSON file with the header `head` (bench/machine.py), the settings and the results `data`."""
    common.write_json(path, {"machine": head.splitlines(), "settings": settings(arguments)} | data)


def begin(variant: str | None = None) -> str:
    """Prints and returns the header of bench/machine.py, and sets Mitsuba's variant if `variant` is given."""
    head = header()
    print(head, flush=True)
    if variant:
        nma.render.use(variant)
    return head


@contextmanager
def bar(what: str, unit: str, total: int) -> Iterator[Callable[[], None]]:
    """Shows a progress bar of `total` steps, and yields the function to call after each step."""
    with progress(f"{unit}/min") as shown:
        task = shown.add_task(what, total=total, rate="", note="")

        def advance() -> None:
            shown.update(task, advance=1)
            speed = shown.tasks[task].speed
            shown.update(task, rate=f"{60 * speed:.1f}" if speed else "")

        yield advance
