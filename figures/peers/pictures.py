"""Renders materials with the peers: the worst ones of each peer for a sheet, and the first ones for their FLIP."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import nma
import nma.render
from figures import common, studio
from figures.peers import constant
from nma import target
from nma.adapter import DEFAULT_ADAPTER
from nma.images.metrics import compare_images
from nma.images.sheet import Row, contact_sheet
from nma.ops import Color, select
from nma.render import values_bsdf
from nma.render.load import material_bsdf
from nma.target import Blend, Principled

SIMULATED, AGAIN = "simulated", "simulated again"
WORST = 3
SIZE, SPP, REFERENCE_SPP = 128, 256, 512
QUICK_SIZE, QUICK_SPP = 32, 4
# For FLIP: how many materials of a set, and the size of their pictures.
FLIP_MATERIALS, FLIP_SIZE = 20, 64
SAMPLER = "multijitter"

Models = dict[str, Callable[[Any], Any] | None]
Rows = dict[str, list[dict[str, Any]]]


def write(
    models: Models, references: dict[str, nma.Tables], materials: Rows, path: Path, quick: bool
) -> None:
    """Writes a sheet with a row per material.

    Args:
        models: for each peer, a function that makes its source from a material's parameters; None for the fits.
        references: the tables of each set.
        materials: the metrics of each model and material of each set.
        path: the PNG file.
        quick: whether to render a single material, with few samples.
    """
    _register()
    columns = [SIMULATED, *models, DEFAULT_ADAPTER]

    def picture(label: str, name: str, number: int) -> NDArray[np.float32]:
        bsdf = _bsdf(label, models, name, references[name], number, quick)
        spp = REFERENCE_SPP if label == SIMULATED else SPP
        print(f"rendering {name} {number}, {label}", flush=True)
        return studio.render(bsdf, QUICK_SIZE if quick else SIZE, QUICK_SPP if quick else spp, seed=1)

    rows = []
    for (name, number), title in list(_chosen(list(models), materials).items())[: 1 if quick else None]:
        images = [picture(label, name, number) for label in columns]
        captions = [_caption(references[name].params[number])]
        for label, image in zip(columns[1:], images[1:], strict=True):
            loss = materials[name][number][label]["log_loss"]
            captions.append(
                f"log loss {loss:.4f}\nHDR-FLIP {compare_images(image, images[0])['flip_hdr']:.3f}"
            )
        rows.append(Row(f"{title} ({name} {number})", images, captions))
    contact_sheet(
        path, rows, columns, title="Where each peer is worst, and where it is closest to the adapter"
    )
    print(path)


def flips(models: Models, name: str, tables: nma.Tables, quick: bool) -> dict[str, list[float]]:
    """Returns the HDR-FLIP of pictures of the first materials of a set, for each peer and adapter.

    The pictures of AGAIN are a second simulation, whose error is only noise. The results of finished materials are kept
    in out/figures/peers.
    """
    _register()
    labels = [AGAIN, *models, *nma.shipped()]
    size, count = (QUICK_SIZE, 1) if quick else (FLIP_SIZE, FLIP_MATERIALS)

    def measure(number: int) -> list[float]:
        def picture(label: str, spp: int, seed: int) -> NDArray[np.float32]:
            bsdf = _bsdf(label, models, name, tables, number, quick)
            return studio.render(bsdf, size, QUICK_SPP if quick else spp, seed, SAMPLER)

        truth = picture(SIMULATED, 2 * REFERENCE_SPP, 1)
        errors = [compare_images(picture(label, SPP, 2), truth)["flip_hdr"] for label in labels]
        print(
            f"FLIP of {name} {number}:",
            dict(zip(labels, np.round(errors, 3).tolist(), strict=True)),
            flush=True,
        )
        return [round(float(x), 5) for x in errors]

    kept = common.ROOT / "out/figures/peers" / ("quick" if quick else "flips")
    kept.mkdir(parents=True, exist_ok=True)
    rows = [
        common.kept(kept / f"flip-{name}-{n}.json", partial(measure, n), quick)
        for n in range(min(count, len(tables.params)))
    ]
    return {label: [row[k] for row in rows] for k, label in enumerate(labels)}


def _chosen(labels: list[str], materials: Rows) -> dict[tuple[str, int], str]:
    """Returns sets and numbers with a title: each peer's worst materials, and the one closest to the adapter."""
    places = [(name, number) for name, rows in materials.items() for number in range(len(rows))]
    loss = {
        label: np.array([materials[name][number][label]["log_loss"] for name, number in places])
        for label in (*labels, DEFAULT_ADAPTER)
    }
    titles = []
    for label in labels:
        worst = np.argsort(loss[label])[::-1][:WORST]
        titles += [(n, f"worst {k + 1}: {label}") for k, n in enumerate(worst)]
    titles += [(np.argmin(loss[label] / loss[DEFAULT_ADAPTER]), f"closest: {label}") for label in labels]
    chosen: dict[tuple[str, int], str] = {}
    for n, title in titles:
        chosen[places[n]] = "; ".join(filter(None, (chosen.get(places[n]), title)))
    return chosen


def _caption(params: NDArray[np.float64]) -> str:
    return studio.describe(studio.material(0, params)).partition(": ")[2].replace(", eta", "\neta")


def _bsdf(
    label: str, models: Models, name: str, tables: nma.Tables, number: int, quick: bool
) -> dict[str, Any]:
    material = studio.material(number, tables.params[number])
    if label in (SIMULATED, AGAIN):
        return material_bsdf(material, "layered")
    if label in nma.shipped():
        return material_bsdf(material, "nma", adapter=label)
    if (make := models[label]) is None:
        return material_bsdf(material, "nma", adapter=constant.fitted(name, tables, number, quick)[1])
    return values_bsdf.bsdf_of(make(tables.params[number])) | {"type": "peer"}


def _register() -> None:
    """Registers the BSDF `peer`: a source in memory like the BSDF `values`, sampled by lobes of the source's widths.

    The lobes of `values` do not follow the source, and would leave sharp coats noisy.
    """
    import mitsuba as mi

    nma.render.use()

    class Peer(values_bsdf.define()):  # type: ignore[misc]
        def _draw(self, wi, u, active):
            wo, _, _ = target.sample(self._proposal(), wi, *u)
            value, pdf = self._eval_pdf(wi, wo, active)
            return wo, pdf, values_bsdf.over(value, pdf)

        def _eval_pdf(self, wi, wo, active):
            pdf = select(active, target.pdf(self._proposal(), wi, wo), 0.0)
            return select(pdf > 0, self.values.eval(wi, wo), Color.of(0.0)), pdf

        def _proposal(self) -> Blend:
            widths = self.values.widths
            lobes = [_lobe(1.0, 0.0), *(_lobe(alpha, 1.0) for alpha in widths)]
            return Blend(tuple(lobes), (1.0 / len(lobes),) * len(lobes))

    mi.register_bsdf("peer", Peer)


def _lobe(alpha: float, metallic: float) -> Principled:
    return Principled(Color.of(1.0), math.sqrt(alpha), metallic, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
