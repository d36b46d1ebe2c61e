"""Fits to single materials, measured and analytic, compared with two other models (paper Fig. 13).

    python -m figures.measured.run [--quick] [--steps N] [--data FOLDER] [--size N] [--spp N] [MATERIAL ...]

Fits a 3x32 network to each material, as `nma fit` does, and compares the fit with the material at 20,000 random pairs
of directions and in a picture. Two other models are compared with the material at the same pairs of directions: the
best constant Principled BRDF, and the NBRDF networks that Sztrajman et al. 2021 fitted to RGL's measurements. The
measurements and the NBRDF networks are not part of this repository. The measurements are read from the folder `rgl` and
the networks from the folder `rgl_nbrdf`, both inside the folder `--data`; materials without a file are left out.

Writes measured.md, measured.json and measured.png beside this file. With --quick, trains briefly on two materials and
writes to out/figures/measured.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from matplotlib import colormaps

import nma
import nma.render
from figures import common, studio
from nma import network
from nma.adapter import Adapter
from nma.adapter.values import AdapterValues
from nma.cli.console import TrainingBar
from nma.evaluate.pairs import Pairs, compare
from nma.files import write_text
from nma.images.metrics import flip_map
from nma.images.sheet import Row, contact_sheet
from nma.ops import Vec3
from nma.render.values_bsdf import bsdf_of
from nma.sources.base import Values
from nma.sources.coating import Coating
from nma.sources.mitsuba_bsdf import from_dict
from nma.sources.nbrdf import WEIGHTS, Nbrdf
from nma.table.values import tabulate_values
from nma.train.fit import recipe_for
from nma.train.principled import CONSTANT, fit_constant

DATA = common.DATA
RGL = ("cc_ibiza_sunset", "cg_sunflower", "colodur_napoli_4f", "paper_white")
# Ranges of cos(theta_i) and cos(theta_o). The keys are appended to the names of the metrics. The NBRDF networks reach
# their published errors only for cosines above .05, because grazing directions are the hardest to fit.
RANGES = {"": (0.02, 1.0), " from .05": (0.05, 1.0)}
TIMED_PAIRS = 1 << 18
SAMPLER = "multijitter"
PLASTIC = {
    "type": "roughplastic",
    "alpha": 0.15,
    "diffuse_reflectance": {"type": "rgb", "value": [0.05, 0.2, 0.5]},
}
BRUSHED = {
    "type": "roughconductor",
    "material": "Cu",
    "distribution": "ggx",
    "alpha_u": 0.08,
    "alpha_v": 0.35,
}


class Material(NamedTuple):
    """A material's source, the BSDF that renders this source without an adapter, and the NBRDF network (or None)."""

    name: str
    source: Values
    bsdf: dict[str, Any]
    nbrdf: Nbrdf | None = None


def main() -> None:
    arguments = parse()
    folder = common.results(__file__, arguments.quick)
    kept = common.ROOT / "out/figures/measured" / ("quick" if arguments.quick else "kept")
    nma.render.use()
    known = {m.name: m for m in materials(arguments.data)}
    if unknown := set(arguments.materials) - set(known):
        sys.exit(f"no material {', '.join(sorted(unknown))}; the materials are {', '.join(known)}")
    chosen = [m for name, m in known.items() if not arguments.materials or name in arguments.materials]
    rows, pictures = [], []
    for material in chosen:
        adapter, seconds = fitted(material, arguments.steps, kept)
        own, errors = rendered(material, adapter, kept, arguments)
        models = alternatives(material, adapter, arguments.constant_steps, kept)
        rows.append({"name": material.name, "seconds": seconds, "models": judged(material, models)} | errors)
        pictures.append(Row(material.name, own, ("itself", "fit", f"FLIP {errors['flip_ldr']:.4f}")))
        print(rows[-1], flush=True)
    text = markdown(rows)
    print(text)
    write_text(folder / "measured.md", text)
    common.write_json(folder / "measured.json", rows)
    contact_sheet(folder / "measured.png", pictures, ("material", "3x32 fit", "FLIP of the fit"))


