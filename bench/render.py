"""Time, variance and error of `principled`, `layered` and `nma` in the preview scene, with and without textures.

    python -m bench.render [--size 256] [--spp 64] [--runs 12] [--reference-spp 1024] [--sampler multijitter]
        [--quick] [--output out/bench]

Every run renders one frame with each BSDF, so that other load on the machine slows all BSDFs alike. The columns are:

time        median wall time of a frame, without compilation; cpu: the same in processor seconds
ratio       a frame's time relative to `principled` in the same round, median over rounds
compile     extra time of the first frame over the second, with an empty cache of kernels and no other BSDF
variance    variance of one frame over independent seeds, averaged over pixels and channels
efficiency  1 / (variance x time)
gain        efficiency relative to `layered`, with its standard error from leaving out one frame at a time (jackknife)
bias        root mean square difference between the expected picture and the expected picture of `layered`
smape       SMAPE between the mean of the frames and the reference; in the row of `layered`, this error is noise only

The bias is estimated from products of independent renderings. If the squared bias is at most twice its standard error,
the table shows an upper limit of the bias, marked with <.

Frames have the sampler that `nma render` would choose, which is multi-jittered for most sample counts. The multi-
jittered sampler spreads samples evenly over the choice of lights and lobes. An adapter makes few such choices, so that
its variance falls more than that of `layered`, whose random walks make many. `--sampler independent` shows the
variance without this effect.

The machine's load average is printed before and after the table. `principled` shows another material, so only its time
and its variance can be compared with the other BSDFs.

Writes render.json and render.png. The plot shows the expected error against the rendering time; the expected error is
computed from variance and bias.
"""

from __future__ import annotations

import argparse
import gc
import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import bench.emptycache  # noqa: F401
from bench import frames, scenes
from bench.frames import Array, Frames
from figures import common
from nma import materials
from nma.adapter import shipped
from nma.images.metrics import errors
from nma.render.load import load_dict
from nma.render.progressive import render_passes
from nma.render.progressive import sampler as best_sampler
from nma.render.scene import material_coverage

ADAPTERS = ("layered3-3x32", "layered3-5x64")
COLUMNS = "  ".join(
    (
        f"{'scene':9} {'bsdf':19} {'time s':>7} {'ratio':>6} {'cpu s':>6} {'ratio':>6} {'compile s':>9}",
        f"{'variance':>9} {'efficiency':>10} {'gain':>12} {'bias':>8} {'smape':>7}",
    )
)


def main() -> None:
    arguments = parse()
    head = frames.begin(arguments.variant)
    size = (arguments.size, arguments.size)
    coverage = material_coverage(size)
    print(
        f"frames   {arguments.size} x {arguments.size}, {arguments.spp} spp, path depth {scenes.DEPTH}, material on "
        f"{coverage:.0%} of the pixels, {arguments.variant}, {arguments.sampler} sampler; "
        f"{arguments.runs} runs, reference {arguments.reference_spp} spp\n\n{COLUMNS}"
    )
    rows = []
    for scene, bsdfs in subjects(arguments.adapter).items():
        described = {
            name: sampled(scenes.preview(bsdf, size, arguments.rr_depth), arguments)
            for name, bsdf in bsdfs.items()
        }
        compilation = {name: compile_seconds(one, arguments.spp) for name, one in described.items()}
        measured = frames.in_turns(described, arguments.spp, range(arguments.runs))
        halves = converged_halves(described["layered"], arguments.reference_spp)
        for name in bsdfs:
            rows.append(row(scene, name, measured, halves) | {"compile": compilation[name]})
            print(line(rows[-1]), flush=True)
    print("\nload     {:.2f} {:.2f} {:.2f} at the end".format(*os.getloadavg()))
    frames.write(arguments.output / "render.json", head, arguments, coverage=coverage, rows=rows)
    plot(rows, arguments.output / "render.png")


def parse() -> argparse.Namespace:
    parser = frames.parser(__doc__, size=256, spp=64, runs=12)
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--adapter", nargs="*", default=ADAPTERS, help="shipped names or weights files")
    parser.add_argument(
        "--sampler", choices=("independent", "multijitter"), help="default: that of `nma render`"
    )
    parser.add_argument("--variant", default=frames.VECTORISED)
    arguments = frames.parse(parser, size=32, spp=8, runs=2, reference_spp=32, adapter=ADAPTERS[-1:])
    arguments.sampler = arguments.sampler or best_sampler(arguments.spp, arguments.size**2)
    return arguments


