"""Fits every named material and compares each fit with an independent reference (paper Fig. 4, left).

    python -m figures.fits.run [--quick] [MATERIAL ...]

Writes fits.json and fits.png beside this file. With --quick, fits one material with few walks and writes to
out/figures/fits.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import nma
from figures import common
from nma.table import stream_keys
from nma.train.recipe import for_class
from nma.train.run import fit_material


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("materials", nargs="*", default=None)
    arguments = parser.parse_args()
    names = arguments.materials or list(nma.material_names())[: 1 if arguments.quick else None]
    folder = common.results(__file__, arguments.quick)
    walks, reference_walks = (2_000_000, 4_000_000) if arguments.quick else (64_000_000, 128_000_000)
    rows = [fit(name, walks, reference_walks, arguments.quick) for name in names]
    for row in rows:
        print(
            "{name:22} seconds {seconds:6.1f}  log loss {log_loss:.5f}  albedo error {albedo_error:.4f}".format(
                **row
            )
        )
    losses = [row["log_loss"] for row in rows]
    print(f"log loss: median {np.median(losses):.5f}, worst {max(losses):.5f}")
    common.write_json(folder / "fits.json", rows)
    plot(rows, folder / "fits.png")


def fit(name: str, walks: int, reference_walks: int, quick: bool) -> dict:
    """Fits one material as `nma fit` does, and evaluates the fit on a reference from an independent random stream."""
    source, vector = nma.source("layered3"), nma.load_material(name).vector()
    recipe = for_class(source.space, "single", steps=100 if quick else None)
    began = time.perf_counter()
    tables = nma.tabulate(source, vector[None], walks, stream_keys(recipe.seed, [0]), error=False)
    adapter, _ = fit_material(source.space, recipe, vector, tables, {})
    seconds = time.perf_counter() - began
    reference = nma.tabulate(source, vector[None], reference_walks, stream_keys(999, [0]))
    result = nma.evaluate_adapter(adapter, reference).mean
    print(f"{name}: {seconds:.0f} s, log loss {result['log_loss']:.5f}", flush=True)
    return {"name": name, "seconds": round(seconds, 1), **{k: round(v, 6) for k, v in result.items()}}


def plot(rows: list[dict], path: Path) -> None:
    """Draws bars for the log loss and the albedo error of every material, and marks the noise of the references."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    names = [row["name"] for row in rows]
    left.barh(names, [row["log_loss"] for row in rows])
    left.plot([row["noise_floor"] for row in rows], names, "k|", markersize=9, label="noise of the reference")
    left.set(xlabel="log loss (eq. 7)")
    left.legend()
    right.barh(names, [row["albedo_error"] for row in rows])
    right.set(xlabel="albedo error")
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