def parse() -> argparse.Namespace:
    parser = common.parser(__doc__)
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--steps", type=int, help="training steps, in place of the recipe's")
    parser.add_argument("--data", type=Path, default=DATA, help="folder with rgl and rgl_nbrdf")
    parser.add_argument("--size", type=int, default=160, help="size of the pictures, in pixels")
    parser.add_argument("--spp", type=int, default=1024, help="samples per pixel")
    arguments = parser.parse_args()
    arguments.constant_steps = CONSTANT.steps
    if arguments.quick:
        vars(arguments).update(
            steps=50, constant_steps=20, size=24, spp=16, materials=["coating", "brushed copper"]
        )
    return arguments


def materials(data: Path) -> list[Material]:
    """Returns the materials: first the RGL measurements whose files exist, then the analytic materials."""
    found = []
    for name in RGL:
        path, networks = data / f"rgl/{name}_rgb.bsdf", data / "rgl_nbrdf/rgl-isotropic_nbrdf_weights.npz"
        if path.is_file():
            nbrdf = Nbrdf.load(networks, f"{name}_rgb") if networks.is_file() else None
            found.append(
                Material(name, nma.read_values(path), {"type": "measured", "filename": str(path)}, nbrdf)
            )
        else:
            print(
                f"{name} is left out, because {path} does not exist; `nma data` says where to get it",
                file=sys.stderr,
            )
    coating = Coating(conductor="Au", alpha_metal=0.3, alpha=0.03, absorption=(0.02, 0.1, 0.3))
    found.append(Material("coating", coating, bsdf_of(coating)))
    for name, bsdf in (("rough plastic", PLASTIC), ("brushed copper", BRUSHED)):
        found.append(Material(name, from_dict(bsdf, name), bsdf))
    return found


def fitted(material: Material, steps: int | None, kept: Path) -> tuple[Adapter, float]:
    """Returns the adapter that `nma fit` makes for the material, and the seconds of the fit, including compilation."""
    recipe = recipe_for(material.source, steps=steps)
    path = kept / f"{slug(material)}_{recipe.steps}.safetensors"
    if not path.exists():
        began = time.perf_counter()
        with TrainingBar(recipe, material.name) as bar:
            adapter, _ = nma.fit(material.source, recipe, progress=bar.update)
        adapter.training["wall_seconds"] = round(time.perf_counter() - began, 1)
        adapter.save(path)
    adapter = Adapter.load(path)
    return adapter, adapter.training["wall_seconds"]


def alternatives(
    material: Material, adapter: Adapter, constant_steps: int, kept: Path
) -> dict[str, tuple[Values, int]]:
    """Returns the fit and the other models of the material, by name, each with its number of parameters."""
    found: dict[str, tuple[Values, int]] = {
        "3x32 fit": (AdapterValues(adapter), network.parameters(adapter.layers))
    }
    if material.nbrdf is not None:
        found["NBRDF"] = material.nbrdf, WEIGHTS
    if material.source.isotropic:
        path = kept / f"{slug(material)}_constant_{constant_steps}.safetensors"
        if not path.exists():
            # The loss has no albedo term, because the committed results were fitted without this term.
            recipe = replace(CONSTANT, steps=constant_steps, albedo=0.0)
            fit_constant(tabulate_values(material.source), recipe).adapter.save(path)
        constant = Adapter.load(path)
        found["constant Principled"] = AdapterValues(constant), constant.size
    return found


def judged(material: Material, models: dict[str, tuple[Values, int]]) -> list[dict[str, Any]]:
    """Returns a row for each model: number of parameters, time per pair of directions, metrics by range of cosines."""
    times = nanoseconds([model for model, _ in models.values()])
    rows = []
    for (name, (model, parameters)), ns in zip(models.items(), times, strict=True):
        row: dict[str, Any] = {"model": name, "parameters": parameters, "ns": round(ns, 1)}
        for words, cosines in RANGES.items():
            pairs = Pairs.draw(seed=2, cosines=cosines)
            row |= {f"{k}{words}": round(v, 6) for k, v in compare(model, material.source, pairs).items()}
        rows.append(row)
    return rows


def slug(material: Material) -> str:
    return material.name.replace(" ", "-")


