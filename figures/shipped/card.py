"""Writes the model cards of the shipped adapters. A card lists training, accuracy, worst materials and known limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import nma
import nma.render
from figures import common
from nma import network
from nma.evaluate.metrics import FIGURES
from nma.files import write_text
from nma.images.metrics import compare_images, difference_image
from nma.images.sheet import Row, contact_sheet
from nma.render.load import load_dict
from nma.render.progressive import render_passes

WORST = 10
ANGLES = ("theta_i", "theta_o")
LIMITS = """\
- The adapter was trained for the class `layered3` within the ranges of its training data. The adapter rejects
  parameters outside these ranges, or clamps parameters to the ranges on request.
- The target's parameters depend on the view direction, so the BRDF is not reciprocal. Light tracing and bidirectional
  methods converge to a picture that differs from path tracing, unless they
  [evaluate the network for the direction to the camera](../../docs/mitsuba.md#reciprocity).
- The reflection is isotropic, and its lobes have the shapes of the Principled BRDF. The adapter has errors where a
  material's lobes have other shapes, as in the worst materials above.
"""


def write(
    weights: str, sets: dict[str, tuple[nma.Tables, dict]], named: dict[str, dict], folder: Path, quick: bool
) -> Path:
    """Writes the model card of one adapter with its pictures, and returns the card's path.

    Args:
        weights: a weights file or a shipped name.
        sets: the reference tables and the results of each set of materials, by the set's name.
        named: the signed errors of brightness of each named material, by its name.
        quick: whether to render fewer pictures, with fewer samples per pixel.
    """
    adapter, name = nma.Adapter.load(weights), Path(weights).stem
    _histogram(sets, folder / f"{name}-errors.png")
    captions = _worst(weights, sets, folder / f"{name}-worst.png", quick)
    card = folder / f"{name}.md"
    write_text(card, _text(name, adapter, sets, named, captions))
    return card


def _text(
    name: str,
    adapter: nma.Adapter,
    sets: dict[str, tuple[nma.Tables, dict]],
    named: dict[str, dict],
    worst: list[str],
) -> str:
    record, count = adapter.training, network.parameters(adapter.layers)
    data, recipe = record["dataset"], record["recipe"]
    bound = "bounded" if adapter.bounded else "not bounded"
    return f"""# {name}

`python -m figures.shipped.run` writes this page. This is an adapter for the class `{adapter.space.name}`. The
adapter's target is *{adapter.variant}* ([variants](../variants/README.md)), and its albedo is {bound}. The
adapter's network has the size {recipe["network"]}, {count:,} parameters, and the input encoding `{adapter.encoding}`.

## Training
The dataset has {data["materials"]:,} materials of the population `{data["population"]}` (seed {data["seed"]}), with
{data["walks"]:,} walks per material. Training took {record["steps"]:,} steps with {record["bins_seen"]:,} bins in all,
and {record["seconds"] / 60:.0f} minutes on the device `{record["device"]}` ({record["date"]}).
[docs/training.md](../../docs/training.md) has the commands, and `nma info {name}` prints every setting.

## Metrics on unseen materials
[docs/evaluation.md](../../docs/evaluation.md) explains the metrics. In the set `metals`, every third material has a
metal that was held out of training.

{_table(sets)}

![Histograms of log loss and albedo error]({name}-errors.png)

## Brightness
The signed error of brightness in %, in five bands of the cosine from 0 (grazing) to 1, and the non-reciprocity.
[docs/evaluation.md](../../docs/evaluation.md) defines both. Errors are positive where the adapter is too bright.

The errors of materials partly cancel in the rows of a set, so each set has a second row: the mean size of the errors of
its materials, without sign.

{_brightness({label: result["brightness"] for label, (_, result) in sets.items()} | named)}

## The worst materials
{chr(10).join(f"{k + 1}. {line}" for k, line in enumerate(worst))}

![The worst materials, simulated and by the adapter]({name}-worst.png)

## Known limits
{LIMITS}"""


def _table(sets: dict[str, tuple[nma.Tables, dict]]) -> str:
    """Returns a table with a column for each set of materials: first the mean metrics, then the largest errors."""
    rows = [("metric", *(f"{label}, {len(tables.params)}" for label, (tables, _) in sets.items()))]
    rows.append(("---",) * len(rows[0]))
    rows += [
        (figure, *(f"{result['mean'][figure]:.4g}" for _, result in sets.values())) for figure in FIGURES
    ]
    for worst in ("worst_log_loss", "worst_albedo_error"):
        rows.append((worst.replace("_", " "), *(f"{result[worst]:.4f}" for _, result in sets.values())))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _brightness(found: dict[str, dict]) -> str:
    """Returns a table with a row for each set of materials and each named material."""
    rows: list[tuple[str, ...]] = [("", "over cos(theta_i)", "over cos(theta_o)", "non-reciprocity")]
    rows.append(("---",) * len(rows[0]))
    for name, errors in found.items():
        bands = (", ".join(f"{100 * x:+.1f}" for x in errors[angle]) for angle in ANGLES)
        rows.append((name, *bands, f"{errors['non_reciprocity']:.3f}"))
        if name in common.SETS:
            sizes = (", ".join(f"{100 * x:.1f}" for x in errors[f"{angle}_size"]) for angle in ANGLES)
            rows.append((f"{name}, mean size", *sizes, ""))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _histogram(sets: dict[str, tuple[nma.Tables, dict]], path: Path) -> None:
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    axes = figure.subplots(1, 2)
    for ax, quantity, text in zip(
        axes, ("log_loss", "albedo_error"), ("log loss", "albedo error"), strict=True
    ):
        values = [result[quantity] for _, result in sets.values()]
        ax.hist(values, bins=25, label=list(sets))
        ax.set(xlabel=text, ylabel="materials")
        ax.legend()
    common.save_figure(figure, path)


def _worst(weights: str, sets: dict[str, tuple[nma.Tables, dict]], path: Path, quick: bool) -> list[str]:
    """Renders the materials with the largest log losses, and returns a line of text about each of these materials."""
    nma.render.use()
    ranked = [
        (loss, label, k) for label, (_, result) in sets.items() for k, loss in enumerate(result["log_loss"])
    ]
    rows, lines = [], []
    for loss, label, k in sorted(ranked, reverse=True)[: 2 if quick else WORST]:
        tables, result = sets[label]
        params = tables.params[k]
        truth = _render({"type": "layered"}, params, 16 if quick else 512)
        image = _render({"type": "nma", "adapter": weights}, params, 16 if quick else 512)
        flip = compare_images(image, truth)["flip_hdr"]
        named = {n: np.round(params[c], 3).tolist() for n, c in nma.LAYERED3.slices.items()}
        described = ", ".join(f"{n} {v[0] if len(v) == 1 else v}" for n, v in named.items())
        lines.append(
            f"{label} {k}: log loss {loss:.4f}, albedo error {result['albedo_error'][k]:.4f}, "
            f"HDR-FLIP {flip:.3f}; {described}"
        )
        caption = f"log loss {loss:.4f}\nHDR-FLIP {flip:.3f}"
        rows.append(Row(f"{label} {k}", [truth, image, difference_image(image, truth)], ["", caption, ""]))
    contact_sheet(
        path, rows, ("simulated", "adapter", "FLIP"), title=f"{Path(weights).stem}: the worst of both sets"
    )
    return lines


def _render(bsdf: dict[str, Any], params: np.ndarray, spp: int) -> np.ndarray:
    values = {}
    for name, columns in nma.LAYERED3.slices.items():
        value = params[columns].tolist()
        values[name] = value[0] if len(value) == 1 else {"type": "rgb", "value": value}
    scene = load_dict(nma.preview_scene({**bsdf, **values}, size=(144, 144), lighting="outdoors"))
    return render_passes(scene, spp)
