"""What the commands that train share: the settings that a variant makes, and the end of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nma.cli import console, options

# The printed loss is the mean over this many steps, the last ones.
_LAST = 500


def of_variant(variant: str, target: str | None, instances: int | None = None) -> dict[str, Any]:
    """The settings of a recipe that a variant of the paper decides, unless `target` or `instances` say otherwise."""
    count, directional = options.VARIANTS[variant]
    if not directional:
        # Without the view direction there is no plane to stretch along.
        target = target or "principled"
    return {"instances": instances or count, "directional": directional, "target": target}


def finish(adapter: Any, run: Any, output: Path) -> None:
    """Writes the weights and the plot of the losses, and says so."""
    adapter.save(output)
    loss, plot = losses(run, output)
    console.say(
        f"{output}: {adapter.variant}, {run.step} steps in {run.seconds:.0f} s, "
        f"log loss of the last steps {loss:.5f} (against noisy bins); losses in {plot}"
    )


def losses(run: Any, output: Path) -> tuple[float, Path]:
    """The log loss of the last steps, and the plot of all, which is drawn beside the weights."""
    from nma.train.plot import plot_losses

    last = run.log_losses[-_LAST:]
    return sum(last) / len(last), plot_losses(run.log_losses, console.loss_plot(output), output.name)
