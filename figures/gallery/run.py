"""Pictures of the named materials in the preview scene, and the noise of pictures in the scene's two lightings.

    python -m figures.gallery.run [--quick] [--adapter FILE]

Writes three files beside this script:

gallery.png   every named material, and a material with textures
lighting.png  six materials in both lightings
gallery.json  the noise of pictures with 128 samples per pixel, for each entry of WAYS

With --quick, renders small pictures of two materials with few samples, and writes to out/figures/gallery.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

import nma
import nma.render
from figures import common
from nma import materials
from nma.adapter import DEFAULT_ADAPTER
from nma.images.metrics import errors
from nma.images.sheet import PAPER, Row, contact_sheet
from nma.render.demo import worn_silver
from nma.render.fireflies import clamped
from nma.render.load import load_dict, material_bsdf
from nma.render.progressive import render_passes, sampler

Image = NDArray[np.float32]
COLUMNS = 5
# Six materials of different appearance: two smooth coats on metal, two paints, a dark metal, and a metal under a rough
# coat.
SIX = (
    "gold-red-lacquer",
    "wet-nickel",
    "car-paint-blue",
    "candy-apple-red",
    "smoked-chrome",
    "frosted-silver",
)
CLAMP = 5.0
# A firefly is a pixel whose brightness is more than FIREFLY times the median of its neighbourhood, and exceeds this
# median by more than VISIBLE.
FIREFLY, VISIBLE = 5.0, 0.02


class Effort(NamedTuple):
    """Width of the square pictures in pixels, and samples per pixel.

    `size` and `spp` are for the two sheets of pictures. `noise_size` and `noise_spp` are for the pictures whose noise
    is measured, and `reference_spp` is for the converged pictures that the noisy pictures are compared with.
    """

    size: int = 208
    spp: int = 256
    noise_size: int = 128
    noise_spp: int = 128
    reference_spp: int = 1024


class Way(NamedTuple):
    """One way to render a picture: the lighting, the sampler, and the value at which samples are clamped, if any."""

    lighting: str
    sampler: str
    clamp: float | None = None


WAYS = {
    "before": Way("outdoors", "independent"),
    "outdoors": Way("outdoors", "multijitter"),
    "outdoors, clamped": Way("outdoors", "multijitter", CLAMP),
    "studio": Way("studio", "multijitter"),
    "studio, clamped": Way("studio", "multijitter", CLAMP),
}


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--adapter", default=DEFAULT_ADAPTER, help="a weights file or a shipped name")
    arguments = parser.parse_args()
    effort = Effort(32, 16, 32, 16, 64) if arguments.quick else Effort()
    nma.render.use()
    folder = common.results(__file__, arguments.quick)
    names = materials.names()[:2] if arguments.quick else materials.names()
    shown = {materials.load(name).title: named(name, arguments.adapter) for name in names}
    shown["Silver under worn lacquer, textured"] = textured(arguments.adapter)
    gallery(shown, effort, folder / "gallery.png")
    six = {name: named(name, arguments.adapter) for name in (names if arguments.quick else SIX)}
    lightings(six, effort, folder / "lighting.png")
    found = {name: noise(name, bsdf, effort) for name, bsdf in six.items()}
    about = {"adapter": Path(arguments.adapter).stem, **effort._asdict(), "clamp": CLAMP}
    common.write_json(folder / "gallery.json", about | {"materials": found})


def named(name: str, adapter: str) -> dict[str, Any]:
    return material_bsdf(materials.load(name), "nma", adapter=adapter)


def textured(adapter: str) -> dict[str, Any]:
    silver, images = worn_silver()
    return material_bsdf(silver, "nma", adapter=adapter) | images


def render(bsdf: dict[str, Any], size: int, spp: int, way: Way, seed: int = 0) -> Image:
    """Renders a picture (size, size, 3) of the shader ball with the BSDF `bsdf`."""
    options: dict[str, Any] = {"size": (size, size), "lighting": way.lighting, "sampler": way.sampler}
    scene = load_dict(nma.preview_scene(bsdf, **options))
    integrator = clamped(scene.integrator(), way.clamp) if way.clamp else None
    return render_passes(scene, spp, seed=seed, integrator=integrator)


def gallery(shown: dict[str, dict[str, Any]], effort: Effort, path: Path) -> None:
    """Writes a sheet with one picture of each BSDF, in rows of COLUMNS pictures."""
    size, spp = effort.size, effort.spp
    way = Way("studio", sampler(spp, size * size))
    pictures: list[NDArray] = [render(bsdf, size, spp, way) for bsdf in shown.values()]
    titles = list(shown)
    while len(pictures) % COLUMNS:
        pictures.append(np.full((size, size, 3), PAPER, np.uint8))
        titles.append("")
    rows = [
        Row("", pictures[n : n + COLUMNS], [wrapped(title) for title in titles[n : n + COLUMNS]])
        for n in range(0, len(pictures), COLUMNS)
    ]
    contact_sheet(path, rows, [""] * COLUMNS)
    print(path)


def wrapped(title: str, width: int = 28) -> str:
    """Splits a title of more than `width` characters into two lines, at a space."""
    if len(title) <= width:
        return title
    cut = title.rindex(" ", 0, width)
    return f"{title[:cut]}\n{title[cut + 1 :]}"


def lightings(six: dict[str, dict[str, Any]], effort: Effort, path: Path) -> None:
    """Writes a sheet with the six materials: outdoors in the upper row, in the studio in the lower row."""
    size, spp = effort.size, effort.spp
    kind = sampler(spp, size * size)
    rows = [
        Row(label, [render(bsdf, size, spp, Way(lighting, kind)) for bsdf in six.values()])
        for label, lighting in (("--lighting outdoors", "outdoors"), ("--lighting studio", "studio"))
    ]
    contact_sheet(path, rows, list(six))
    print(path)


def noise(name: str, bsdf: dict[str, Any], effort: Effort) -> dict[str, dict[str, float]]:
    """Returns for each entry of WAYS: relative RMSE, number of fireflies, processor seconds, and brightness relative to
    the converged picture."""
    lightings = dict.fromkeys(way.lighting for way in WAYS.values())
    references = {
        lighting: render(bsdf, effort.noise_size, effort.reference_spp, Way(lighting, "multijitter"), seed=1)
        for lighting in lightings
    }
    found = {}
    for label, way in WAYS.items():
        converged = references[way.lighting]
        # This first rendering compiles the kernels, so that the time measured below excludes compilation.
        render(bsdf, effort.noise_size, 1, way)
        began = time.process_time()
        picture = render(bsdf, effort.noise_size, effort.noise_spp, way, seed=2)
        found[label] = {
            "relative_rmse": round(float(np.sqrt(errors(picture, converged)["mrse"])), 4),
            "fireflies": int((fireflies(picture) & ~fireflies(converged)).sum()),
            "processor_seconds": round(time.process_time() - began, 2),
            "brightness": round(float(picture.mean() / converged.mean()), 4),
        }
        print(f"{name}, {label}: {found[label]}", flush=True)
    return found


def fireflies(image: Image) -> NDArray[np.bool_]:
    """Marks the pixels (height, width) that are much brighter than the median of their 3 x 3 neighbourhood."""
    brightness = np.pad(image.mean(axis=2), 1, mode="edge")
    around = np.median(sliding_window_view(brightness, (3, 3)), axis=(2, 3))
    return brightness[1:-1, 1:-1] > np.maximum(FIREFLY * around, around + VISIBLE)


if __name__ == "__main__":
    main()
