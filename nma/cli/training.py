"""Functions that the training commands share: they read the option --variant and write the results of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nma.cli import console, options

# The number of last steps over which the printed loss is averaged.
_LAST = 500


def of_variant(variant: str, target: str | None, instances: int | None = None) -> dict[str, Any]:
    """The fields of a recipe that the option --variant sets. `target` and `instances`, if given, override these
    fields."""
    count, directional = options.VARIANTS[variant]
    if not directional:
        # If the parameters do not depend on the view direction, lobes cannot be stretched along the plane of incidence.
        target = target or "principled"
    return {"instances": instances or count, "directional": directional, "target": target}


def finish(adapter: Any, run: Any, output: Path) -> None:
    """Writes the weights file and the plot of the loss, and prints their paths and the loss."""
    adapter.save(output)
    loss, plot = losses(run, output)
    console.say(
        f"{output}: {adapter.variant}, {run.step} steps in {run.seconds:.0f} s, "
        f"log loss of the last steps {loss:.5f} (against noisy bins); losses in {plot}"
    )


def losses(run: Any, output: Path) -> tuple[float, Path]:
    """Writes the plot of the loss, and returns the mean log loss of the last steps and the path of the plot."""
    from nma.train.plot import plot_losses

    last = run.log_losses[-_LAST:]
    return sum(last) / len(last), plot_losses(run.log_losses, console.loss_plot(output), output.name)
