"""Paper Fig. 5: fits with different points in a bin (the centre, 1 to 20 uniform points, or 8 crowded points).

    python -m figures.supervision.run [--quick]

Training compares the bin's value in a table with the mean of the target over one or more points in the bin. The
experiment fits a 3x32 network, whose only input is the view direction, to a smooth conductor and to a layered material.
All fits to one material use the same table, steps and learning rate. In all columns except the last, the fits differ
only in the points. These fits use the paper's loss, and a target with the paper's parameters that is also bounded, so
that it reflects no more light than it receives. The fit in the last column uses the settings of `nma fit`, except for
the number of steps and the schedule of the learning rate. Every fit is compared with an independent table and rendered.

Writes supervision.json and supervision.png beside this file. With --quick, makes three short fits and writes to
out/figures/supervision.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import nma
import nma.render
from figures import common
from nma.images.sheet import Row, contact_sheet
from nma.materials import Material
from nma.render.load import load_dict, material_bsdf
from nma.render.progressive import render_passes
from nma.table import stream_keys
from nma.train.recipe import Recipe, preset
from nma.train.run import fit_material

# The paper's conductor has no coat. Materials of our class always have a coat, so our conductor has a smooth coat whose
# index of refraction is close to 1.
BARE = {"alpha_top": 0.001, "alpha_bottom": 0.01, "eta_top": 1.05, "albedo": 1.0, "sigma_t": 0.0}
LAYERED = "gold-red-lacquer"
PAPER = {"loss": "log", "energy": 0.0, "albedo": 0.0, "target": "principled", "bins_law": "uniform"}
REFERENCE_KEY = 999


class Effort(NamedTuple):
    """The effort of the experiment: training steps, walks, size of the pictures in pixels, and samples per pixel."""

    steps: int = 3000
    walks: int = 32_000_000
    reference_walks: int = 64_000_000
    size: int = 144
    spp: int = 128
    reference_spp: int = 512


QUICK = Effort(200, 2_000_000, 4_000_000, 144, 32, 64)


def main() -> None:
    arguments = common.parser(__doc__).parse_args()
    folder = common.results(__file__, arguments.quick)
    effort = QUICK if arguments.quick else Effort()
    nma.render.use()
    laws = recipes(effort.steps, arguments.quick)
    results, rows = {}, []
    for material in materials()[: 1 if arguments.quick else None]:
        results[material.name], row = compare(material, laws, effort)
        rows.append(row)
    common.write_json(folder / "supervision.json", results)
    path = folder / "supervision.png"
    contact_sheet(path, rows, ["reference", *laws], title="What stands for a bin", note=note(effort))
    print(path)


def recipes(steps: int, quick: bool) -> dict[str, Recipe]:
    """Returns the recipe of each column of the picture sheet, by name."""
    equal = {"steps": steps, "schedule": "onecycle"}
    laws = {"centre": preset("single", **PAPER, **equal, points_law="centre", points=1)}
    for points in (8,) if quick else (1, 2, 4, 8, 20):
        laws[f"uniform, {points}"] = preset("single", **PAPER, **equal, points_law="uniform", points=points)
    laws["crowded, 8"] = preset("single", **PAPER, **equal, points_law="crowded", points=8)
    if not quick:
        laws["all of ours"] = preset("single", **equal)
    return laws


def materials() -> list[Material]:
    """Returns the smooth conductor and the layered material."""
    layered = nma.load_material(LAYERED)
    smooth = layered.changed(BARE | {"conductor": "Au"})
    title = f"Gold of alpha {BARE['alpha_bottom']} under a coat that hardly shows"
    return [Material("smooth-gold", title, "", smooth.class_name, smooth.values), layered]


def compare(material: Material, laws: dict[str, Recipe], effort: Effort) -> tuple[dict[str, dict], Row]:
    """Fits one material with each recipe. Returns the metrics of each fit, and a row of the picture sheet."""
    source, params = nma.source(material.class_name), material.vector()[None]
    tables = nma.tabulate(source, params, effort.walks, stream_keys(0, [0]), error=False)
    truth = nma.tabulate(source, params, effort.reference_walks, stream_keys(REFERENCE_KEY, [0]))
    picture = render(material_bsdf(material, "layered"), effort, effort.reference_spp)
    figures, pictures, captions = {}, [picture], [""]
    for law, recipe in laws.items():
        adapter, run = fit_material(source.space, recipe, params, tables, {"data": material.name})
        found = nma.evaluate_adapter(adapter, truth).mean
        pictures.append(render_adapter(material, adapter, effort))
        figures[law] = {
            "log_loss": round(found["log_loss"], 6),
            "albedo_error": round(found["albedo_error"], 5),
            "noise_floor": round(found["noise_floor"], 6),
            "flip_ldr": round(nma.compare_images(pictures[-1], picture)["flip_ldr"], 5),
            "seconds": round(run.seconds, 1),
        }
        captions.append(caption(figures[law]))
        print(f"{material.name:18} {law:12} {figures[law]}", flush=True)
    captions[0] = f"noise of the table\nlog loss {found['noise_floor']:.4f}"
    return figures, Row(material.title, pictures, captions)


def render_adapter(material: Material, adapter: nma.Adapter, effort: Effort) -> NDArray[np.float32]:
    """Renders the shader ball with the BSDF `nma`, which reads the adapter from a temporary file."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "fit.safetensors"
        adapter.save(path)
        return render(material_bsdf(material, "nma", adapter=path), effort, effort.spp)


def render(bsdf: dict, effort: Effort, spp: int) -> NDArray[np.float32]:
    """Renders a picture (size, size, 3) of the preview scene outdoors with the BSDF `bsdf`."""
    scene = nma.preview_scene(bsdf, size=(effort.size, effort.size), lighting="outdoors")
    return render_passes(load_dict(scene), spp)


def caption(figures: dict[str, float]) -> str:
    return "log loss {log_loss:.4f}\nalbedo off {albedo_error:.4f}\nFLIP {flip_ldr:.4f}".format(**figures)


def note(effort: Effort) -> str:
    """Returns the note below the pictures, which says how the fits and the pictures were made."""
    return (
        f"Every fit: {effort.steps} steps on one table of {effort.walks / 1e6:.0f} M walks. Log loss and albedo error "
        f"against another table of {effort.reference_walks / 1e6:.0f} M walks.\n"
        f"Rendered at {effort.spp} samples per pixel, the reference by simulation at {effort.reference_spp}; "
        "LDR-FLIP includes the noise of both."
    )


if __name__ == "__main__":
    main()
