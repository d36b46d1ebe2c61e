"""A library of the 100 NBRDF-MERL materials in one small network, and mixtures of its latent codes (paper Fig. 12).

    python -m figures.library.run [--quick] [--steps N] [--data FILE] [--new FILE] [--held-out N] [--size N] [--spp N]

Trains a library as `nma train-library` does, and compares each material of the library with the material's table. Then
learns latent codes of materials that the library was not trained on, and renders mixtures of the latent codes of four
materials. The networks of NBRDF-MERL and the measured material are not part of this repository: `--data` and `--new`
name their files. Tables, weights and metrics are kept in out/figures/library, so a killed run continues where it
stopped.

Prints library.md, and writes library.md, library.json and library.png beside this file. With --quick, trains briefly on
four of Mitsuba's BSDFs and writes to out/figures/library.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
import nma.render
from figures import common, studio
from nma.adapter.library import Library
from nma.cli.console import TrainingBar, progress
from nma.files import write_text
from nma.images.io import tonemap
from nma.table import Tables, collection
from nma.table.collection import Member
from nma.train import library as training
from nma.train.recipe import Recipe

DATA = common.DATA
NBRDF = DATA / "merl_nbrdf/merl_nbrdf_weights.npz"
NEW = DATA / "rgl/cc_ibiza_sunset_rgb.bsdf"
# The materials in the grid's corners (top left, top right, bottom left, bottom right): metal, paint, matte and plastic.
CORNERS = ("brass", "color-changing-paint2", "pink-fabric", "green-plastic")
CELLS = 7
# The pictures in the plot are brightened by EXPOSURE stops. FLIP is computed from the original pictures.
EXPOSURE = 1.0
# To compare an adapter with a table, the network runs at DIRECTIONS values of cos(theta_i) in each row of the table.
DIRECTIONS = 16
# Correlated multi-jittered samples, as in figures/rendered.
SAMPLER = "multijitter"
QUICK = {
    "conductor": '<bsdf type="roughconductor"><string name="material" value="Au"/></bsdf>',
    "plastic": '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value=".1, .2, .6"/></bsdf>',
    "matte": '<bsdf type="diffuse"><rgb name="reflectance" value=".7, .6, .5"/></bsdf>',
    "red": '<bsdf type="principled"><rgb name="base_color" value=".6, .1, .1"/></bsdf>',
    "new": '<bsdf type="principled"><rgb name="base_color" value=".1, .5, .2"/></bsdf>',
}


def main() -> None:
    arguments = parse()
    folder = common.results(__file__, arguments.quick)
    kept = common.ROOT / "out/figures/library" / ("quick" if arguments.quick else "kept")
    nma.render.use()
    if arguments.quick:
        write_quick(kept)
    members, new = collection.members(arguments.data), Member(arguments.new.stem, arguments.new)
    recipe = replace(training.RECIPE, **arguments.settings)
    tables = tabulated(members, kept)
    library, spent = trained("all", members, tables, recipe, kept)
    rows = judged(library, tables, kept / f"all_{recipe.steps}.json")
    encoded = [encoding(new.name, library, tabulated([new], kept), arguments.encoding_steps)]
    held_out = unseen(members, tables, recipe, arguments, kept)
    pictures, flips = rendered(library, members, arguments, kept)
    data = {
        "materials": len(members),
        "origin": collection.origin(members),
        "parameters": library.parameters,
        "recipe": asdict(recipe),
        "seconds": spent,
        "fits": rows,
        "encoded": encoded,
        "held_out": held_out,
        "flip": flips,
    }
    text = markdown(data)
    print(text)
    write_text(folder / "library.md", text)
    common.write_json(folder / "library.json", data)
    sheet(pictures, flips, folder / "library.png")


def parse() -> argparse.Namespace:
    parser = common.parser(__doc__)
    parser.add_argument("--steps", type=int, help="training steps, in place of the recipe's")
    parser.add_argument("--data", type=Path, default=NBRDF, help="the materials")
    parser.add_argument("--new", type=Path, default=NEW, help="a material for which only a code is learned")
    parser.add_argument(
        "--held-out", type=int, default=10, help="how many materials to hide from a second library"
    )
    parser.add_argument("--size", type=int, default=128, help="size of the pictures, in pixels")
    parser.add_argument("--spp", type=int, default=256, help="samples per pixel of the mixtures")
    parser.add_argument(
        "--reference-spp", type=int, default=1024, help="samples per pixel of fits and references"
    )
    arguments = parser.parse_args()
    vars(arguments).update(settings={}, encoding_steps=training.ENCODING.steps, corners=CORNERS)
    if arguments.quick:
        kept = common.ROOT / "out/figures/library/quick"
        vars(arguments).update(data=kept / "materials", new=kept / "new.xml", held_out=0, size=24, spp=16)
        vars(arguments).update(reference_spp=16, corners=tuple(QUICK)[:4], encoding_steps=100)
        arguments.settings = {"steps": 200, "rows": 64, "points": 4, "albedo_samples": 2, "average": 0.9}
    elif arguments.steps:
        arguments.settings = {"steps": arguments.steps}
    return arguments


def write_quick(kept: Path) -> None:
    """Writes five of Mitsuba's BSDFs to files: four to train a library on, and one as the new material."""
    for name, bsdf in QUICK.items():
        path = kept / ("new.xml" if name == "new" else f"materials/{name}.xml")
        write_text(path, bsdf.replace("<bsdf", '<bsdf version="3.0.0"') + "\n")


