"""The demonstration: reference, adapter and their difference, without and with textures, and what each costs."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma import materials
from nma.contact_sheet import Row, contact_sheet
from nma.image_metrics import compare_images, difference_image
from nma.materials import Material
from nma.render.load import DEFAULT_ADAPTER, load_dict, material_bsdf
from nma.render.measure import Measurement, measure
from nma.render.progressive import render_passes
from nma.render.scene import bitmap_texture, preview_scene
from nma.render.textures import procedural_textures

HEADINGS = ("material", "BSDF", "time", "compile", "variance", "HDR-FLIP", "SMAPE", "efficiency")
DEPTH = 6
TEXTURE_SCALE = 2.0
STAND_IN_RUNS = 2  # of `principled`, which is only timed
# FLIP that takes the last colour of the difference picture.
FLIP_SCALE = 0.5


class Settings(NamedTuple):
    """How large and how long: `spp` of each measured frame, `runs` frames a BSDF, `reference_spp` of the references."""

    size: tuple[int, int] = (256, 256)
    spp: int = 64
    runs: int = 3
    reference_spp: int = 512
    adapter: str = DEFAULT_ADAPTER


class Line(NamedTuple):
    """One line of the table: a BSDF in one of the scenes. `errors` of its mean over the runs; empty for a stand-in."""

    material: str
    bsdf: str
    measured: Measurement
    errors: dict[str, float]

    def cells(self) -> tuple[str, ...]:
        m = self.measured
        figures = [f"{self.errors[name]:.4f}" if self.errors else "-" for name in ("flip_hdr", "smape")]
        times = f"{m.seconds:.2f} s", f"{m.compile_seconds:.1f} s"
        noise = (f"{m.mean_variance:.1e}", *figures, f"{m.efficiency:.3g}")
        return (self.material, self.bsdf, *times, *(noise if self.errors else ("-",) * 4))


def demo(
    path: str | Path, settings: Settings, progress: Callable[[str, int], None] = lambda what, samples: None
) -> list[Line]:
    """Render the demonstration and write its sheet.

    Args:
        path: the PNG.
        progress: called with what is being rendered, and the samples per pixel just done.

    Returns:
        The lines of the table, three for each scene: `principled`, `layered`, `nma`.
    """
    lines, rows = [], []
    for material, label, bsdfs in _scenes(settings.adapter):
        measured = {}
        for name, bsdf in bsdfs.items():
            runs = STAND_IN_RUNS if name == "principled" else settings.runs
            measured[name] = _measure(bsdf, settings, runs, partial(progress, f"{material}, {name}"))
        truth = _converged(bsdfs["layered"], settings, partial(progress, f"{material}, converged"))
        added = [
            Line(material, name, m, {} if name == "principled" else compare_images(m.mean, truth))
            for name, m in measured.items()
        ]
        rows.append(_row(label, truth, added[1], added[2], settings))
        lines += added
    table = [HEADINGS, *(line.cells() for line in lines)]
    columns = ("reference: layered", "adapter: nma", "difference: FLIP")
    title = "Layered materials, simulated and by their adapter"
    contact_sheet(path, rows, columns, title=title, table=table, note=note(settings))
    return lines


def total_samples(settings: Settings) -> int:
    """Samples per pixel that `demo` reports to `progress` in total."""
    frames = 2 * (settings.runs + 1) + STAND_IN_RUNS + 1
    return 2 * (frames * settings.spp + settings.reference_spp)


def note(settings: Settings) -> str:
    """What the figures mean, and on what they were measured."""
    import mitsuba as mi

    width, height = settings.size
    samples = settings.spp * settings.runs
    return (
        f"Time and variance: one frame of {width} x {height} pixels, {settings.spp} spp, path depth {DEPTH};\n"
        f"median and variance of {settings.runs} seeds. Efficiency: 1 / (variance x time).\n"
        f"Errors: mean of these frames ({samples} spp) against a reference of {settings.reference_spp} spp; "
        "`layered` has noise alone.\n"
        f"`principled` is a stand-in for its time, textured alike. FLIP: black 0 to yellow {FLIP_SCALE:g}.\n"
        f"Mitsuba {mi.__version__}, {mi.variant()}, {os.cpu_count()} CPU cores; adapter {Path(settings.adapter).stem}."
    )


def _scenes(adapter: str) -> list[tuple[str, str, dict[str, dict[str, Any]]]]:
    """Two materials with a name and a label, each as `principled` (a stand-in), `layered` and `nma`."""
    gold = materials.load("gold-red-lacquer")
    plain = {"type": "principled", "metallic": 1.0, "roughness": 0.35}
    plain["base_color"] = {"type": "rgb", "value": list(gold.values["albedo"])}  # type: ignore[arg-type]

    worn = materials.load("frosted-silver").changed({"alpha_top": 0.02, "eta_top": 1.5})
    images = {n: bitmap_texture(t, scale=TEXTURE_SCALE) for n, t in procedural_textures(512).items()}
    names = {"base_color": "albedo", "roughness": "alpha_bottom", "metallic": "sigma_t"}
    textured = {"type": "principled"} | {name: images[ours] for name, ours in names.items()}
    return [
        ("plain", gold.title, _bsdfs(plain, gold, {}, adapter)),
        (
            "textured",
            "Silver under worn lacquer: its roughness, the pigment and its amount come from textures",
            _bsdfs(textured, worn, images, adapter),
        ),
    ]


def _bsdfs(
    principled: dict[str, Any], material: Material, textures: dict[str, Any], adapter: str
) -> dict[str, dict[str, Any]]:
    return {
        "principled": principled,
        "layered": material_bsdf(material, "layered") | textures,
        "nma": material_bsdf(material, "nma", adapter=adapter) | textures,
    }


def _measure(
    bsdf: dict[str, Any], settings: Settings, runs: int, progress: Callable[[int], None]
) -> Measurement:
    scene = load_dict(preview_scene(bsdf, size=settings.size, max_depth=DEPTH))
    return measure(scene, settings.spp, runs, progress=lambda: progress(settings.spp))


def _converged(
    bsdf: dict[str, Any], settings: Settings, progress: Callable[[int], None]
) -> NDArray[np.float32]:
    """The reference, from samples of its own."""
    scene = load_dict(preview_scene(bsdf, size=settings.size, max_depth=DEPTH))
    return render_passes(scene, settings.reference_spp, seed=1, progress=progress)


def _row(label: str, truth: NDArray[np.float32], reference: Line, adapter: Line, settings: Settings) -> Row:
    """The pictures of one scene, with time, variance and error under them."""
    difference = difference_image(adapter.measured.mean, truth, kind="flip", scale=FLIP_SCALE)
    captions = [_caption(line, settings) for line in (reference, adapter)]
    captions.append(
        f"mean {adapter.errors['flip_ldr']:.4f}, of noise alone {reference.errors['flip_ldr']:.4f}"
    )
    return Row(label, [truth, adapter.measured.mean, difference], captions)


def _caption(line: Line, settings: Settings) -> str:
    m, errors = line.measured, line.errors
    return (
        f"{settings.spp} spp: {m.seconds:.2f} s, variance {m.mean_variance:.1e}\n"
        f"HDR-FLIP {errors['flip_hdr']:.4f}, SMAPE {errors['smape']:.4f}"
    )
