"""Textured materials, rendered with an adapter that was not trained on textures (paper Fig. 7).

    python -m figures.textures.run [--quick] [--adapter FILE]

The preview scene with one material is rendered by simulation and with the adapter, in four steps: (a) without textures,
(b) with a texture for the metal's roughness, (c) with a second texture for the extinction, (d) with a third texture for
the albedo of the medium. A second simulation has as many samples per pixel as the adapter; the error of its picture is
only noise.

Writes textures.json and textures.png beside this file. With --quick, renders only (a) and (d) in small pictures with
few samples, and writes to out/figures/textures.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import nma
import nma.render
from figures import common
from nma.adapter import DEFAULT_ADAPTER
from nma.images.metrics import difference_image
from nma.images.sheet import Row, contact_sheet
from nma.render.demo import DEPTH, FLIP_SCALE, TEXTURE_SCALE
from nma.render.load import load_dict, material_bsdf
from nma.render.progressive import render_passes
from nma.render.textures import bitmap_texture, procedural_textures

# Dull copper under a blue medium and a rough coat.
MATERIAL = "copper-purple-medium"
CHANGES = {"alpha_top": 0.1, "alpha_bottom": 0.5, "albedo": [0.12, 0.34, 0.62], "sigma_t": 0.6}
STEPS = {
    "(a) plain": (),
    "(b) + roughness": ("alpha_bottom",),
    "(c) + extinction": ("alpha_bottom", "sigma_t"),
    "(d) + albedo": ("alpha_bottom", "sigma_t", "albedo"),
}
TABLED = ("flip_hdr", "flip_ldr", "smape", "ssim")


class Size(NamedTuple):
    """Size of the pictures in pixels, samples per pixel of the reference, and samples per pixel of the other
    pictures."""

    pixels: int
    reference_spp: int
    spp: int


class Step(NamedTuple):
    """One step: pictures of the reference and the adapter, and metrics of the adapter and of the second simulation."""

    reference: np.ndarray
    adapter: np.ndarray
    metrics: dict[str, float]
    noise: dict[str, float]


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--adapter", default=DEFAULT_ADAPTER, help="a weights file or a shipped name")
    arguments = parser.parse_args()
    nma.render.use()
    size = Size(128, 16, 16) if arguments.quick else Size(256, 384, 192)
    folder = common.results(__file__, arguments.quick)
    images = {n: bitmap_texture(t, scale=TEXTURE_SCALE) for n, t in procedural_textures(512).items()}
    steps = {}
    for label in list(STEPS)[:: 3 if arguments.quick else 1]:
        began = time.perf_counter()
        steps[label] = render({n: images[n] for n in STEPS[label]}, arguments.adapter, size)
        metrics = steps[label].metrics
        print(
            f"{label}: {time.perf_counter() - began:.0f} s, HDR-FLIP {metrics['flip_hdr']:.4f}, "
            f"SMAPE {metrics['smape']:.4f}",
            flush=True,
        )
    common.write_json(folder / "textures.json", summary(steps, arguments.adapter, size))
    plot(steps, arguments.adapter, size, folder / "textures.png")


def render(textures: dict[str, Any], adapter: str, size: Size) -> Step:
    """Renders the material with the textures `textures` three times: the reference, a second simulation, and the
    adapter. The three pictures have independent samples."""
    material = nma.load_material(MATERIAL).changed(CHANGES)
    layered, ours = (
        load_dict(
            nma.preview_scene(
                material_bsdf(material, model, adapter=adapter) | textures,
                size=(size.pixels, size.pixels),
                max_depth=DEPTH,
                lighting="outdoors",
            )
        )
        for model in ("layered", "nma")
    )
    truth = render_passes(layered, size.reference_spp, seed=1)
    again = render_passes(layered, size.spp, seed=2)
    test = render_passes(ours, size.spp, seed=3)
    return Step(truth, test, nma.compare_images(test, truth), nma.compare_images(again, truth))


def summary(steps: dict[str, Step], adapter: str, size: Size) -> dict:
    def rounded(metrics: dict[str, float]) -> dict[str, float]:
        return {name: round(value, 6) for name, value in metrics.items()}

    return {
        "adapter": Path(adapter).stem,
        **size._asdict(),
        "steps": {
            label: {"adapter": rounded(step.metrics), "noise_alone": rounded(step.noise)}
            for label, step in steps.items()
        },
    }


def plot(steps: dict[str, Step], adapter: str, size: Size, path: Path) -> None:
    """Draws a column for each step: reference, adapter, and the FLIP between them. Draws a table of metrics below the
    pictures."""
    made = list(steps.values())
    differences = [difference_image(s.adapter, s.reference, kind="flip", scale=FLIP_SCALE) for s in made]
    rows = [
        Row(f"Reference: layered, {size.reference_spp} spp", [s.reference for s in made]),
        Row(f"Adapter: nma, {Path(adapter).stem}, {size.spp} spp", [s.adapter for s in made]),
        Row(f"FLIP, black 0 to yellow {FLIP_SCALE:g}", differences),
    ]
    table: list[tuple[str, ...]] = [("of noise alone in brackets", *TABLED)]
    for label, step in steps.items():
        table.append((label, *(f"{step.metrics[m]:.4f} ({step.noise[m]:.4f})" for m in TABLED)))
    contact_sheet(path, rows, list(steps), table=table)


if __name__ == "__main__":
    main()
