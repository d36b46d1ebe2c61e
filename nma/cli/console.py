"""What the commands share: progress bars on stderr, tables on stdout."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

out = Console()
err = Console(stderr=True)


def progress(unit: str) -> Progress:
    """A progress bar with a rate in `unit` (the field `rate`), a note (the field `note`) and the time left."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]} " + unit),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=err,
    )


def table(headings: Sequence[str], rows: Iterable[Sequence[object]], title: str | None = None) -> Table:
    """A table whose first column is text and whose others are aligned to the right; brackets are no markup in it."""
    result = Table(title=escape(title) if title else None)
    for n, heading in enumerate(headings):
        result.add_column(heading, justify="left" if n == 0 else "right", overflow="fold")
    for row in rows:
        result.add_row(*(f"{cell:.4g}" if isinstance(cell, float) else escape(str(cell)) for cell in row))
    return result


def loss_plot(output: Path) -> Path:
    """Where the losses of a training run are drawn: beside its weights."""
    return output.with_suffix(".loss.png")


class TrainingBar:
    """A progress bar that shows the loss over the last steps and bins per second."""

    def __init__(self, recipe: Any, title: str = "training"):
        self._bar, self._recipe, self._title = progress("Mbins/s"), recipe, title
        self._began, self._first = time.perf_counter(), None

    def __enter__(self) -> TrainingBar:
        self._bar.__enter__()
        self._task = self._bar.add_task(self._title, total=self._recipe.steps, rate="", note="")
        return self

    def __exit__(self, *args: Any) -> None:
        self._bar.__exit__(*args)

    def update(self, run: Any) -> None:
        if self._first is None:
            self._first, self._began = run.step, time.perf_counter()
            return
        rate = (
            (run.step - self._first) * self._recipe.bins_per_step / (time.perf_counter() - self._began) / 1e6
        )
        recent = run.log_losses[-500:]
        note = f"log loss {sum(recent) / len(recent):.5f}"
        self._bar.update(self._task, completed=run.step, rate=f"{rate:.2f}", note=note)
