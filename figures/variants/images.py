"""Renders shader balls of the validation materials, stores the pictures, and compares adapters with the simulation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import nma
from figures import common, studio
from figures.variants.train import Job, Store
from nma.images.metrics import METRICS
from nma.images.sheet import Row, contact_sheet
from nma.materials import Material
from nma.render.load import material_bsdf

Images = NDArray[np.float32]
# Seeds for the pictures of the reference, of a second simulation (whose error is noise alone), and of the adapters.
REFERENCE_SEED, NOISE_SEED, ADAPTER_SEED = 1, 2, 3


class View(NamedTuple):
    """Settings for rendering the first `materials` materials of the validation set.

    Pictures have `size` x `size` pixels, with `spp` samples per pixel for adapters and `reference_spp` for the
    simulation.
    """

    materials: int = 89
    size: int = 128
    spp: int = 128
    reference_spp: int = 512


class Gallery:
    """Renders pictures (materials, height, width, 3) of the reference and of adapters, and stores the pictures in the
    store's folder."""

    def __init__(self, store: Store, view: View, validation: str):
        self._store, self._view, self._validation = store, view, validation
        rows = store.validation.params[: view.materials]
        self.materials = [studio.material(number, row) for number, row in enumerate(rows)]
        self.reference = self._simulated(view.reference_spp, REFERENCE_SEED)

    def noise(self) -> dict[str, float]:
        """Returns the metrics of a second simulation, with as many samples per pixel as the adapters.

        The second simulation differs from the reference only by noise, so its metrics show the effect of noise alone.
        """
        return compare(self._simulated(self._view.spp, NOISE_SEED), self.reference)

    def metrics(self, job: Job, adapter: nma.Adapter) -> dict[str, float]:
        """Returns the image metrics of an adapter, averaged over the materials."""
        settings = {"view": self._view._asdict(), "validation": self._validation}
        return self._store.cached(
            job, "images", settings, adapter, lambda: compare(self.pictures(job, adapter), self.reference)
        )

    def pictures(self, job: Job, adapter: nma.Adapter) -> Images:
        """Returns the adapter's pictures. Stored pictures that are older than the weights are rendered again."""
        weights = self._store.weights(job)

        def bsdf(material: Material) -> dict[str, Any]:
            return material_bsdf(material, "nma", adapter=weights)

        return self._kept(job.stem, bsdf, self._view.spp, ADAPTER_SEED, newer_than=weights)

    def shipped(self, name: str) -> dict[str, float]:
        """Returns the mean image metrics of a shipped adapter, which was trained on the same data for more steps."""
        pictures = self._kept(
            name, lambda m: material_bsdf(m, "nma", adapter=name), self._view.spp, ADAPTER_SEED
        )
        return compare(pictures, self.reference)

    def _simulated(self, spp: int, seed: int) -> Images:
        return self._kept("reference", lambda m: material_bsdf(m, "layered"), spp, seed)

    def _kept(
        self,
        name: str,
        bsdf: Callable[[Material], dict[str, Any]],
        spp: int,
        seed: int,
        newer_than: Path | None = None,
    ) -> Images:
        view = self._view
        words = f"{name}_{self._validation}_{view.materials}x{view.size}px_{spp}-spp_seed-{seed}.npy"
        path = self._store.folder / "pictures" / words
        if path.exists() and (newer_than is None or path.stat().st_mtime > newer_than.stat().st_mtime):
            return np.load(path)
        pictures = np.stack([studio.render(bsdf(m), view.size, spp, seed) for m in self.materials])
        common.save_array(path, pictures)
        print(f"{path.name}", flush=True)
        return pictures


def compare(pictures: Images, references: Images) -> dict[str, float]:
    """Returns all image metrics, averaged over the materials."""
    found = [nma.compare_images(a, b) for a, b in zip(pictures, references, strict=True)]
    return {name: round(float(np.mean([f[name] for f in found])), 7) for name in METRICS}


def sheet(gallery: Gallery, pictures: dict[str, Images], path: Path, rows: int = 4) -> None:
    """Writes a sheet like the paper's Fig. 6, with materials from the largest to the median error of the first
    variant."""
    flips = {
        name: [nma.compare_images(a, b)["flip_ldr"] for a, b in zip(images, gallery.reference, strict=True)]
        for name, images in pictures.items()
    }
    chosen = studio.worst_to_median(flips[next(iter(flips))], rows)
    lines = [
        Row(
            studio.describe(gallery.materials[m]),
            [gallery.reference[m], *(images[m] for images in pictures.values())],
            ["", *(f"FLIP {flip[m]:.4f}" for flip in flips.values())],
        )
        for m in chosen
    ]
    title, note = (
        "Variants on unseen materials",
        f"LDR-FLIP; rows by that of {next(iter(flips))}, worst first",
    )
    contact_sheet(path, lines, ["reference", *pictures], title=title, note=note)
