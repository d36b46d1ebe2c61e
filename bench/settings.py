"""Simulation and adapters compared: time, variance, error and efficiency by renderer, scene and kind of material.

python -m bench.settings [--variant scalar_rgb llvm_ad_rgb] [--scene preview lights environment] [--materials 4]
    [--size 192] [--spp 64] [--runs 4] [--reference-spp 1024] [--rr-depth 5] [--quick] [--output out/bench]

Materials are untextured or textured. Untextured materials are drawn from the paper's ranges, and no adapter was trained
on these materials. For untextured materials, the adapters interpolate curves over the viewing angle. Textured materials
are those of bench/scenes.py; for textured materials, the adapters run the network at every shading point. All results
are divided by the results of `layered`; the table shows geometric means over the materials. bench/frames.py defines
variance, error and efficiency. The verdict names the BSDF with the higher efficiency by error, or "even" if the two
efficiencies differ by less than 10 %. `doubt` is the relative standard error of the efficiency by error, estimated over
the runs. `doubt` is large under sun and lamps, where a few bright pixels hold most of the noise. `principled` shows
another material, so its error is not computed.

Every run renders one frame with each BSDF. In a vectorised renderer, the measured time excludes the compilation of
kernels. But the measured time includes the tracing of the BSDF in Python, about 0.05 s per frame for the larger
network. In frames smaller than the default size, the adapters would look slower, because tracing would take a larger
part of the measured time.

Writes settings.json, settings.md (the table) and settings.png (efficiencies by error).
"""

from __future__ import annotations

import argparse
import itertools
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import nma
import nma.render
from bench import frames, scenes
from figures import common
from nma.files import write_text

KINDS = ("untextured", "textured")
SCENES = ("preview", "lights", "environment")


def main() -> None:
    arguments = parse()
    head = frames.begin()
    settings = list(itertools.product(arguments.variant, arguments.scene, KINDS))
    rows, measured, parts = [], [], unfinished(arguments)
    with frames.bar(
        "rendering", "materials", sum(len(list(subjects(s[2], arguments))) for s in settings)
    ) as advance:
        for variant, scene, kind in settings:
            nma.render.use(variant)
            of_setting = []
            for seed, subject in enumerate(subjects(kind, arguments)):
                part = parts / f"{variant}-{scene}-{kind}-{seed}.json"
                of_setting.append(common.kept(part, partial(compare, subject, scene, seed, arguments)))
                advance()
            place = {"renderer": variant, "scene": scene, "material": kind}
            rows += summary(place, of_setting)
            measured.append(place | {"materials": of_setting})
    columns = list(rows[0])
    text = frames.markdown(columns, [list(row.values()) for row in rows])
    print(text)
    frames.write(arguments.output / "settings.json", head, arguments, rows=rows, measured=measured)
    write_text(arguments.output / "settings.md", text + "\n")
    plot(rows, arguments.output / "settings.png")
    shutil.rmtree(parts)


def unfinished(arguments: argparse.Namespace) -> Path:
    """Returns the folder where a run with these settings keeps its measurements until the run is complete.

    A killed run continues from the kept measurements. The folder's name depends on the code of the scenes, so
    measurements are not reused after this code has changed.
    """
    kept = "-".join(
        str(getattr(arguments, name)) for name in ("size", "spp", "runs", "reference_spp", "rr_depth")
    )
    return frames.ROOT / "out/bench/settings" / f"{scenes.digest()}-{kept}"


def parse() -> argparse.Namespace:
    parser = frames.parser(__doc__, size=192, spp=64, runs=4)
    parser.add_argument("--variant", nargs="+", default=[frames.SCALAR, frames.VECTORISED])
    parser.add_argument("--scene", nargs="+", choices=scenes.SCENES, default=SCENES)
    parser.add_argument("--materials", type=int, default=4, help="how many untextured materials")
    parser.add_argument(
        "--textured", type=int, default=len(scenes.TEXTURED), help="how many textured materials"
    )
    parser.add_argument(
        "--reference-spp", type=int, default=1024, help="samples per pixel of the converged pictures"
    )
    return frames.parse(
        parser, size=32, spp=8, runs=2, materials=1, textured=1, reference_spp=64, scene=["preview"]
    )


