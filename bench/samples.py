"""Fig. 8 of the paper: squared error and variance of the teaser against samples per pixel and against seconds.

python -m bench.samples [--variant scalar_rgb] [--size 144] [--spp 1024] [--runs 3] [--reference-spp 8192]
    [--rr-depth 5] [--quick] [--output out/bench]

Frames are rendered with 1, 2, 4 ... --spp samples per pixel. For each number of samples per pixel, at least --runs
frames are rendered with each BSDF. The squared error is measured against a converged picture of `layered`, and the
noise of this picture is subtracted. With more samples, the simulation's error falls towards 0, but an adapter's error
falls only to its squared bias. The parts of the converged picture are kept in out/bench/references, so a killed run
continues where it stopped. bench/frames.py defines variance, error and efficiency.

Writes samples.json and samples.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

import nma
from bench import frames, scenes
from figures import common

# With fewer than CHEAP samples per pixel (spp), CHEAP / spp times as many frames are rendered.
CHEAP = 32
Curve = dict[int, dict[str, float | None]]


def main() -> None:
    arguments = parse()
    head = frames.begin(arguments.variant)
    described = describe(arguments)
    reference = frames.converged_teaser(described[scenes.SIMULATION], arguments)
    curves = measure(described, reference, arguments)
    print(table(curves))
    print(f"squared error of the converged picture, subtracted above: {reference.noise:.1e}")
    path = arguments.output / "samples.json"
    frames.write(path, head, arguments, reference_noise=reference.noise, curves=curves)
    plot(curves, arguments, path.with_suffix(".png"))


def parse() -> argparse.Namespace:
    parser = frames.parser(__doc__, size=144, spp=1024, runs=3)
    parser.add_argument("--variant", default=frames.SCALAR)
    parser.add_argument(
        "--reference-spp", type=int, default=8192, help="samples per pixel of the converged picture"
    )
    return frames.parse(parser, size=32, spp=4, runs=2, reference_spp=64)


def describe(arguments: argparse.Namespace) -> dict[str, dict]:
    """Returns the teaser scene with each BSDF, by the BSDF's name."""
    size = scenes.teaser_size(arguments.size)
    models: dict[str, Callable[[scenes.Subject], scenes.Bsdf]] = {scenes.SIMULATION: scenes.simulation}
    for name in reversed(nma.shipped()):
        models[scenes.short(name)] = partial(scenes.network, name=name)
    return {name: scenes.teaser(model, size, arguments.rr_depth) for name, model in models.items()}


def measure(
    described: dict[str, dict], reference: frames.Converged, arguments: argparse.Namespace
) -> dict[str, Curve]:
    """Returns seconds, variance and squared error, by BSDF and samples per pixel."""
    steps = levels(arguments.spp)
    curves: dict[str, Curve] = {name: {} for name in described}
    with frames.bar("frames", "levels", len(steps)) as advance:
        for number, spp in enumerate(steps):
            seeds = range(1000 * number, 1000 * number + repeats(spp, arguments.runs))
            for name, measured in frames.in_turns(described, spp, seeds).items():
                curves[name][spp] = frames.figures(measured, reference)
            advance()
    return curves


def repeats(spp: int, runs: int) -> int:
    """Returns how many frames to render: more with few samples per pixel, because such frames vary most."""
    return runs * max(1, CHEAP // spp)


def levels(spp: int) -> list[int]:
    """Returns the powers of two up to `spp`: 1, 2, 4 ..."""
    return [2**n for n in range(spp.bit_length())]


def table(curves: dict[str, Curve]) -> str:
    """Returns a table by samples per pixel: results of the simulation, and results of the adapters as ratios."""
    truth = curves[scenes.SIMULATION]
    headings, rows = ["spp", "seconds", "variance", "error"], []
    for name in curves:
        if name != scenes.SIMULATION:
            headings += [f"{name} time", "error", "efficiency by error"]
    for spp, own in truth.items():
        row = [spp, own["seconds"], own["variance"], own["error"]]
        for name, curve in curves.items():
            if name != scenes.SIMULATION:
                ratio = frames.ratios(curve[spp], own)
                row += [ratio["time"], ratio["error"], ratio["efficiency by error"]]
        rows.append(row)
    return frames.markdown(headings, rows)


def plot(curves: dict[str, Curve], arguments: argparse.Namespace, path: Path) -> None:
    """Plots the error against samples per pixel and against seconds, with the variance as dotted curves."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for number, (name, curve) in enumerate(curves.items()):
        seconds = [row["seconds"] for row in curve.values()]
        for axes, places in ((left, list(curve)), (right, seconds)):
            axes.loglog(places, column(curve, "error"), marker=".", color=f"C{number}", label=name)
            axes.loglog(places, column(curve, "variance"), linestyle=":", color=f"C{number}")
            axes.grid(alpha=0.3)
    left.set(xlabel="samples per pixel", ylabel="mean squared error; variance dotted")
    right.set(xlabel=f"seconds, {arguments.variant}")
    right.legend()
    common.save_figure(figure, path)


def column(curve: Curve, key: str) -> list[float | None]:
    return [row[key] for row in curve.values()]


if __name__ == "__main__":
    main()