def nanoseconds(models: list[Values], repetitions: int = 7) -> list[float]:
    """Returns each model's shortest time in nanoseconds per pair of directions, without compilation.

    Each repetition evaluates TIMED_PAIRS pairs with every model on all cores.
    """
    rng = np.random.default_rng(0)
    lanes = [dr.auto.Float(rng.random(TIMED_PAIRS).astype(np.float32)) for _ in range(4)]

    def direction(mu: Any, turn: Any) -> Vec3:
        sin = dr.sqrt(1.0 - mu * mu)
        return Vec3(sin * dr.cos(6.2831853 * turn), sin * dr.sin(6.2831853 * turn), mu)

    wi, wo = direction(*lanes[:2]), direction(*lanes[2:])
    dr.eval(*wi, *wo)
    times: list[list[float]] = [[] for _ in models]
    for _ in range(repetitions + 1):
        for model, spent in zip(models, times, strict=True):
            began = time.perf_counter()
            value = model.eval(wi, wo)
            dr.eval(*value)
            dr.sync_thread()
            spent.append(time.perf_counter() - began)
    return [min(spent[1:]) / TIMED_PAIRS * 1e9 for spent in times]


def rendered(
    material: Material, adapter: Adapter, kept: Path, arguments: argparse.Namespace
) -> tuple[list[Any], dict[str, float]]:
    """Renders the material twice and its fit once.

    Returns three pictures (the material, the fit, and the map of FLIP between them), the FLIP of the fit, and the FLIP
    of noise alone.
    """
    path = kept / f"{slug(material)}_rendered.safetensors"
    adapter.save(path)
    images = []
    for label, seed, bsdf in (
        ("itself", 1, material.bsdf),
        ("again", 2, material.bsdf),
        (f"fit_{adapter.training['steps']}", 3, {"type": "nma", "adapter": str(path)}),
    ):
        file = kept / f"{slug(material)}_{label}_{arguments.size}_{arguments.spp}.npy"
        if not file.exists():
            common.save_array(file, studio.render(bsdf, arguments.size, arguments.spp, seed, SAMPLER))
        images.append(np.load(file))
    reference, again, own = images
    errors, noise = (nma.compare_images(image, reference) for image in (own, again))
    found = {key: round(errors[key], 5) for key in ("flip_ldr", "flip_hdr")}
    found |= {f"noise_{key}": round(noise[key], 5) for key in ("flip_ldr", "flip_hdr")}
    return [reference, own, flip_picture(flip_map(own, reference))], found


def flip_picture(errors: np.ndarray) -> np.ndarray:
    """Returns a FLIP map (height, width), 0 .. 1, as a picture of bytes, in the colours that FLIP's authors use."""
    return (colormaps["magma"](np.clip(errors, 0.0, 1.0))[..., :3] * 255.0).astype(np.uint8)


def markdown(rows: list[dict[str, Any]]) -> str:
    """Returns the tables of README.md, in Markdown."""
    lines = ["| material | model | log loss | AE | SMAPE | log loss from .05 | parameters | ns a pair |"]
    lines += ["|---|---|---|---|---|---|---|---|"]
    for row in rows:
        for m in row["models"]:
            figures = f"{m['log_loss']:.4f} | {m['ae']:.4f} | {m['smape']:.3f} | {m['log_loss from .05']:.4f}"
            lines.append(
                f"| {row['name']} | {m['model']} | {figures} | {m['parameters']:,} | {m['ns']:.1f} |"
            )
    lines += means([row for row in rows if any(m["model"] == "NBRDF" for m in row["models"])])
    lines += ["", "| material | seconds of the fit | FLIP | HDR-FLIP | FLIP of noise | HDR-FLIP of noise |"]
    lines += ["|---|---|---|---|---|---|"]
    keys = ("flip_ldr", "flip_hdr", "noise_flip_ldr", "noise_flip_hdr")
    lines += [
        f"| {row['name']} | {row['seconds']:.0f} | " + " | ".join(f"{row[key]:.4f}" for key in keys) + " |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def means(rows: list[dict[str, Any]]) -> list[str]:
    """Returns the lines of a table of mean log losses by model; `rows` are the materials with an NBRDF network."""
    if not rows:
        return []
    lines = [
        "",
        f"| mean of the {len(rows)} with NBRDF networks | log loss | log loss from .05 |",
        "|---|---|---|",
    ]
    for k, model in enumerate(rows[0]["models"]):
        found = [np.mean([row["models"][k][f"log_loss{words}"] for row in rows]) for words in RANGES]
        lines.append(f"| {model['model']} | " + " | ".join(f"{loss:.5f}" for loss in found) + " |")
    return lines


if __name__ == "__main__":
    main()