def subjects(adapters: list[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """Returns the BSDFs to compare, by scene and name. `layered` and `nma` show the same material."""
    for name in adapters:
        if name not in shipped() and not Path(name).is_file():
            raise SystemExit(f"no adapter {name}: give a weights file or one of {', '.join(shipped())}")
    gold = scenes.Subject(materials.load("gold-red-lacquer"))
    worn = scenes.worn_silver()._replace(repeats=2.0)
    red = {"type": "rgb", "value": [0.8, 0.2, 0.1]}
    return {
        "plain": {
            "principled": scenes.stand_in(gold) | {"metallic": 0.5, "roughness": 0.35, "base_color": red},
            "layered": scenes.simulation(gold),
            "nma": scenes.adapter(gold, adapters[0]),
        },
        "textured": {
            "principled": scenes.stand_in(worn),
            "layered": scenes.simulation(worn),
            **{f"nma {Path(name).stem}": scenes.adapter(worn, name) for name in adapters},
        },
    }


def sampled(scene: dict[str, Any], arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns the scene with the sampler and the samples per pixel of the command line."""
    sensor = scene["sensor"] | {"sampler": {"type": arguments.sampler, "sample_count": arguments.spp}}
    return scene | {"sensor": sensor}


def compile_seconds(description: dict[str, Any], spp: int) -> float:
    """Returns the seconds of compilation: how much longer the first frame takes than the second.

    Mitsuba also compiles the BSDFs of other scenes if they are still in memory, so these BSDFs are deleted first.
    """
    gc.collect()
    scene = load_dict(description)
    first, second = (frames.timed(scene, spp, seed)[1] for seed in range(2))
    return max(first - second, 0.0)


def converged_halves(description: dict[str, Any], spp: int) -> list[Array]:
    """Renders two independent pictures (height, width, 3), each with `spp` / 2 samples per pixel."""
    scene = load_dict(description)
    return [render_passes(scene, spp // 2, seed=seed).astype(np.float64) for seed in (12345, 54321)]


def row(scene: str, name: str, measured: dict[str, Frames], halves: list[Array]) -> dict[str, Any]:
    """Returns one row of the table: the results of one BSDF in one scene.

    Args:
        scene: the scene's name.
        name: the BSDF's name.
        measured: the frames of all BSDFs in this scene, by name.
        halves: two independent converged pictures of `layered`.
    """
    own, principled = measured[name], measured["principled"]
    variance, wall = own.variance, own.seconds
    figures: dict[str, Any] = {
        "scene": scene,
        "bsdf": name,
        "seconds": wall,
        "seconds_ratio": float(np.median(own.wall / principled.wall)),
        "cpu": float(np.median(own.cpu)),
        "cpu_ratio": float(np.median(own.cpu / principled.cpu)),
        "variance": variance,
        "efficiency": 1.0 / (variance * wall),
        "gain": frames.gain(own, measured["layered"]),
        "all_seconds": own.wall.tolist(),
        "all_cpu": own.cpu.tolist(),
    }
    if name != "principled":
        square, error = squared_bias(own.pictures, halves)
        figures |= {"squared_bias": square, "squared_bias_error": error}
        figures["smape"] = errors(own.pictures.mean(axis=0), (halves[0] + halves[1]) / 2.0)["smape"]
    return figures


def squared_bias(pictures: Array, halves: list[Array]) -> tuple[float, float]:
    """Estimates the squared bias, averaged over pixels and channels, and the standard error of the estimate.

    The estimate is the mean of (a - halves[0]) (b - halves[1]) over all pairs (a, b) of different frames. The two
    factors share no samples, so the expected value of each product contains no noise.
    """
    a, b = pictures - halves[0], pictures - halves[1]
    pairs = len(pictures) * (len(pictures) - 1)
    pixels = ((a.sum(axis=0) * b.sum(axis=0) - (a * b).sum(axis=0)) / pairs).mean(axis=-1)
    return float(pixels.mean()), float(pixels.std() / np.sqrt(pixels.size))


def bias(row: dict[str, Any]) -> float | None:
    """Returns the root of the squared bias, or None if the squared bias is at most twice its standard error."""
    square, error = row["squared_bias"], row["squared_bias_error"]
    return float(np.sqrt(square)) if square > 2.0 * error else None


def line(row: dict[str, Any]) -> str:
    """Formats a row of the results as a line of the printed table."""
    gain, error = row["gain"]
    shown = f"{gain:.2f}" if error is None else f"{gain:.2f} ± {error:.2f}"
    text = (
        f"{row['scene']:9} {row['bsdf']:19} {row['seconds']:7.2f} {row['seconds_ratio']:6.2f} {row['cpu']:6.2f} "
        f"{row['cpu_ratio']:6.2f} {row['compile']:9.2f}  {row['variance']:9.2e} {row['efficiency']:10.3g} {shown:>12}"
    )
    if "squared_bias" not in row:
        return text + f" {'-':>8} {'-':>7}"
    limit = np.sqrt(max(row["squared_bias"], 0.0) + 2.0 * row["squared_bias_error"])
    found = bias(row)
    return text + f" {f'<{limit:.4f}' if found is None else f'{found:.4f}':>8} {row['smape']:7.4f}"


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Plots the expected root mean square error against rendering time, with one panel for each scene."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(5.0 * len(names), 3.8), layout="constrained")
    panels = figure.subplots(1, len(names), sharey=True)
    for panel, scene in zip(panels, names, strict=True):
        for row in rows:
            if row["scene"] != scene or "squared_bias" not in row:
                continue
            seconds = row["seconds"] * np.geomspace(0.1, 1000.0, 100)
            error = np.sqrt((bias(row) or 0.0) ** 2 + row["variance"] * row["seconds"] / seconds)
            known = row["bsdf"] == "layered" or bias(row) is not None
            label = row["bsdf"] + ("" if known else " (bias not seen)")
            panel.loglog(seconds, error, label=label)
        panel.set(title=f"{scene} material", xlabel="rendering time [s]")
        panel.grid(alpha=0.3)
        panel.legend()
    panels[0].set_ylabel("expected RMS error of the picture")
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
