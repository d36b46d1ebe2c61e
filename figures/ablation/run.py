"""Ablation of target and training: the recipe of `layered3-3x32`, shorter, with one setting changed at a time, and the
preset `paper`.

    python -m figures.ablation.run [--quick] [--data layered3.zarr] [--steps 8000]

Trains on a dataset of 8000 materials, which `nma dataset layered3 FOLDER --seed 1` makes. Evaluates on every third
material of the sets "range" and "metals" (figures/common.py). The metrics of finished trainings are kept in
out/figures/ablation, so a killed run does not repeat these trainings when it is started again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import nma
from figures import common
from nma import network
from nma.table.dataset import Settings, simulate_block
from nma.train.recipe import CLASS, for_class
from nma.train.run import train_class

# The changed settings, by name. The first settings change the target, the next the network, the rest the training. The
# paper's recipe is trained at its own learning rate (1e-5) and at higher learning rates.
CHANGES: dict[str, dict[str, Any]] = {
    "class": {},
    "without shift": {"without": ("shift",)},
    "without flatness": {"without": ("flatness",)},
    "without veil": {"without": ("veil",)},
    "without stretch": {"without": ("anisotropic",)},
    "one instance": {"instances": 1},
    "three instances": {"instances": 3},
    "stretched": {"target": "stretched"},
    "principled": {"target": "principled"},
    "not bounded": {"bounded": False},
    "no estimates": {"encoding": "layered3"},
    "2x32": {"network": "2x32"},
    "3x24": {"network": "3x24"},
    "3x64": {"network": "3x64"},
    "5x64": {"network": "5x64"},
    "no dim": {"dim": 0.0},
    "no energy": {"energy": 0.0},
    "no albedo": {"albedo": 0.0},
    "albedo 4": {"albedo": 4.0},
    "uniform points": {"points_law": "uniform"},
    "uniform bins": {"bins_law": "uniform"},
    "log loss": {"loss": "log"},
    "no average": {"average": 0.0},
    "paper, 1e-5": {"name": "paper"},
    "paper, 1e-4": {"name": "paper", "learning_rate": 1e-4},
    "paper, 1e-3": {"name": "paper", "learning_rate": 1e-3},
    "paper, 3e-3": {"name": "paper", "learning_rate": 3e-3},
}
FIGURES = ("log_loss", "albedo_error", "smape")


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--data", type=Path, default=common.ROOT / "out/layered3.zarr")
    parser.add_argument("--steps", type=int, default=8_000, help="steps of the preset `class`")
    parser.add_argument("--only", nargs="*", help="run only these changes")
    arguments = parser.parse_args()
    folder = common.results(__file__, arguments.quick)
    names = arguments.only or list(CHANGES)[: 2 if arguments.quick else None]
    steps = 50 if arguments.quick else arguments.steps
    every = 4 if arguments.quick else 3
    references = {name: common.reference(name, arguments.quick)[::every] for name in common.SETS}
    # The dataset is read only if a training needs it.
    tables = cache(lambda: data(arguments.data, arguments.quick))
    results = {}
    for name in names:
        stored = common.ROOT / "out/figures/ablation" / f"{name}-{steps}.json"
        results[name] = common.kept(stored, partial(train, name, tables, references, steps), arguments.quick)
        print(f"{name:20}", json.dumps(results[name]), flush=True)
    common.write_json(folder / "ablation.json", results)
    plot(results, folder / "ablation.png")


def data(path: Path, quick: bool) -> nma.Tables:
    return (
        simulate_block(Settings("layered3", 16, 81_920, 0), range(16))
        if quick
        else nma.Dataset.open(path).load()
    )


def train(name: str, tables: Callable[[], nma.Tables], references: dict[str, nma.Tables], steps: int) -> dict:
    """Trains with one changed setting, and returns the metrics. Every training uses as many bins as the preset `class`
    uses in `steps` steps."""
    recipe = for_class(nma.LAYERED3, **({"network": "3x32"} | CHANGES[name]))
    recipe = replace(recipe, steps=steps * CLASS.bins_per_step // recipe.bins_per_step)
    began = time.perf_counter()
    adapter, _ = train_class(nma.LAYERED3, recipe, tables(), {})
    result: dict = {"steps": recipe.steps, "seconds": round(time.perf_counter() - began)}
    result["numbers"] = network.parameters(adapter.layers)
    for label, reference in references.items():
        evaluation = nma.evaluate_adapter(adapter, reference)
        result[label] = {figure: round(evaluation.mean[figure], 5) for figure in FIGURES}
        result[label]["worst_albedo_error"] = round(max(m["albedo_error"] for m in evaluation.materials), 4)
    return result


def plot(results: dict, path: Path) -> None:
    """Draws bars for the log loss and the albedo error of every changed setting, for both sets of materials."""
    figure = Figure(figsize=(10, 1.2 + 0.35 * len(results)), layout="constrained")
    names, places = list(results), np.arange(len(results))
    for axes, quantity in zip(figure.subplots(1, 2, sharey=True), ("log_loss", "albedo_error"), strict=True):
        for k, label in enumerate(common.SETS):
            values = [results[name][label][quantity] for name in names]
            axes.barh(places + 0.2 - 0.4 * k, values, 0.4, label=label)
        axes.set(xlabel=quantity.replace("_", " "), yticks=places, yticklabels=names)
        axes.grid(alpha=0.3, axis="x")
    figure.axes[0].invert_yaxis()
    figure.axes[0].legend()
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
