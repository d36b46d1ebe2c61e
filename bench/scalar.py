"""Table 4 of the paper: unseen materials in Mitsuba's scalar renderer, simulation against adapters, at equal samples.

python bench/scalar.py [--materials 92] [--size 64] [--spp 32] [--runs 2] [--error 8] [--output out/bench]

Each material lies on the preview scene's ball. Renderers take turns within a material, so that other load on the
machine meets all of them; a frame's time is the median of its runs on all cores. `variance` is that of one frame, mean
over pixels and channels, from independent seeds; `error` the squared difference from a converged picture of `layered`
(--error of the materials at --reference-spp), which for adapters includes their bias. Efficiencies are 1 / (variance x
time) and 1 / (error x time). Figures are geometric means over the materials of ratios to `layered`; below 1 is faster
for times, above 1 better for efficiencies. `online` runs the network at every shading point, `curves` none.

Writes scalar.json and scalar.png.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from machine import header
from matplotlib.figure import Figure

import nma
import nma.render
from nma.cli.console import progress
from nma.materials import Material
from nma.render.load import load_dict, material_bsdf
from nma.render.progressive import render_passes
from nma.render.scene import preview_scene

SEED = 92
DEPTH = 6


def main() -> None:
    arguments = parse()
    print(header(), flush=True)
    nma.render.use("scalar_rgb")
    params = nma.LAYERED3.sample(np.random.default_rng(SEED), arguments.materials, "range")
    rows = []
    with progress("materials/min") as bar:
        task = bar.add_task("rendering", total=len(params), rate="", note="")
        for number, values in enumerate(params):
            subject = Material.of_vector(f"unseen-{number}", values, nma.LAYERED3)
            rows.append(compare(subject, arguments, number < arguments.error))
            speed = bar.tasks[task].speed
            bar.update(task, advance=1, rate=f"{60 * speed:.1f}" if speed else "")
    result = summary(rows)
    print(table(result))
    arguments.output.mkdir(parents=True, exist_ok=True)
    settings = {k: v for k, v in vars(arguments).items() if k != "output"}
    data = {"machine": header().splitlines(), "settings": settings, "summary": result, "materials": rows}
    (arguments.output / "scalar.json").write_text(json.dumps(data, indent=1) + "\n")
    plot(rows, arguments.output / "scalar.png")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--materials", type=int, default=92, help="drawn from the paper's ranges")
    parser.add_argument("--size", type=int, default=64, help="of the pictures, in pixels")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel of a frame")
    parser.add_argument("--runs", type=int, default=2, help="frames of each, with seeds of their own")
    parser.add_argument("--error", type=int, default=8, help="materials whose error is measured too")
    parser.add_argument("--reference-spp", type=int, default=2048, help="samples of the converged pictures")
    parser.add_argument("--output", type=Path, default=Path("out/bench"))
    return parser.parse_args()


def bsdfs(subject: Material) -> dict[str, dict[str, Any]]:
    """What is compared, by name."""
    found = {"layered": material_bsdf(subject, "layered")}
    for name in nma.shipped():
        short, made = name.split("-")[1], material_bsdf(subject, "nma", adapter=name)
        found[f"{short} online"] = made | {"online": True, "precision": "compact"}
        found[f"{short} curves"] = made
    found["5x64 online, bfloat16"] = found["5x64 online"] | {"precision": "bfloat16"}
    found["principled"] = {"type": "principled", "metallic": 0.7, "roughness": 0.3, "clearcoat": 0.5}
    return found


def compare(
    subject: Material, arguments: argparse.Namespace, with_error: bool
) -> dict[str, dict[str, float]]:
    """Seconds, variance and, if wanted, squared error of every BSDF."""
    scenes = {name: load_dict(scene(bsdf, arguments.size)) for name, bsdf in bsdfs(subject).items()}
    frames: dict[str, list] = {name: [] for name in scenes}
    seconds: dict[str, list[float]] = {name: [] for name in scenes}
    for run in range(arguments.runs):
        for name, loaded in scenes.items():
            began = time.perf_counter()
            frames[name].append(render_passes(loaded, arguments.spp, seed=run))
            seconds[name].append(time.perf_counter() - began)
    reference = render_passes(scenes["layered"], arguments.reference_spp, seed=99) if with_error else None
    found = {}
    for name in scenes:
        pictures = np.asarray(frames[name], np.float64)
        found[name] = {
            "seconds": float(np.median(seconds[name])),
            "variance": float(pictures.var(axis=0, ddof=1).mean()),
        }
        if reference is not None and name != "principled":
            found[name]["error"] = float(((pictures - reference) ** 2).mean())
    return found


def scene(bsdf: dict[str, Any], size: int) -> dict[str, Any]:
    return preview_scene(bsdf, size=(size, size), max_depth=DEPTH)


def summary(rows: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Geometric means over materials of the ratios to `layered`."""

    def mean(name: str, ratio) -> float:
        values = [ratio(row[name], row["layered"]) for row in rows]
        values = [v for v in values if v is not None]
        return round(float(np.exp(np.mean(np.log(values)))), 4) if values else float("nan")

    return {
        name: {
            "time": mean(name, lambda a, b: a["seconds"] / b["seconds"]),
            "variance": mean(name, lambda a, b: a["variance"] / b["variance"]),
            "efficiency": mean(
                name, lambda a, b: b["variance"] * b["seconds"] / (a["variance"] * a["seconds"])
            ),
            "efficiency by error": mean(
                name,
                lambda a, b: (
                    b["error"] * b["seconds"] / (a["error"] * a["seconds"]) if "error" in a else None
                ),
            ),
        }
        for name in rows[0]
    }


def table(result: dict[str, dict[str, float]]) -> str:
    columns = list(next(iter(result.values())))
    lines = [f"{'to layered':24}" + "".join(f"{c:>22}" for c in columns)]
    lines += [f"{name:24}" + "".join(f"{row[c]:22.3f}" for c in columns) for name, row in result.items()]
    return "\n".join(lines)


def plot(rows: list[dict[str, dict[str, float]]], path: Path) -> None:
    """Every material's time and efficiency, sorted, against the simulation's and the paper's means."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name in rows[0]:
        if name in ("layered", "principled"):
            continue
        times = [row[name]["seconds"] / row["layered"]["seconds"] for row in rows]
        gains = [
            row["layered"]["variance"]
            * row["layered"]["seconds"]
            / (row[name]["variance"] * row[name]["seconds"])
            for row in rows
        ]
        left.plot(sorted(times), label=name)
        right.semilogy(sorted(gains), label=name)
    left.axhline(0.58, color="k", linewidth=0.8, linestyle=":", label="paper's mean")
    right.axhline(1.67, color="k", linewidth=0.8, linestyle=":")
    left.set(xlabel="materials, sorted", ylabel="time of layered's", ylim=(0, None))
    right.set(xlabel="materials, sorted", ylabel="efficiency over layered")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    left.legend()
    figure.savefig(path, dpi=110)
    print(path)


if __name__ == "__main__":
    main()
