"""Table 4 of the paper: simulation and adapters in `scalar_rgb`, on unseen materials, at equal samples per pixel.

python -m bench.scalar [--scene sphere|environment|preview|lights] [--materials 92] [--size 96] [--spp 32] [--runs 3]
    [--error 8] [--reference-spp 2048] [--rr-depth 5] [--quick] [--output out/bench]

For each material, every run renders one frame with each BSDF, so that other load on the machine slows all BSDFs alike.
The time of a BSDF is the median over its frames, rendered on all cores. bench/frames.py defines variance, error and
efficiency. The error is measured for the first --error materials only. All results are divided by the results of
`layered`; the table shows geometric means over the materials. A time below 1 is faster than the simulation, and an
efficiency above 1 is better. An adapter marked `online` runs the network at every shading point, an adapter marked
`curves` runs the network only when the scene is loaded. `principled` and `diffuse` show other materials. `principled`
measures the time of a production BSDF, and `diffuse` measures the time of everything except the material.

Writes scalar.json and scalar.png for the default scene, and scalar-SCENE.json and scalar-SCENE.png for another scene.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import nma
from bench import frames, scenes
from figures import common

SCENE = "sphere"
# Mean time and efficiency of the adapter in the paper's Table 4.
PAPER_TIME, PAPER_EFFICIENCY = 0.58, 1.67
OTHER_MATERIALS = (scenes.STAND_IN, scenes.NOTHING)
Figures = dict[str, dict[str, float | None]]


def main() -> None:
    arguments = parse()
    head = frames.begin(frames.SCALAR)
    subjects, rows = scenes.unseen(arguments.materials), []
    with frames.bar("rendering", "materials", len(subjects)) as advance:
        for number, subject in enumerate(subjects):
            rows.append(compare(subject, number, arguments))
            advance()
    means = frames.mean_ratios(rows, scenes.SIMULATION)
    columns = list(means[scenes.SIMULATION])
    print(
        frames.markdown(
            [f"{arguments.scene}, to layered", *columns],
            [[name, *(row[c] for c in columns)] for name, row in means.items()],
        )
    )
    path = arguments.output / ("scalar" if arguments.scene == SCENE else f"scalar-{arguments.scene}")
    frames.write(path.with_suffix(".json"), head, arguments, summary=means, materials=rows)
    plot(rows, arguments.scene, path.with_suffix(".png"))


def parse() -> argparse.Namespace:
    parser = frames.parser(__doc__, size=96, spp=32, runs=3)
    parser.add_argument("--scene", choices=scenes.SCENES, default=SCENE)
    parser.add_argument(
        "--materials", type=int, default=92, help="how many materials to draw from the paper's ranges"
    )
    parser.add_argument(
        "--error", type=int, default=8, help="how many materials also have their error measured"
    )
    parser.add_argument(
        "--reference-spp", type=int, default=2048, help="samples per pixel of the converged pictures"
    )
    return frames.parse(parser, materials=2, size=32, spp=8, runs=2, error=1, reference_spp=64)


def bsdfs(subject: scenes.Subject) -> dict[str, dict[str, Any]]:
    """Returns the BSDFs to compare, by name."""
    found = {scenes.SIMULATION: scenes.simulation(subject)}
    for name in nma.shipped():
        found[f"{scenes.short(name)} online"] = scenes.network(subject, name)
        found[f"{scenes.short(name)} curves"] = scenes.adapter(subject, name)
    found["5x64 online, bfloat16"] = scenes.network(subject, "layered3-5x64", "bfloat16")
    return found | {scenes.STAND_IN: scenes.stand_in(subject), scenes.NOTHING: scenes.DIFFUSE}


def compare(subject: scenes.Subject, number: int, arguments: argparse.Namespace) -> Figures:
    """Returns seconds and variance of every BSDF, and for the first --error materials the squared error as well."""
    size, scene = (arguments.size, arguments.size), scenes.SCENES[arguments.scene]
    described = {name: scene(bsdf, size, arguments.rr_depth) for name, bsdf in bsdfs(subject).items()}
    # Each material is rendered with its own seeds, because equal seeds would give all materials similar noise.
    seeds = range(number * arguments.runs, (number + 1) * arguments.runs)
    measured = frames.in_turns(described, arguments.spp, seeds)
    reference = None
    if number < arguments.error:
        reference = frames.converged(described[scenes.SIMULATION], arguments.reference_spp)
    return {
        name: frames.figures(of_one, None if name in OTHER_MATERIALS else reference)
        for name, of_one in measured.items()
    }


def plot(rows: list[Figures], scene: str, path: Path) -> None:
    """Plots the sorted times and efficiencies of all materials, with the paper's means as lines."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name in rows[0]:
        if name == scenes.SIMULATION:
            continue
        each = [frames.ratios(row[name], row[scenes.SIMULATION]) for row in rows]
        style = {"color": "0.5", "linestyle": "--" if name == scenes.STAND_IN else ":"}
        style = style if name in OTHER_MATERIALS else {}
        left.plot(sorted(row["time"] for row in each), label=name, **style)
        if name not in OTHER_MATERIALS:
            right.semilogy(sorted(row["efficiency by variance"] for row in each))
    left.axhline(PAPER_TIME, color="k", linewidth=0.8, linestyle=":", label="paper's mean")
    right.axhline(PAPER_EFFICIENCY, color="k", linewidth=0.8, linestyle=":")
    left.set(xlabel="materials, sorted", ylabel="time of layered's", ylim=(0, None), title=scene)
    right.set(xlabel="materials, sorted", ylabel="efficiency over layered, by variance")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    left.legend(fontsize="small")
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
