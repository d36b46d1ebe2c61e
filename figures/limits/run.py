"""Finds what limits the accuracy of class adapters, by comparison with fits to single materials with several targets.

    python -m figures.limits.run [--quick] [--materials N] [--residuals WEIGHTS]

A fit is trained on the table that it is evaluated on, so its remaining error comes from the target. A class adapter
with the same target has a larger error, and the additional error comes from the network, the data and the optimiser.
The experiment takes the first materials of the set "range", which is in random order; --materials is their number. Each
fit is trained on the material's reference table and evaluated on the same table. The metrics of finished materials are
kept in out/figures/limits.

The relative residuals of an adapter are plotted over theta_i, theta_o and phi for the ten
materials of the set with the largest log losses. The option --residuals names the adapter; with it, the script plots
the residuals alone, and makes no fits.

Writes limits.json, limits.png, residuals.json and residuals.png beside this file. With --quick, makes short fits to two
materials and writes to out/figures/limits.
"""

from __future__ import annotations

import json
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import nma
from figures import common
from figures.limits import residuals
from nma.adapter import DEFAULT_ADAPTER
from nma.train.recipe import Recipe, for_class
from nma.train.run import fit_material

SET = "range"
# The targets of the fits. The first target is that of the adapters layered3-3x32 and layered3-5x64.
TARGETS: dict[str, dict[str, Any]] = {
    "fit, two under the coat": {},
    "fit, four under the coat": {"instances": 4},
    "fit, two Principled": {"target": "principled"},
    "fit, two stretched": {"target": "stretched"},
}
FIGURES = ("log_loss", "albedo_error")


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--materials", type=int, default=6)
    parser.add_argument("--steps", type=int, default=4000, help="steps of each fit")
    parser.add_argument("--residuals", metavar="WEIGHTS", help="plot the residuals of this adapter alone")
    arguments = parser.parse_args()
    if arguments.quick:
        vars(arguments).update(materials=2, steps=100)
    folder = common.results(__file__, arguments.quick)
    reference = common.reference(SET, arguments.quick)
    weights = arguments.residuals or DEFAULT_ADAPTER
    worst = residuals.write(weights, reference, folder / "residuals.png")
    common.write_json(folder / "residuals.json", {"adapter": Path(weights).stem, "worst": worst})
    if arguments.residuals:
        return
    rows = [contenders(reference, number, arguments) for number in range(arguments.materials)]
    rows.sort(key=lambda row: row[DEFAULT_ADAPTER]["log_loss"])
    result = summary(rows)
    print(json.dumps(result, indent=1))
    common.write_json(folder / "limits.json", {"mean": result, "materials": rows})
    plot(rows, folder / "limits.png")


def contenders(reference: nma.Tables, number: int, arguments: Namespace) -> dict:
    """Returns the metrics of adapters, fits and noise for one material, and stores these metrics in a file."""
    stored = common.ROOT / "out/figures/limits" / f"{number}-{len(reference.params)}-{arguments.steps}.json"
    table = reference[number : number + 1]
    return common.kept(stored, partial(compete, number, table, arguments), arguments.quick)


def compete(number: int, table: nma.Tables, arguments: Namespace) -> dict:
    """Computes the metrics that `contenders` returns."""
    row: dict = {"params": [round(float(x), 5) for x in table.params[0]]}
    for name in nma.shipped()[::-1]:
        row[name], row["noise"] = figures(nma.Adapter.load(name), table)
    for name in list(TARGETS)[: 1 if arguments.quick else None]:
        row[name] = fit(table, for_class(nma.LAYERED3, "single", steps=arguments.steps, **TARGETS[name]))
    print(number, {k: v["log_loss"] for k, v in row.items() if k != "params"}, flush=True)
    return row


def fit(table: nma.Tables, recipe: Recipe) -> dict[str, float]:
    adapter, _ = fit_material(nma.LAYERED3, recipe, table.params, table, {})
    return figures(adapter, table)[0]


def figures(adapter: nma.Adapter, table: nma.Tables) -> tuple[dict[str, float], dict[str, float]]:
    """Returns the adapter's metrics, and the metrics that a perfect adapter would have."""
    found = nma.evaluate_adapter(adapter, table).mean
    mine = {name: round(found[name], 6) for name in FIGURES}
    return mine, {"log_loss": round(found["noise_floor"], 6), "albedo_error": 0.0}


def summary(rows: list[dict]) -> dict[str, dict[str, float]]:
    """Returns the metrics of every model, averaged over the materials."""
    names = [name for name in rows[0] if name != "params"]
    return {n: {f: round(float(np.mean([r[n][f] for r in rows])), 6) for f in FIGURES} for n in names}


def plot(rows: list[dict], path: Path) -> None:
    """Plots the log loss of every model for every material."""
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.add_subplot(ylabel="log loss (eq. 7)", xlabel="materials, by the class adapter's log loss")
    for name in (name for name in rows[0] if name != "params"):
        losses = [row[name]["log_loss"] for row in rows]
        style: dict[str, Any] = {"color": "gray", "linestyle": ":"} if name == "noise" else {"marker": "o"}
        axes.plot(losses, label=f"{name}: {np.mean(losses):.4f}", **style)
    axes.set_ylim(bottom=0)
    axes.set_xticks(range(len(rows)))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
