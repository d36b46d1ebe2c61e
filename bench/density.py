"""Fig. 9 of the paper: rendering time of the simulation and of an adapter against the medium's extinction.

python -m bench.density [--variant scalar_rgb llvm_ad_rgb] [--scene environment] [--size 192] [--spp 64] [--runs 3]
    [--rr-depth 5] [--quick] [--output out/bench]

The material is silver under a nearly white medium and a coat. The medium absorbs little light, so Russian roulette ends
few random walks of the simulation. Most walks end when they leave the material, so the walks get longer, and the
rendering slower, with the extinction. The adapter was trained for extinctions up to sigma_t = 1, and clamps larger
extinctions to 1. With clamped extinctions the pictures are wrong, but this bench measures only times. The bench makes
--runs rounds. Each round renders one frame with every BSDF at every extinction, and the reported times are medians over
the rounds. The BSDF `nma curves` runs the network when the scene is loaded, the BSDF `nma online` runs the network at
every shading point. The flatness of a BSDF is its longest time over all extinctions, divided by its shortest time.

Writes density.json and density.png.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import nma
import nma.render
from bench import frames, scenes
from figures import common
from nma.adapter import DEFAULT_ADAPTER

SIGMAS = (0.0, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
MATERIAL = {"alpha_top": 0.1, "alpha_bottom": 0.2, "eta_top": 1.5, "albedo": [0.99, 0.98, 0.97]}
Seconds = dict[str, dict[float, float]]


def main() -> None:
    arguments = parse()
    head = frames.begin()
    seconds = {}
    for variant in arguments.variant:
        nma.render.use(variant)
        seconds[variant] = measure(variant, arguments)
    rows = [
        [variant, name, *times.values(), flatness(times)]
        for variant, by_bsdf in seconds.items()
        for name, times in by_bsdf.items()
    ]
    print(frames.markdown(["renderer", "seconds", *map(str, arguments.sigma), "flatness"], rows))
    frames.write(arguments.output / "density.json", head, arguments, seconds=seconds)
    plot(seconds, arguments, arguments.output / "density.png")


def parse() -> argparse.Namespace:
    parser = frames.parser(__doc__, size=192, spp=64, runs=3)
    parser.add_argument("--variant", nargs="+", default=[frames.SCALAR, frames.VECTORISED])
    parser.add_argument("--scene", choices=scenes.SCENES, default="environment")
    parser.add_argument("--sigma", type=float, nargs="+", default=SIGMAS, help="extinctions")
    return frames.parse(parser, size=32, spp=8, runs=2, sigma=(0.0, 10.0))


def bsdfs(sigma: float) -> dict[str, dict[str, Any]]:
    """Returns the BSDFs to compare, by name."""
    white = nma.load_material("frosted-silver").changed(MATERIAL | {"sigma_t": sigma})
    subject = scenes.Subject(white)
    curves = scenes.adapter(subject, DEFAULT_ADAPTER, clamp=True)
    return {
        scenes.SIMULATION: scenes.simulation(subject),
        "nma curves": curves,
        "nma online": scenes.online(curves),
        scenes.STAND_IN: scenes.stand_in(subject),
    }


def measure(variant: str, arguments: argparse.Namespace) -> Seconds:
    """Returns the median seconds per frame, by BSDF and extinction."""
    every: dict[str, dict[float, list[float]]] = {}
    size, make = (arguments.size, arguments.size), scenes.SCENES[arguments.scene]
    with frames.bar(variant, "extinctions", arguments.runs * len(arguments.sigma)) as advance:
        for run in range(arguments.runs):
            for sigma in arguments.sigma:
                described = {n: make(bsdf, size, arguments.rr_depth) for n, bsdf in bsdfs(sigma).items()}
                for name, measured in frames.in_turns(described, arguments.spp, [run]).items():
                    every.setdefault(name, {}).setdefault(sigma, []).append(measured.seconds)
                advance()
    return {
        name: {sigma: float(np.median(own)) for sigma, own in by_sigma.items()}
        for name, by_sigma in every.items()
    }


def flatness(times: dict[float, float]) -> float:
    """Returns the longest time divided by the shortest; 1 means that all times are equal."""
    return max(times.values()) / min(times.values())


def plot(seconds: dict[str, Seconds], arguments: argparse.Namespace, path: Path) -> None:
    """Plots frame time against extinction, with one panel for each renderer."""
    figure = Figure(figsize=(1.0 + 4.6 * len(seconds), 3.8), layout="constrained")
    for axes, (variant, by_bsdf) in zip(
        np.atleast_1d(figure.subplots(1, len(seconds))), seconds.items(), strict=True
    ):
        for name, times in by_bsdf.items():
            axes.plot(list(times), list(times.values()), marker=".", label=f"{name}, {flatness(times):.2f}")
        end = nma.LAYERED3["sigma_t"].high
        if max(arguments.sigma) > end:
            axes.axvspan(end, max(arguments.sigma), color="0.94", zorder=0, label="adapters clamp")
        axes.set_xscale("symlog", linthresh=1.0, linscale=1.0)
        axes.set_xticks(arguments.sigma, [f"{sigma:g}" for sigma in arguments.sigma])
        axes.set(title=variant, xlabel="extinction $\\sigma_t$")
        # The factor 1.6 leaves room for the legend above the curves.
        axes.set_ylim(0.0, 1.6 * max(max(times.values()) for times in by_bsdf.values()))
        axes.grid(alpha=0.3)
        axes.legend(title="largest to smallest", fontsize="small", loc="upper left")
    figure.axes[0].set_ylabel(f"seconds, {arguments.size} x {arguments.size}, {arguments.spp} spp")
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