def subjects(kind: str, arguments: argparse.Namespace) -> Iterator[scenes.Subject]:
    """Yields the materials of one kind: "untextured" or "textured"."""
    if kind == "untextured":
        yield from scenes.unseen(arguments.materials)
    else:
        yield from (make() for make in list(scenes.TEXTURED.values())[: arguments.textured])


def bsdfs(subject: scenes.Subject) -> dict[str, dict[str, Any]]:
    """Returns the BSDFs to compare, by name."""
    found = {scenes.SIMULATION: scenes.simulation(subject)}
    for name in reversed(nma.shipped()):
        make = scenes.network if subject.textures else scenes.adapter
        found[scenes.short(name)] = make(subject, name)
    return found | {scenes.STAND_IN: scenes.stand_in(subject)}


def compare(
    subject: scenes.Subject, scene: str, number: int, arguments: argparse.Namespace
) -> dict[str, dict[str, float | None]]:
    """Returns seconds, variance and squared error of every BSDF."""
    size, make = (arguments.size, arguments.size), scenes.SCENES[scene]
    described = {name: make(bsdf, size, arguments.rr_depth) for name, bsdf in bsdfs(subject).items()}
    seeds = range(number * arguments.runs + 1, (number + 1) * arguments.runs + 1)
    measured = frames.in_turns(described, arguments.spp, seeds)
    reference = frames.converged(described[scenes.SIMULATION], arguments.reference_spp)
    return {
        name: frames.figures(of_one, None if name == scenes.STAND_IN else reference)
        for name, of_one in measured.items()
    }


def summary(
    place: dict[str, str], measured: list[dict[str, dict[str, float | None]]]
) -> list[dict[str, Any]]:
    """Returns the table's rows for one renderer, scene and kind: one row for each BSDF except the simulation."""
    means = frames.mean_ratios(measured, scenes.SIMULATION)
    rows = []
    for name, figures in means.items():
        if name != scenes.SIMULATION:
            doubt = frames.mean_doubt(measured, name, scenes.SIMULATION)
            verdict = frames.verdict(figures["efficiency by error"])
            rows.append(place | {"BSDF": name} | figures | {"doubt": doubt, "verdict": verdict})
    return rows


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws the adapters' efficiencies by error as bars, with one panel for each renderer."""
    renderers = list(dict.fromkeys(row["renderer"] for row in rows))
    names = [name for name in dict.fromkeys(row["BSDF"] for row in rows) if name != scenes.STAND_IN]
    figure = Figure(figsize=(9.5, 0.6 + 3.0 * len(renderers)), layout="constrained")
    for axes, renderer in zip(np.atleast_1d(figure.subplots(len(renderers), 1)), renderers, strict=True):
        own = [row for row in rows if row["renderer"] == renderer]
        places = list(dict.fromkeys((row["scene"], row["material"]) for row in own))
        for n, name in enumerate(names):
            gains = [row["efficiency by error"] or np.nan for row in own if row["BSDF"] == name]
            width = 0.8 / len(names)
            middles = np.arange(len(places)) + (n - 0.5 * (len(names) - 1)) * width
            # Bars begin at 1, where adapter and simulation are equally efficient.
            bars = axes.bar(middles, np.array(gains) - 1.0, width, bottom=1.0, label=name)
            axes.bar_label(bars, [f"{gain:.2f}" for gain in gains], fontsize="small", padding=1)
        axes.axhline(1.0, color="k", linewidth=0.8)
        axes.set_yscale("log")
        axes.margins(y=0.15)
        axes.set_xticks(range(len(places)), ["\n".join(place) for place in places])
        axes.set(title=renderer, ylabel="efficiency over layered")
        axes.grid(axis="y", alpha=0.3)
    figure.axes[0].legend()
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
