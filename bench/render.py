"""Time, variance and error of `principled`, `layered` and `nma` in the preview scene, without textures and with three.

    python bench/render.py [--size 256] [--spp 64] [--runs 5] [--reference-spp 1024] [--output out/bench]

Frames of all BSDFs take turns, so that other load on the machine meets all of them; `load` is its average at start
and end. `time` is the median wall time of a frame and `cpu` the median of its processor seconds, without
compilation. The ratios are medians over rounds of a frame's time to that of `principled` in the same round.
`compile` is what the first frame takes beyond the second, alone and with an empty cache of kernels. `variance` is
that of one frame, mean over pixels and channels, from independent seeds; `efficiency` 1 / (variance x time). `bias`
is the root mean square of (expected picture - that of `layered`), from products of independent renderings, or what
it lies below if it does not stand out of the noise. `smape` compares the mean of the frames with the reference,
noise of both included: the line of `layered` shows how much that is. `principled` is a stand- in for its time and
noise; it shows another material.

Writes render.json and render.png: the expected error after a time, from the variance and the bias.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
from pathlib import Path
from typing import Any, NamedTuple

import emptycache  # noqa: F401
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from machine import header
from numpy.typing import NDArray

import nma.render
from nma import materials
from nma.adapter import shipped
from nma.image_metrics import errors
from nma.render.load import load_dict, material_bsdf
from nma.render.measure import render_seconds
from nma.render.progressive import render_passes
from nma.render.scene import bitmap_texture, material_coverage, preview_scene
from nma.render.textures import procedural_textures

DEPTH = 6
ADAPTERS = ("layered3-5x64", "layered3-3x32")
COLUMNS = "  ".join(
    (
        f"{'scene':9} {'bsdf':19} {'time s':>7} {'ratio':>6} {'cpu s':>6} {'ratio':>6} {'compile s':>9}",
        f"{'variance':>9} {'efficiency':>10} {'bias':>8} {'smape':>7}",
    )
)
Array = NDArray[np.float64]


class Frames(NamedTuple):
    """Everything about one BSDF in one of the scenes: pictures (runs, height, width, 3) and seconds (runs,)."""

    pictures: Array
    wall: Array
    cpu: Array
    compile: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--adapter", nargs="*", default=ADAPTERS, help="shipped names or weights files")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--output", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    nma.render.use(options.variant)
    size = (options.size, options.size)
    coverage = material_coverage(size)
    print(header())
    print(
        f"frames   {options.size} x {options.size}, {options.spp} spp, path depth {DEPTH}, material on {coverage:.0%} "
        f"of the pixels, {options.variant}; {options.runs} runs, reference {options.reference_spp} spp\n\n{COLUMNS}"
    )
    rows = []
    for scene, bsdfs in scenes(options.adapter).items():
        compilation = {name: compile_seconds(bsdf, size, options.spp) for name, bsdf in bsdfs.items()}
        loaded = {
            name: load_dict(preview_scene(bsdf, size=size, max_depth=DEPTH)) for name, bsdf in bsdfs.items()
        }
        frames = measure_in_turns(loaded, options.spp, options.runs, compilation)
        halves = [
            render_passes(loaded["layered"], options.reference_spp // 2, seed=seed).astype(np.float64)
            for seed in (12345, 54321)
        ]
        for name in bsdfs:
            rows.append(row(scene, name, frames, halves))
            print(line(rows[-1]), flush=True)
    print("\nload     {:.2f} {:.2f} {:.2f} at the end".format(*os.getloadavg()))
    options.output.mkdir(parents=True, exist_ok=True)
    record = {
        "machine": header(),
        "settings": {k: v for k, v in vars(options).items() if k != "output"},
        "coverage": coverage,
        "rows": rows,
    }
    (options.output / "render.json").write_text(json.dumps(record, indent=1))
    plot(rows, options.output / "render.png")
    print(f"wrote    {options.output}/render.json, {options.output}/render.png")


def scenes(adapters: list[str]) -> dict[str, dict[str, dict[str, Any]]]:
    """For each scene, the BSDFs by name; `layered` and `nma` show the same material, `principled` costs the like."""
    for name in adapters:
        if name not in shipped() and not Path(name).is_file():
            raise SystemExit(f"there is no adapter {name}; shipped are {', '.join(shipped())}")
    gold = materials.load("gold-red-lacquer")
    worn = materials.load("frosted-silver").changed({"alpha_top": 0.02, "eta_top": 1.5})
    images = {name: bitmap_texture(t, scale=2.0) for name, t in procedural_textures(512).items()}
    red = {"type": "rgb", "value": [0.8, 0.2, 0.1]}
    plain: dict[str, Any] = {"type": "principled", "metallic": 0.5, "roughness": 0.35, "clearcoat": 0.5}
    names = {"base_color": "albedo", "roughness": "alpha_bottom", "metallic": "sigma_t"}
    textured = plain | {theirs: images[ours] for theirs, ours in names.items()}
    return {
        "plain": {
            "principled": plain | {"base_color": red},
            "layered": material_bsdf(gold, "layered"),
            "nma": material_bsdf(gold, adapter=adapters[0]),
        },
        "textured": {
            "principled": textured,
            "layered": material_bsdf(worn, "layered") | images,
            **{f"nma {Path(name).stem}": material_bsdf(worn, adapter=name) | images for name in adapters},
        },
    }


def measure_in_turns(
    loaded: dict[str, Any], spp: int, runs: int, compilation: dict[str, float]
) -> dict[str, Frames]:
    """One frame of each, again and again with other seeds, after one that compiles anew for all in memory."""
    for scene in loaded.values():
        render_seconds(scene, spp, runs)
    pictures: dict[str, list[Array]] = {name: [] for name in loaded}
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in loaded}
    for seed in range(runs):
        for name, scene in loaded.items():
            before = processor_seconds()
            picture, wall = render_seconds(scene, spp, seed)
            seconds[name].append((wall, processor_seconds() - before))
            pictures[name].append(picture)
    clocks = {name: np.array(s).T for name, s in seconds.items()}
    return {
        name: Frames(np.array(pictures[name]), wall, cpu, compilation[name])
        for name, (wall, cpu) in clocks.items()
    }


def compile_seconds(bsdf: dict[str, Any], size: tuple[int, int], spp: int) -> float:
    """What a first frame takes longer than a second one, without the other BSDFs: Mitsuba compiles all in memory."""
    gc.collect()
    scene = load_dict(preview_scene(bsdf, size=size, max_depth=DEPTH))
    first, second = (render_seconds(scene, spp, seed)[1] for seed in range(2))
    return max(first - second, 0.0)


def processor_seconds() -> float:
    """Of all threads of this process."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def row(scene: str, name: str, frames: dict[str, Frames], halves: list[Array]) -> dict[str, Any]:
    """The figures of one BSDF; `halves` are two independent converged pictures of `layered`."""
    own, principled = frames[name], frames["principled"]
    variance, wall = float(own.pictures.var(axis=0, ddof=1).mean()), float(np.median(own.wall))
    figures: dict[str, Any] = {
        "scene": scene,
        "bsdf": name,
        "seconds": wall,
        "seconds_ratio": float(np.median(own.wall / principled.wall)),
        "cpu": float(np.median(own.cpu)),
        "cpu_ratio": float(np.median(own.cpu / principled.cpu)),
        "compile": own.compile,
        "variance": variance,
        "efficiency": 1.0 / (variance * wall),
        "all_seconds": own.wall.tolist(),
        "all_cpu": own.cpu.tolist(),
    }
    if name != "principled":
        square, error = squared_bias(own.pictures, halves)
        figures |= {"squared_bias": square, "squared_bias_error": error}
        figures["smape"] = errors(own.pictures.mean(axis=0), (halves[0] + halves[1]) / 2.0)["smape"]
    return figures