def tabulated(members: Sequence[Member], kept: Path) -> Tables:
    bar = progress("materials/s")
    with bar:
        task = bar.add_task("tabulating", total=len(members), rate="", note="")
        return collection.tables(members, kept / "tables", lambda done: bar.update(task, completed=done))


def trained(
    label: str, members: Sequence[Member], tables: Tables, recipe: Recipe, kept: Path
) -> tuple[Library, float]:
    """Returns a library of the materials `members`, trained if its file does not exist, and the training's seconds."""
    path = kept / f"{label}_{recipe.steps}.safetensors"
    if not path.exists():
        record = {"data": collection.origin(members), "materials": len(members)}
        names = [member.name for member in members]
        checkpoint = path.with_suffix(".ckpt")
        with TrainingBar(recipe, label) as bar:
            made, _ = training.train_library(
                names, tables, recipe, record, checkpoint=checkpoint, progress=bar.update
            )
        made.save(path)
        checkpoint.unlink()
    library = Library.load(path)
    return library, library.adapter.training["seconds"]


def judged(library: Library, tables: Tables, path: Path) -> list[dict[str, Any]]:
    """Returns log loss, albedo error and noise floor of each material, sorted by log loss. The noise floor is the log
    loss that the noise of the material's table alone gives."""
    known = Tables(library.codes.astype(np.float64), tables.values, tables.walks, tables.error)
    found = common.kept(path, lambda: common.figures(library.adapter, known, DIRECTIONS))
    wanted = ("log_loss", "albedo_error", "noise_floor")
    rows = [
        {"name": name} | {key: round(row[key], 6) for key in wanted}
        for name, row in zip(library.names, found, strict=True)
    ]
    return sorted(rows, key=lambda row: row["log_loss"])


def encoding(name: str, library: Library, tables: Tables, steps: int) -> dict[str, Any]:
    """Learns the latent code of a new material. Returns the log loss, the most similar material of the library, and the
    time in seconds."""
    began = time.perf_counter()
    found = training.encode(library, tables, recipe=replace(training.ENCODING, steps=steps))
    row = {"name": name, "log_loss": round(found.log_loss, 6), "nearest": found.nearest}
    row |= {"nearest_log_loss": round(found.nearest_log_loss, 6)}
    print(f"{name}: {row}", flush=True)
    return row | {"seconds": round(time.perf_counter() - began, 1)}


def unseen(
    members: Sequence[Member], tables: Tables, recipe: Recipe, arguments: argparse.Namespace, kept: Path
) -> list[dict[str, Any]]:
    """Trains a second library without N materials (--held-out), and then learns latent codes for these N materials."""
    if not arguments.held_out:
        return []
    out = np.linspace(0, len(members), arguments.held_out, endpoint=False).astype(int) + 1
    rest = np.setdiff1d(np.arange(len(members)), out)
    library, _ = trained(f"without_{len(out)}", [members[k] for k in rest], tables[rest], recipe, kept)
    steps = arguments.encoding_steps
    path = kept / f"without_{len(out)}_{recipe.steps}_encoded_{steps}.json"
    return common.kept(
        path, lambda: [encoding(members[k].name, library, tables[k : k + 1], steps) for k in out]
    )


