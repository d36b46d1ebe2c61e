"""Time per frame in a vectorised renderer against the size of the adapter's network in multiply-adds.

python -m bench.networks [--scene lights] [--networks 1x16 3x32 3x64 5x64] [--size 160] [--spp 48] [--runs 5]
    [--rr-depth 5] [--quick] [--output out/bench]

A vectorised renderer compiles a whole frame into one kernel, so a profiler cannot measure the time of the network
alone. This bench therefore renders a textured material with adapters that differ only in the size of their network; the
weights are random. The bench fits a straight line to the time per frame as a function of multiply-adds. The line's
value at 0 multiply-adds is the time of everything except the network. The simulation and Mitsuba's `principled` are
rendered for comparison. Every run renders one frame with each BSDF; the reported times are medians over the runs.

Writes networks.json and networks.png.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import nma
from bench import frames, scenes
from figures import common
from nma import network
from nma.adapter import DEFAULT_ADAPTER

SUBJECT = "worn silver"


def main() -> None:
    arguments = parse()
    head = frames.begin(frames.VECTORISED)
    subject = scenes.TEXTURED[SUBJECT]()
    with tempfile.TemporaryDirectory() as folder:
        bsdfs = {scenes.SIMULATION: scenes.simulation(subject), scenes.STAND_IN: scenes.stand_in(subject)}
        products = {}
        for name in arguments.networks:
            adapter = random_adapter(name)
            products[name] = multiply_adds(adapter)
            adapter.save(Path(folder) / f"{name}.safetensors")
            bsdfs[name] = scenes.network(subject, str(Path(folder) / f"{name}.safetensors"))
        size, make = (arguments.size, arguments.size), scenes.SCENES[arguments.scene]
        described = {name: make(bsdf, size, arguments.rr_depth) for name, bsdf in bsdfs.items()}
        measured = frames.in_turns(described, arguments.spp, range(1, arguments.runs + 1))
    seconds = {name: of_one.seconds for name, of_one in measured.items()}
    slope, rest = np.polyfit(list(products.values()), [seconds[name] for name in products], 1)
    rows = [[name, products.get(name), s, s / seconds[scenes.SIMULATION]] for name, s in seconds.items()]
    print(frames.markdown(["BSDF", "multiply-adds", "seconds", f"to {scenes.SIMULATION}"], rows))
    shipped = slope * multiply_adds(nma.Adapter.load(DEFAULT_ADAPTER))
    print(f"everything except the network: {rest:.2f} s; the network of {DEFAULT_ADAPTER}: {shipped:.2f} s")
    frames.write(
        arguments.output / "networks.json",
        head,
        arguments,
        seconds=seconds,
        products=products,
        line=[slope, rest],
    )
    plot(seconds, products, (slope, rest), arguments.output / "networks.png")


def parse() -> argparse.Namespace:
    parser = frames.parser(__doc__, size=160, spp=48, runs=5)
    parser.add_argument("--scene", choices=scenes.SCENES, default="lights")
    parser.add_argument("--networks", nargs="+", default=["1x16", "3x32", "3x64", "5x64"])
    return frames.parse(parser, size=32, spp=8, runs=2, networks=["1x16", "3x32"])


def random_adapter(name: str) -> nma.Adapter:
    """Returns the default adapter, but with a network of the size `name` (such as "3x32") and random weights."""
    trained = nma.Adapter.load(DEFAULT_ADAPTER)
    ends = trained.layers[0][0].shape[1], trained.layers[-1][0].shape[0]
    sizes = [ends[0], *network.hidden(name), ends[1]]
    layers = network.init(np.random.default_rng(0), sizes, trained.layers[-1][1])
    return replace(trained, layers=layers, training={})


def multiply_adds(adapter: nma.Adapter) -> int:
    """Returns the number of multiply-adds that the adapter's network needs for one query."""
    return sum(matrix.size for matrix, _ in adapter.layers)


def plot(seconds: dict[str, float], products: dict[str, int], line: tuple[float, float], path: Path) -> None:
    figure = Figure(figsize=(5.6, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.plot(list(products.values()), [seconds[name] for name in products], "o")
    for name, count in products.items():
        axes.annotate(name, (count, seconds[name]), textcoords="offset points", xytext=(6, -10))
    ends = np.array([0, max(products.values())])
    axes.plot(ends, line[0] * ends + line[1], "C0", linewidth=0.8)
    for name, style in ((scenes.SIMULATION, "k-"), (scenes.STAND_IN, "k:")):
        axes.plot(ends, [seconds[name]] * 2, style, linewidth=0.8, label=name)
    axes.set(xlabel="multiply-adds of the network", ylabel="seconds of a frame", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
