"""What limits the class adapters: unseen materials, beside fits of several targets to each of them alone.

    python figures/limits/run.py [--quick] [--materials N]

A fit knows its material, so what it leaves is the target's error; what a class adapter leaves beyond a fit of its own
target is the network's, the data's and the optimiser's. Materials are evenly spaced in the set "range" by the log loss
of the first shipped adapter; each is fitted to its reference and judged by it. Fits are kept in out/figures/limits.
Writes limits.json and limits.png beside this file; with --quick, short fits to two materials, to out/figures/limits.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import nma
from nma.train.recipe import Recipe, preset
from nma.train.run import fit_material

sys.path.insert(0, str(Path(__file__).parents[1]))
import common

SET = "range"
# Targets that are fitted; the first one is the class adapters'.
TARGETS = {
    "fit, two instances": {"target": "principled"},
    "fit, two stretched": {"target": "stretched"},
    "fit, four stretched": {"target": "stretched", "instances": 4},
}
FIGURES = ("log_loss", "albedo_error")


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--materials", type=int, default=12)
    parser.add_argument("--steps", type=int, default=4000, help="of each fit")
    arguments = parser.parse_args()
    if arguments.quick:
        vars(arguments).update(materials=2, steps=100)
        # Compiling takes longer than these few steps.
        jax.config.update("jax_disable_most_optimizations", True)
    folder = common.results(__file__, arguments.quick)
    reference = common.reference(SET, arguments.quick)
    adapters = [nma.Adapter.load(name) for name in nma.shipped()[::-1]]
    rows = [class_adapters(adapters, reference, number) for number in range(len(reference.params))]
    order = np.argsort([row[nma.shipped()[-1]]["log_loss"] for row in rows])
    chosen = order[np.linspace(0, len(order) - 1, arguments.materials).round().astype(int)]
    for number in chosen:
        rows[number] |= fits(reference, int(number), arguments.steps, arguments.quick)
        print(number, {k: v["log_loss"] for k, v in rows[number].items() if k != "params"}, flush=True)
    result = summary([rows[n] for n in chosen])
    print(json.dumps(result, indent=1))
    common.write_json(folder / "limits.json", {"mean": result, "materials": [rows[n] for n in chosen]})
    plot([rows[n] for n in chosen], folder / "limits.png")


def one(reference: nma.Tables, number: int) -> nma.Tables:
    """The reference of a single material."""
    kept = {
        name: getattr(reference, name)[number : number + 1] for name in ("params", "values", "walks", "error")
    }
    return replace(reference, **kept)


def class_adapters(adapters: list[nma.Adapter], reference: nma.Tables, number: int) -> dict:
    """What the reference's noise and the shipped adapters score on a material."""
    row: dict = {"params": [round(float(x), 5) for x in reference.params[number]]}
    for name, adapter in zip(nma.shipped()[::-1], adapters, strict=True):
        row[name], floor = figures(adapter, one(reference, number))
    return row | {"noise": floor}


def fits(reference: nma.Tables, number: int, steps: int, quick: bool) -> dict:
    """What each target scores that is fitted to the material."""
    kept = common.ROOT / "out/figures/limits" / f"{number}-{len(reference.params)}-{steps}.json"
    if not kept.exists() or quick:
        table = one(reference, number)
        found = {name: fit(table, preset("single", steps=steps, **how)) for name, how in TARGETS.items()}
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(found))
    return json.loads(kept.read_text())


def fit(table: nma.Tables, recipe: Recipe) -> dict[str, float]:
    adapter, _ = fit_material(nma.LAYERED3, recipe, table.params, table, {})
    return figures(adapter, table)[0]


def figures(adapter: nma.Adapter, table: nma.Tables) -> tuple[dict[str, float], dict[str, float]]:
    """The adapter's figures, and those of a perfect one."""
    found = nma.evaluate_adapter(adapter, table).mean
    mine = {name: round(found[name], 6) for name in FIGURES}
    return mine, {"log_loss": round(found["noise_floor"], 6), "albedo_error": 0.0}


def summary(rows: list[dict]) -> dict[str, dict[str, float]]:
    """Means over the materials."""
    names = [name for name in rows[0] if name != "params"]
    return {n: {f: round(float(np.mean([r[n][f] for r in rows])), 6) for f in FIGURES} for n in names}


def plot(rows: list[dict], path: Path) -> None:
    """The log loss of every contender for every material."""
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    axes = figure.add_subplot(ylabel="log loss (eq. 7)", xlabel="materials, by the class adapter's log loss")
    for name in (name for name in rows[0] if name != "params"):
        losses = [row[name]["log_loss"] for row in rows]
        style = {"color": "gray", "linestyle": ":"} if name == "noise" else {"marker": "o"}
        axes.plot(losses, label=f"{name}: {np.mean(losses):.4f}", **style)
    axes.set_ylim(bottom=0)
    axes.set_xticks(range(len(rows)))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
