"""The signed error of the brightness of rendered adapters over cos(theta_i), for all named materials.

    python -m figures.brightness.run [--quick] [--adapter FILE ...] [--spp N]

Every named material is rendered on the preview scene, once by the simulation and once by each adapter. The pixels of
the ball are sorted by cos(theta_i) into bands. The error of a band is the sum of the adapter's pixels over the sum of
the simulation's pixels, minus 1: positive where the adapter is too bright. The sums are over R, G and B. Pixels above 3
are clipped to 3, so that few bright pixels do not decide. Each picture is the mean of PARTS renderings with different
seeds, and the spread of the errors of the parts gives the standard error.

The renderings are kept in out/figures/brightness, so a killed run continues where it stopped. The page README.md
beside this file says how long a run takes.

Prints the table of README.md, and writes table.md, brightness.json and brightness.png beside this file. With --quick,
renders two small materials and writes to out/figures/brightness.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
import nma.render
from figures import common
from figures.rendered.run import Subject
from nma.files import write_text
from nma.render.load import load_dict
from nma.render.progressive import render_passes, sampler
from nma.render.scene import material_cosines

# The adapters of a run without --adapter: weights files or shipped names, one a line.
ADAPTERS: list[str] = [*nma.shipped()]
PARTS = 4
BRIGHTEST = 3.0
# Bands of cos(theta_i): those of the table, and those of the plot.
BANDS = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
FINE = np.linspace(0.1, 1.0, 10)
# The bands that the summary judges: oblique views, from .2 to .6.
OBLIQUE = 2


class Errors(NamedTuple):
    """The signed error of each band, and the standard error of each signed error; both are (bands,)."""

    signed: NDArray[np.float64]
    doubt: NDArray[np.float64]


def main() -> None:
    arguments = parse()
    folder = common.results(__file__, arguments.quick)
    nma.render.use()
    cosines = material_cosines((arguments.resolution, arguments.resolution))
    truth = Subject("simulation", None, arguments.spp, 0)
    subjects = [Subject(Path(file).stem, file, arguments.spp, 1) for file in arguments.adapter or ADAPTERS]
    results: dict[str, dict[str, dict[str, list[float]]]] = {subject.name: {} for subject in subjects}
    for material in nma.material_names()[: arguments.materials]:
        reference = pictures(truth, material, arguments)
        for subject in subjects:
            mine = pictures(subject, material, arguments)
            results[subject.name][material] = entry(mine, reference, cosines)
            print(subject.name, material, results[subject.name][material]["signed"], flush=True)
    text = table(results)
    print(text)
    write_text(folder / "table.md", text + "\n")
    settings = {"spp": arguments.spp, "resolution": arguments.resolution, "bands": BANDS.tolist()}
    common.write_json(
        folder / "brightness.json", settings | {"fine_bands": FINE.round(2).tolist(), "adapters": results}
    )
    plot(results, folder / "brightness.png")


def parse() -> argparse.Namespace:
    parser = common.parser(__doc__)
    parser.add_argument(
        "--adapter", action="append", help="a weights file or a shipped name; may be repeated"
    )
    parser.add_argument("--spp", type=int, default=1024, help="samples per pixel")
    arguments = parser.parse_args()
    vars(arguments).update(resolution=96, materials=None)
    if arguments.quick:
        vars(arguments).update(resolution=32, materials=2, spp=64)
    return arguments


def pictures(subject: Subject, material: str, arguments: argparse.Namespace) -> NDArray[np.float32]:
    """Returns PARTS renderings (PARTS, height, width, 3) of one material, which are stored in a file."""
    size, spp = arguments.resolution, arguments.spp // PARTS
    kept = common.ROOT / "out/figures/brightness/pictures"
    path = kept / f"{subject.key}_{material}_{size}_{arguments.spp}.npy"
    if not path.exists():
        kept.mkdir(parents=True, exist_ok=True)
        bsdf = subject.bsdf(nma.load_material(material))
        scene = load_dict(nma.preview_scene(bsdf, size=(size, size), sampler=sampler(spp, size * size)))
        seeds = range(subject.seed * PARTS, (subject.seed + 1) * PARTS)
        common.save_array(path, np.stack([render_passes(scene, spp, seed=seed) for seed in seeds]))
    return np.load(path)


def entry(mine: NDArray, reference: NDArray, cosines: NDArray) -> dict[str, list[float]]:
    """Returns the errors of one material in the bands of the table and of the plot, rounded."""
    coarse, fine = (errors(mine, reference, cosines, bands) for bands in (BANDS, FINE))
    found = {"signed": coarse.signed, "doubt": coarse.doubt, "fine_signed": fine.signed}
    return {name: values.round(4).tolist() for name, values in found.items()}


def errors(mine: NDArray, reference: NDArray, cosines: NDArray, bands: NDArray) -> Errors:
    """Returns the signed errors of brightness in bands of cos(theta_i).

    Args:
        mine: renderings by the adapter (PARTS, height, width, 3).
        reference: renderings by the simulation, as `mine`.
        cosines: cos(theta_i) of each pixel (height, width), NaN where a pixel does not show the material.
        bands: the ends of the bands (n + 1,).
    """
    ours, theirs = (brightness(images, cosines, bands) for images in (mine, reference))
    parts = ours / theirs - 1.0
    doubt = parts.std(axis=0, ddof=1) / len(parts) ** 0.5
    return Errors(ours.sum(axis=0) / theirs.sum(axis=0) - 1.0, doubt)


def brightness(images: NDArray, cosines: NDArray, bands: NDArray) -> NDArray[np.float64]:
    """Returns the summed pixels of each image and band: (images, bands)."""
    pixels = np.clip(images.astype(np.float64), 0.0, BRIGHTEST).sum(axis=-1)
    # NaN is in no band, because comparisons with NaN are false.
    inside = [(cosines >= low) & (cosines < high) for low, high in zip(bands, bands[1:], strict=False)]
    return np.stack([pixels[:, band].sum(axis=-1) for band in inside], axis=-1)


def table(results: dict[str, Any]) -> str:
    """Returns a Markdown table of the signed errors in %, and a line for each adapter with its largest error."""
    head = ["%", "material", *(f"{a:.1f} to {b:.1f}" for a, b in zip(BANDS, BANDS[1:], strict=False))]
    lines = [head, ["---"] * len(head)]
    for name, materials in results.items():
        for material, found in materials.items():
            lines.append([name, material, *(f"{100 * x:+.1f}" for x in found["signed"])])
    rows = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return "\n\n".join([rows, *(f"- {name}: {worst(found)}" for name, found in results.items())])


def worst(materials: dict[str, dict[str, list[float]]]) -> str:
    """Says which oblique error of an adapter is the largest, with its standard error."""
    size, material, band = max(
        (abs(found["signed"][band]), material, band)
        for material, found in materials.items()
        for band in range(OBLIQUE)
    )
    sign = np.sign(materials[material]["signed"][band])
    within = f"{BANDS[band]:.1f} to {BANDS[band + 1]:.1f}"
    return (
        f"the largest error at cos(theta_i) {BANDS[0]:.1f} to {BANDS[OBLIQUE]:.1f} is {100 * sign * size:+.1f} % "
        f"(standard error {100 * materials[material]['doubt'][band]:.1f} %): {material}, {within}"
    )


def plot(results: dict[str, Any], path: Path) -> None:
    """Plots the signed error over cos(theta_i): a panel for each material and a line for each adapter."""
    names = list(next(iter(results.values())))
    columns = min(5, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.6 * columns, 2.3 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    middle = 0.5 * (FINE[1:] + FINE[:-1])
    for axes, material in zip(grid, names, strict=False):
        axes.axhspan(-5, 5, color="0.92")
        axes.axhline(0, color="black", linewidth=0.8)
        for name, materials in results.items():
            axes.plot(middle, 100 * np.array(materials[material]["fine_signed"]), label=name)
        axes.set_title(material, fontsize=9)
        axes.grid(alpha=0.3)
    for axes in grid[len(names) :]:
        axes.set_axis_off()
    grid[0].legend(fontsize=7)
    figure.supxlabel("cos(theta_i)", fontsize=9)
    figure.supylabel("error of brightness [%]", fontsize=9)
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