def rendered(
    library: Library, members: Sequence[Member], arguments: argparse.Namespace, kept: Path
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Renders the CELLS x CELLS grid of mixtures and the references of its corners.

    Returns the pictures, and for each corner the FLIP of the fit and the FLIP of noise alone.
    """
    by_name = {member.name: member for member in members}
    size, many = arguments.size, arguments.reference_spp
    codes = np.stack([library.code(name) for name in arguments.corners])
    grid = []
    for v in np.linspace(0.0, 1.0, CELLS):
        for u in np.linspace(0.0, 1.0, CELLS):
            shares = np.array([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
            corner = shares.max() == 1.0
            bsdf = fit(library, shares @ codes, kept)
            grid.append(studio.render(bsdf, size, many if corner else arguments.spp, 1, SAMPLER))
    fits = [grid[k] for k in (0, CELLS - 1, CELLS * (CELLS - 1), CELLS * CELLS - 1)]
    references, flips = [], []
    for name, own in zip(arguments.corners, fits, strict=True):
        bsdf = measured(by_name[name])
        reference, again = (studio.render(bsdf, size, many, seed, SAMPLER) for seed in (2, 3))
        errors, noise = (nma.compare_images(image, reference) for image in (own, again))
        references.append(reference)
        row = {"name": name} | {key: round(errors[key], 5) for key in ("flip_ldr", "flip_hdr")}
        flips.append(row | {f"noise_{key}": round(noise[key], 5) for key in ("flip_ldr", "flip_hdr")})
        print(flips[-1], flush=True)
    return {"grid": grid, "references": references}, flips


def fit(library: Library, code: NDArray, kept: Path) -> dict[str, Any]:
    """Returns the BSDF `nma` for a latent code of the library."""
    path = kept / "mixture.safetensors"
    library.material(code).save(path)
    return {"type": "nma", "adapter": str(path)}


def measured(member: Member) -> dict[str, Any]:
    """Returns the BSDF `values`, which renders the BRDF values of a material without an adapter."""
    chosen = {"material": member.material} if member.material else {}
    return {"type": "values", "file": str(member.path)} | chosen


def markdown(data: dict[str, Any]) -> str:
    """Returns the tables of README.md, in Markdown."""
    losses = [row["log_loss"] for row in data["fits"]]
    albedos = [row["albedo_error"] for row in data["fits"]]
    worst = data["fits"][-1]
    lines = [
        f"The library has {data['materials']} materials ({data['origin']}) and {data['parameters']:,} parameters, "
        f"and was trained for {data['recipe']['steps']} steps in {data['seconds']:.0f} s.",
        "",
        "| | mean | median | worst |",
        "|---|---|---|---|",
        f"| log loss | {np.mean(losses):.5f} | {np.median(losses):.5f} | {max(losses):.5f} ({worst['name']}) |",
        f"| albedo error | {np.mean(albedos):.5f} | {np.median(albedos):.5f} | {max(albedos):.5f} |",
        "",
        "Latent codes of new materials:",
        "",
        "| material | log loss | nearest of the library | its log loss | seconds |",
        "|---|---|---|---|---|",
    ]
    found = data["encoded"] + data["held_out"]
    lines += [
        f"| {row['name']} | {row['log_loss']:.5f} | {row['nearest']} | {row['nearest_log_loss']:.5f} "
        f"| {row['seconds']} |"
        for row in found
    ]
    lines += ["", "Pictures of the four materials in the grid's corners, compared with their references:", ""]
    lines += ["| material | FLIP | HDR-FLIP | FLIP of noise | HDR-FLIP of noise |", "|---|---|---|---|---|"]
    keys = ("flip_ldr", "flip_hdr", "noise_flip_ldr", "noise_flip_hdr")
    lines += [
        f"| {row['name']} | " + " | ".join(f"{row[key]:.4f}" for key in keys) + " |" for row in data["flip"]
    ]
    return "\n".join(lines) + "\n"


def sheet(pictures: dict[str, Any], flips: list[dict[str, Any]], path: Path) -> None:
    """Draws the grid of mixtures. Each corner's reference and the FLIP of its fit are drawn beside the corner."""
    figure = Figure(figsize=(1.4 * (CELLS + 2), 1.4 * CELLS))
    axes = figure.subplots(CELLS, CELLS + 2)
    figure.subplots_adjust(left=0.003, right=0.997, bottom=0.003, top=0.997, wspace=0.03, hspace=0.03)
    for place in axes.flat:
        place.set_axis_off()
    for k, image in enumerate(pictures["grid"]):
        show(axes[k // CELLS, k % CELLS + 1], image)
    for k, (image, row) in enumerate(zip(pictures["references"], flips, strict=True)):
        top = k < 2
        place = axes[0 if top else -1, (CELLS + 1) * (k % 2)]
        show(place, image)
        errors = f"FLIP of its fit: {row['flip_ldr']:.4f}\nof noise: {row['noise_flip_ldr']:.4f}"
        words = f"{row['name']}\n(reference)\n\n{errors}"
        at, anchor = (-0.06, "top") if top else (1.06, "bottom")
        place.text(0.5, at, words, transform=place.transAxes, ha="center", va=anchor, fontsize=8)
    common.save_figure(figure, path, dpi=130)


def show(axes: Any, image: NDArray[np.float32]) -> None:
    axes.imshow(tonemap(image, exposure=EXPOSURE, shoulder=0.8), interpolation="lanczos")


if __name__ == "__main__":
    main()
