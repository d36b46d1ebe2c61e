"""Plots where an adapter's errors are, over theta_i, theta_o and phi, for the materials with the largest log losses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
from figures import common
from nma.evaluate.metrics import EPS

WORST = 10
COSINES = (0.1, 0.3, 0.5, 0.7, 0.9)
# The colours end at this relative residual.
LARGEST = 0.5


def write(weights: str, reference: nma.Tables, path: Path) -> list[dict[str, float]]:
    """Plots the residuals of the worst materials; returns the index and the log loss of each, the worst first."""
    adapter = nma.Adapter.load(weights)
    losses = [found["log_loss"] for found in common.figures(adapter, reference)]
    worst = np.argsort(losses)[::-1][:WORST]
    figure = Figure(figsize=(2.1 * len(COSINES) + 1.6, 1.7 * len(worst) + 0.9), layout="constrained")
    grid = figure.subplots(len(worst), len(COSINES), sharex=True, sharey=True, squeeze=False)
    for row, number in zip(grid, worst, strict=True):
        own = nma.tabulate_adapter(adapter, reference.params[number][None])[0]
        found = residuals(own, reference.values[number])
        for axes, cosine in zip(row, COSINES, strict=True):
            part = found[int(cosine * len(found))]
            image = axes.imshow(
                part,
                "RdBu_r",
                vmin=-LARGEST,
                vmax=LARGEST,
                origin="lower",
                extent=(0, 180, 0, 1),
                aspect="auto",
            )
        row[0].set_ylabel(f"{number}: {losses[number]:.4f}\ncos(theta_o)", fontsize=8)
    for axes, cosine in zip(grid[0], COSINES, strict=True):
        axes.set_title(f"cos(theta_i) {cosine}", fontsize=9)
    for axes in grid[-1]:
        axes.set(xticks=(0, 90, 180), xlabel="delta_phi")
    figure.colorbar(
        image, ax=grid, shrink=0.4, extend="both", label=f"(adapter - reference) / (reference + {EPS})"
    )
    figure.suptitle(f"{Path(weights).stem}: the materials with the largest log losses", fontsize=11)
    common.save_figure(figure, path)
    return [{"material": int(number), "log_loss": round(losses[number], 6)} for number in worst]


def residuals(own: NDArray, reference: NDArray) -> NDArray[np.float64]:
    """Signed relative residuals (theta_i, theta_o, phi) of two tables, summed over RGB.

    EPS keeps the residual finite, and small where the reference is darker than its noise.
    """
    ours, theirs = (table.astype(np.float64).mean(axis=-1) for table in (own, reference))
    return (ours - theirs) / (theirs + EPS)
