"""Draws the loss curve of a training run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nma.files import whole


def plot_losses(log_losses: Sequence[float], path: Path, title: str) -> Path:
    """Writes a PNG of the log loss (eq. 7) over steps, on logarithmic axes, smoothed over a hundredth of the run.

    Returns `path`.
    """
    from matplotlib.figure import Figure

    losses = np.asarray(log_losses)
    window = max(1, len(losses) // 100)
    steps = np.arange(window, len(losses) + 1)
    smooth = np.convolve(losses, np.ones(window) / window, mode="valid")
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot(
        title=title, xlabel="step", ylabel="log loss against noisy bins (eq. 7)", xscale="log", yscale="log"
    )
    axes.plot(steps, smooth)
    axes.grid(alpha=0.3, which="both")
    with whole(path) as file:
        figure.savefig(file, dpi=110)
    return path
