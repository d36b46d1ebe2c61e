"""The demonstration: pictures of the reference, of the adapter and of their difference, for a material without textures
and a material with textures, and a table of times and errors."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma import materials
from nma.adapter import DEFAULT_ADAPTER
from nma.images.metrics import difference_image, errors, flip_map
from nma.images.sheet import Row, contact_sheet
from nma.materials import Material
from nma.render.load import load_dict, material_bsdf
from nma.render.progressive import render_passes, sampler
from nma.render.scene import preview_scene
from nma.render.statistics import Measurement, measure, render_seconds
from nma.render.textures import bitmap_texture, procedural_textures

HEADINGS = ("material", "BSDF", "time", "compile", "variance", "HDR-FLIP", "SMAPE", "efficiency")
DEPTH = 6
TEXTURE_SCALE = 2.0
STAND_IN_RUNS = 2  # how often `principled` is rendered; only its time is reported
FIRST_SPP = 16  # samples per pixel of the first pictures, which come before the measurements
# FLIP errors from FLIP_SCALE upwards are shown in the brightest colour of the difference picture.
FLIP_SCALE = 0.5
Progress = Callable[[str, int], None]


class Settings(NamedTuple):
    """Settings of the demonstration.

    `size`: width and height of a picture. `spp`: samples per pixel of a measured frame. `runs`: measured frames per
    BSDF. `reference_spp`: samples per pixel of the references. `adapter`: the name of a shipped adapter, or a
    weights file.
    """

    size: tuple[int, int] = (256, 256)
    spp: int = 64
    runs: int = 2
    reference_spp: int = 144
    adapter: str = DEFAULT_ADAPTER

    @property
    def first_spp(self) -> int:
        """Samples per pixel of the first pictures."""
        return min(self.spp, FIRST_SPP)


class Scene(NamedTuple):
    """A scene of the demonstration: the material's name, the label of its pictures, and a Mitsuba dictionary for each
    BSDF name."""

    material: str
    label: str
    bsdfs: dict[str, dict[str, Any]]


class Frame(NamedTuple):
    """A picture (height, width, 3), and the time in seconds that its rendering took, including compilation."""

    image: NDArray[np.float64]
    seconds: float


class Line(NamedTuple):
    """One line of the table: a BSDF in one of the scenes.

    `errors`: the errors of the mean picture of all runs; empty for `principled`.
    """

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
    path: str | Path,
    settings: Settings,
    progress: Progress = lambda what, samples: None,
    published: Callable[[str], None] = lambda shown: None,
) -> list[Line]:
    """Render the demonstration and write its contact sheet: first with few samples, then again after each scene is
    measured.

    Args:
        path: the PNG file of the contact sheet, written atomically each time.
        progress: called after each frame or pass with the name of the picture and the samples per pixel of this frame
            or pass.
        published: called each time the PNG has been written, with a description of its new content.

    Returns:
        The lines of the table: `principled`, `layered` and `nma` for each scene.
    """
    rows: dict[str, Row] = {}
    lines: list[Line] = []

    def publish(material: str, row: Row, shown: str) -> None:
        rows[material] = row
        _write(path, list(rows.values()), lines, settings)
        published(shown)

    scenes, first = _scenes(settings.adapter), {}
    for scene in scenes:
        first[scene.material] = _first_frames(scene, settings, progress)
        publish(
            scene.material,
            _early_row(scene, first[scene.material], settings),
            f"{scene.material}, first pictures",
        )
    for scene in scenes:
        truth, added = _measured(scene, first[scene.material], settings, progress)
        lines += added
        publish(
            scene.material,
            _row(scene.label, truth, added[1], added[2], settings),
            f"{scene.material}, with figures",
        )
    return lines


def total_samples(settings: Settings) -> int:
    """The samples per pixel that `demo` reports to `progress` in total."""
    frames = 2 * settings.runs + STAND_IN_RUNS
    return 2 * (3 * settings.first_spp + frames * settings.spp + settings.reference_spp)


def note(settings: Settings) -> str:
    """The text under the table, which explains the table's columns and names the machine of the measurements."""
    import mitsuba as mi

    width, height = settings.size
    samples = settings.spp * settings.runs
    return (
        f"Time and variance: one frame of {width} x {height} pixels, {settings.spp} spp, path depth {DEPTH};\n"
        f"median and variance of {settings.runs} seeds. Efficiency: 1 / (variance x time).\n"
        f"Errors: mean of these frames ({samples} spp) against a reference of {settings.reference_spp} spp; "
        "that of `layered` is only noise.\n"
        f"`principled`, with equal textures, is there to compare times. FLIP: black 0 to yellow {FLIP_SCALE:g}.\n"
        f"Mitsuba {mi.__version__}, {mi.variant()}, {os.cpu_count()} CPU cores; adapter {Path(settings.adapter).stem}."
    )


