"""What engines use today, on the materials of figures/shipped: Belcour 2018, OpenPBR, a constant Principled BRDF.

    python -m figures.peers.run [--quick] [--no-pictures]

Compares each model (PEERS) with the references of all materials. Belcour's model and OpenPBR get the materials'
parameters by stated rules (belcour.py, openpbr.py). The constant Principled BRDF is fitted to each material's own
reference, and so is the latent code of the direct evaluator, whose results are those of figures/direct. The shipped
adapters compute their parameters from those of the material. The times are those of the C++ runtime.

The first run takes about an hour on one core, most of it for the fits. The results of finished materials are kept in
out/figures/peers, so a killed run continues where it stopped.

Prints the table of README.md, and writes peers.json, peers.md, peers.png and worst.png beside this file. With --quick,
takes few materials and writes to out/figures/peers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
from figures import common
from figures.peers import belcour, constant, openpbr, pictures
from figures.peers.lobes import given
from nma.adapter import DEFAULT_ADAPTER
from nma.evaluate.metrics import table_metrics
from nma.files import write_text
from nma.sources.base import Values
from nma.table.values import tabulate_values

# Models that compute a material's values from its parameters.
PEERS: dict[str, Callable[[Any], Values]] = {
    "Belcour 2018": lambda params: belcour.source(given(params)),
    "Belcour 2018, normalised": lambda params: belcour.source(given(params), belcour.normalised),
    "OpenPBR": lambda params: openpbr.source(given(params)),
    "OpenPBR, dimmed both ways": lambda params: openpbr.source(given(params), both_ways=True),
}
CONSTANT, DIRECT = "constant Principled", "direct evaluator"
# The peers whose pictures are shown, beside the adapter's.
SHOWN = ("Belcour 2018, normalised", "OpenPBR", CONSTANT)
# Points per bin. With four times as many, log losses change by some 1e-5, and albedo errors by less than 5e-4.
POINTS = 32
# A medium counts as thin if its optical depth sigma_t is below THIN.
THIN = 0.1
FIGURES = {"log_loss": "log loss", "smape": "SMAPE", "albedo_error": "albedo error"}


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument(
        "--no-pictures", action="store_true", help="render no pictures: neither worst.png nor those for FLIP"
    )
    arguments = parser.parse_args()
    folder = common.results(__file__, arguments.quick)
    references = {name: common.reference(name, arguments.quick) for name in common.SETS}
    materials = {name: compete_all(name, tables, arguments.quick) for name, tables in references.items()}
    results: dict[str, Any] = {
        label: {
            name: summary(rows, label, thin(references[name]))
            for name, rows in materials.items()
            if label in rows[0]
        }
        for label in materials["range"][0]
    }
    if not arguments.quick:
        for label, times in constant.nanoseconds(CONSTANT, "range", references["range"]).items():
            results[label]["ns"] = times
    models = {label: PEERS.get(label) for label in (*PEERS, CONSTANT)}
    if not arguments.no_pictures:
        for label, found in pictures.flips(models, "range", references["range"], arguments.quick).items():
            results.setdefault(label, {})["flip_hdr"] = {
                "mean": round(float(np.mean(found)), 4),
                "materials": found,
            }
    text = markdown(results)
    print(text)
    write_text(folder / "peers.md", text)
    common.write_json(folder / "peers.json", results)
    plot(materials["range"], folder / "peers.png")
    if not arguments.no_pictures:
        shown = {label: models[label] for label in SHOWN}
        pictures.write(shown, references, materials, folder / "worst.png", arguments.quick)


def compete_all(name: str, tables: nma.Tables, quick: bool) -> list[dict[str, Any]]:
    """Returns the metrics of every model for each material of a set, by the labels of the models."""
    kept = common.ROOT / "out/figures/peers" / ("quick" if quick else "metrics")
    kept.mkdir(parents=True, exist_ok=True)
    direct = direct_evaluator() if name == "range" and not quick else []
    rows = []
    for number in range(len(tables.params)):
        path = kept / f"{name}-{number}.json"
        found = common.kept(path, partial(compete, name, tables, number), quick)
        found[CONSTANT] = rounded(constant.fitted(name, tables, number, quick)[0])
        found |= {DIRECT: direct[number]} if direct else {}
        rows.append(
            {label: found[label] for label in (*PEERS, CONSTANT, DIRECT, *nma.shipped()) if label in found}
        )
    return rows


def compete(name: str, tables: nma.Tables, number: int) -> dict[str, dict[str, float]]:
    """Computes the metrics of the peers and of the shipped adapters for one material."""
    one, row = tables[number : number + 1], {}
    for label, model in PEERS.items():
        own = tabulate_values(model(one.params[0]), points=POINTS).values[0]
        row[label] = rounded(table_metrics(own, one.values[0], np.zeros_like(own)))
    for label in nma.shipped():
        row[label] = rounded(common.figures(nma.Adapter.load(label), one)[0])
    print(name, number, {label: found["log_loss"] for label, found in row.items()}, flush=True)
    return row


def direct_evaluator() -> list[dict[str, float]]:
    """Returns the metrics of the direct evaluator for each material of the set "range", from figures/direct."""
    results = json.loads((common.ROOT / "figures/direct/direct.json").read_text())
    return [rounded(found) for found in results[DIRECT]["materials"]]


def rounded(figures: dict[str, float]) -> dict[str, float]:
    return {f: round(figures[f], 6) for f in FIGURES}


def thin(tables: nma.Tables) -> NDArray[np.bool_]:
    """Marks the materials whose medium hardly absorbs or scatters."""
    return tables.params[:, nma.LAYERED3.slices["sigma_t"]][:, 0] < THIN


def summary(rows: list[dict[str, Any]], label: str, thin: NDArray[np.bool_]) -> dict[str, Any]:
    """Returns a model's figures of every material of a set, and their means over all and over those that are `thin`."""
    every = {f: [row[label][f] for row in rows] for f in FIGURES}
    means = {f: round(float(np.mean(values)), 6) for f, values in every.items()}
    few = np.array(every["log_loss"])[thin]
    better = np.mean([row[label]["log_loss"] < row[DEFAULT_ADAPTER]["log_loss"] for row in rows])
    return {
        "mean": means,
        "log_loss_of_thin_media": round(float(few.mean()), 6) if len(few) else None,
        "worst_log_loss": max(every["log_loss"]),
        "better_than_the_adapter": round(float(better), 4),
        "materials": every,
    }