def squared_bias(pictures: Array, halves: list[Array]) -> tuple[float, float]:
    """Mean over pixels and channels of (expectation - truth)^2, and its standard error.

    Products of differences that share no sample have no noise to subtract: all pairs of frames, each with its half.
    """
    a, b = pictures - halves[0], pictures - halves[1]
    pairs = len(pictures) * (len(pictures) - 1)
    pixels = ((a.sum(axis=0) * b.sum(axis=0) - (a * b).sum(axis=0)) / pairs).mean(axis=-1)
    return float(pixels.mean()), float(pixels.std() / np.sqrt(pixels.size))


def bias(row: dict[str, Any]) -> float | None:
    """The root mean square error that is no noise, or None if it does not stand out of it (two standard errors)."""
    square, error = row["squared_bias"], row["squared_bias_error"]
    return float(np.sqrt(square)) if square > 2.0 * error else None


def line(row: dict[str, Any]) -> str:
    """One line of the table."""
    text = (
        f"{row['scene']:9} {row['bsdf']:19} {row['seconds']:7.2f} {row['seconds_ratio']:6.2f} {row['cpu']:6.2f} "
        f"{row['cpu_ratio']:6.2f} {row['compile']:9.2f}  {row['variance']:9.2e} {row['efficiency']:10.3g}"
    )
    if "squared_bias" not in row:
        return text + f" {'-':>8} {'-':>7}"
    limit = np.sqrt(max(row["squared_bias"], 0.0) + 2.0 * row["squared_bias_error"])
    found = bias(row)
    return text + f" {f'<{limit:.4f}' if found is None else f'{found:.4f}':>8} {row['smape']:7.4f}"


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Root mean square error against rendering time, one panel for each scene."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    figure, panels = plt.subplots(
        1, len(names), figsize=(5.0 * len(names), 3.8), sharey=True, layout="constrained"
    )
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
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