def _scenes(adapter: str) -> list[Scene]:
    """Two materials, each as `layered`, as `nma`, and as a roughly similar `principled` to compare times."""
    gold = materials.load("gold-red-lacquer")
    plain = {"type": "principled", "metallic": 1.0, "roughness": 0.35}
    plain["base_color"] = {"type": "rgb", "value": list(gold.values["albedo"])}  # type: ignore[arg-type]

    worn, images = worn_silver()
    names = {"base_color": "albedo", "roughness": "alpha_bottom", "metallic": "sigma_t"}
    textured = {"type": "principled"} | {name: images[ours] for name, ours in names.items()}
    title = "Silver under worn lacquer: its roughness, the pigment and its amount come from textures"
    return [
        Scene("plain", gold.title, _bsdfs(plain, gold, {}, adapter)),
        Scene("textured", title, _bsdfs(textured, worn, images, adapter)),
    ]


def worn_silver() -> tuple[Material, dict[str, Any]]:
    """Silver under worn lacquer, and Mitsuba's textures for some of its parameters."""
    material = materials.load("frosted-silver").changed({"alpha_top": 0.02, "eta_top": 1.5})
    textures = procedural_textures(512).items()
    return material, {name: bitmap_texture(values, scale=TEXTURE_SCALE) for name, values in textures}


def _bsdfs(
    principled: dict[str, Any], material: Material, textures: dict[str, Any], adapter: str
) -> dict[str, dict[str, Any]]:
    return {
        "principled": principled,
        "layered": material_bsdf(material, "layered") | textures,
        "nma": material_bsdf(material, "nma", adapter=adapter) | textures,
    }


def _load(bsdf: dict[str, Any], settings: Settings) -> Any:
    options: Any = {"size": settings.size, "max_depth": DEPTH, "sampler": sampler(settings.spp, 1)}
    return load_dict(preview_scene(bsdf, **options))


def _first_frames(scene: Scene, settings: Settings, progress: Progress) -> dict[str, Frame]:
    """Renders a frame of few samples for each BSDF, as a first picture and to measure the time with compilation."""
    frames = {}
    for name, bsdf in scene.bsdfs.items():
        frames[name] = Frame(*render_seconds(_load(bsdf, settings), settings.first_spp, settings.runs))
        progress(f"{scene.material}, {name}", settings.first_spp)
    return frames


def _measured(
    scene: Scene, first: dict[str, Frame], settings: Settings, progress: Progress
) -> tuple[NDArray[np.float32], list[Line]]:
    """Returns the reference picture, rendered with other random seeds than the measured frames, and the table's line
    for each BSDF."""
    truth = render_passes(
        _load(scene.bsdfs["layered"], settings),
        settings.reference_spp,
        seed=1,
        progress=partial(progress, f"{scene.material}, converged"),
    )
    lines = []
    for name, bsdf in scene.bsdfs.items():
        runs = STAND_IN_RUNS if name == "principled" else settings.runs
        step = partial(progress, f"{scene.material}, {name}", settings.spp)
        found = measure(_load(bsdf, settings), settings.spp, runs, warmup=False, progress=step)
        rendering = found.seconds * settings.first_spp / settings.spp
        found = found._replace(compile_seconds=max(first[name].seconds - rendering, 0.0))
        lines.append(
            Line(scene.material, name, found, {} if name == "principled" else _errors(found.mean, truth))
        )
    return truth, lines


def _errors(test: NDArray[np.float64], truth: NDArray[np.float32]) -> dict[str, float]:
    flip = {f"flip_{kind}": float(flip_map(test, truth, hdr=kind == "hdr").mean()) for kind in ("hdr", "ldr")}
    return flip | errors(test, truth)


def _write(path: str | Path, rows: list[Row], lines: list[Line], settings: Settings) -> None:
    columns = ("reference: layered", "adapter: nma", "difference: FLIP")
    title = "Layered materials, simulated and by their adapter"
    table = [HEADINGS, *(line.cells() for line in lines)] if lines else []
    contact_sheet(path, rows, columns, title=title, table=table, note=note(settings))


def _early_row(scene: Scene, frames: dict[str, Frame], settings: Settings) -> Row:
    """The contact sheet's row for a scene, with the scene's first pictures, before anything is measured."""
    truth, adapter = (frames[name].image.astype(np.float32) for name in ("layered", "nma"))
    text = f"{settings.first_spp} spp, figures follow"
    return Row(scene.label, [truth, adapter, _difference(adapter, truth)], [text, text])


def _row(label: str, truth: NDArray[np.float32], reference: Line, adapter: Line, settings: Settings) -> Row:
    """The contact sheet's row for a scene, with time, variance and error under the pictures."""
    captions = [_caption(line, settings) for line in (reference, adapter)]
    captions.append(
        f"mean {adapter.errors['flip_ldr']:.4f}, of noise alone {reference.errors['flip_ldr']:.4f}"
    )
    mean = adapter.measured.mean
    return Row(label, [truth, mean, _difference(mean, truth)], captions)


def _difference(test: NDArray, truth: NDArray) -> NDArray[np.uint8]:
    return difference_image(test, truth, kind="flip", scale=FLIP_SCALE)


def _caption(line: Line, settings: Settings) -> str:
    m, errors = line.measured, line.errors
    return (
        f"{settings.spp} spp: {m.seconds:.2f} s, variance {m.mean_variance:.1e}\n"
        f"HDR-FLIP {errors['flip_hdr']:.4f}, SMAPE {errors['smape']:.4f}"
    )