def markdown(results: dict[str, Any]) -> str:
    """Returns a Markdown table with a row for each model."""
    heads = [f"{text}, {name}" for name in common.SETS for text in (*FIGURES.values(), "worst", "thin media")]
    heads += ["HDR-FLIP", "prepare, ns", "eval and pdf, ns"]
    lines = ["| | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for label, result in results.items():
        cells = []
        for name in common.SETS:
            found = result.get(name)
            cells += [f"{found['mean'][f]:.4f}" for f in FIGURES] if found else [""] * len(FIGURES)
            others = (
                [found[key] for key in ("worst_log_loss", "log_loss_of_thin_media")]
                if found
                else [None, None]
            )
            cells += ["" if x is None else f"{x:.4f}" for x in others]
        cells.append(f"{result['flip_hdr']['mean']:.3f}" if "flip_hdr" in result else "")
        cells += [f"{x:.0f}" for x in result.get("ns", {}).values()] or ["", ""]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Plots the sorted log losses and albedo errors of every model."""
    figure = Figure(figsize=(10, 4.5), layout="constrained")
    axes = figure.subplots(1, 2)
    for label in rows[0]:
        style = "-" if label in nma.shipped() else "--"
        for ax, quantity in zip(axes, ("log_loss", "albedo_error"), strict=True):
            ax.plot(np.sort([row[label][quantity] for row in rows]), style, label=label)
    for ax, text in zip(axes, ("log loss (eq. 7)", "albedo error"), strict=True):
        ax.set(xlabel="materials of the set range, sorted", ylabel=text, yscale="log")
        ax.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
