"""Accuracy of the shipped adapters on unseen materials: 89 from the ranges of the paper's Table 1, 60 with real metals.

    python -m figures.shipped.run [--quick] [--adapter FILE] [--seeds FILE FILE FILE]

Every third of the 60 materials has a metal that was held out of training. The references have 64 M walks per material.
The references are simulated once, with fixed seeds, and stored in out/references. The simulation takes about 15 minutes
on 2 cores, and a killed simulation can be resumed.

The signed errors of brightness are also measured for all named materials.

With --seeds, evaluates only the given weights files: trainings of one recipe with different seeds. Prints the mean and
the standard deviation of the headline figures over the seeds, and writes them to seeds.json and seeds.md.

Writes shipped.json, shipped.png and a model card for each adapter beside this file. With --quick, takes few materials
and walks, and writes to out/figures/shipped.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import nma
from figures import common
from figures.shipped import card, seeds


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument(
        "--adapter", action="append", help="a weights file or a shipped name; may be repeated"
    )
    parser.add_argument(
        "--seeds",
        action="append",
        nargs="+",
        metavar="FILE",
        help="weights files of one recipe with different seeds; may be repeated for other recipes",
    )
    arguments = parser.parse_args()
    folder = common.results(__file__, arguments.quick)
    references = {name: common.reference(name, arguments.quick) for name in common.SETS}
    if arguments.seeds:
        print(seeds.write(arguments.seeds, references, folder))
        return
    names = nma.material_names()[: 2 if arguments.quick else None]
    named = {name: common.named_reference(name, arguments.quick) for name in names}
    results: dict[str, dict] = {}
    for weights in arguments.adapter or list(nma.shipped()):
        adapter, label = nma.Adapter.load(weights), Path(weights).stem
        results[label] = {}
        for name, tables in references.items():
            results[label][name] = summary(nma.evaluate_adapter(adapter, tables), tables)
            print(f"{label} on {name}: {json.dumps(results[label][name]['mean'])}", flush=True)
        results[label]["named"] = {
            name: brightness(nma.evaluate_adapter(adapter, tables)) for name, tables in named.items()
        }
        sets = {name: (tables, results[label][name]) for name, tables in references.items()}
        print(card.write(weights, sets, results[label]["named"], folder, arguments.quick), flush=True)
    common.write_json(folder / "shipped.json", results)
    plot(results, folder / "shipped.png")


def summary(evaluation, tables) -> dict:
    """Returns mean metrics and largest errors, and the log loss and albedo error of every material."""
    rounded = {k: round(v, 6) for k, v in evaluation.mean.items()}
    errors = np.array([m["albedo_error"] for m in evaluation.materials])
    sharp = tables.params[:, nma.LAYERED3.slices["alpha_top"]][:, 0] < 0.01
    return {
        "mean": rounded,
        "albedo_error_of_coats_below_.01": round(float(errors[sharp].mean()), 6) if sharp.any() else None,
        "worst_log_loss": round(max(m["log_loss"] for m in evaluation.materials), 6),
        "worst_albedo_error": round(float(errors.max()), 6),
        "integration_error": evaluation.integration_error,
        "log_loss": [round(m["log_loss"], 6) for m in evaluation.materials],
        "albedo_error": [round(float(e), 6) for e in errors],
        "brightness": brightness(evaluation),
    }


def brightness(evaluation) -> dict:
    """Returns the signed errors of brightness over both cosines and the non-reciprocity, of all materials together."""
    signed = {name: [round(x, 4) for x in e] for name, e in evaluation.signed_of_all._asdict().items()}
    sizes = {
        f"{name}_size": np.abs([getattr(errors, name) for errors in evaluation.signed])
        .mean(axis=0)
        .round(4)
        .tolist()
        for name in signed
    }
    return signed | sizes | {"non_reciprocity": round(evaluation.mean_non_reciprocity, 4)}


def plot(results: dict, path: Path) -> None:
    """Plots the sorted log losses and albedo errors of all materials, with a curve for each adapter and set."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    for label, sets in results.items():
        for name in common.SETS:
            for ax, quantity in zip(axes, ("log_loss", "albedo_error"), strict=True):
                ax.plot(np.sort(sets[name][quantity]), label=f"{label}, {name}")
    for ax, text in zip(axes, ("log loss (eq. 7)", "albedo error"), strict=True):
        ax.set(xlabel="materials, sorted", ylabel=text)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
