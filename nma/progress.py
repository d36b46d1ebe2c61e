"""Shows progress bars on stderr, for commands and for Python calls that take minutes."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

err = Console(stderr=True)


def progress(unit: str) -> Progress:
    """A progress bar that shows a rate in `unit` (task field `rate`), a note (task field `note`) and the time left."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]} " + unit),
        TextColumn("{task.fields[note]}", markup=False),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=err,
    )


class TrainingBar:
    """A progress bar for training that shows the mean loss of the last 500 steps and the bins per second."""

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
        """Shows the progress of the training `run`."""
        if self._first is None:
            self._first, self._began = run.step, time.perf_counter()
            self._bar.update(self._task, completed=run.step)
            return
        rate = (
            (run.step - self._first) * self._recipe.bins_per_step / (time.perf_counter() - self._began) / 1e6
        )
        recent = run.log_losses[-500:]
        note = f"log loss {sum(recent) / len(recent):.5f}"
        self._bar.update(self._task, completed=run.step, rate=f"{rate:.2f}", note=note)


@contextmanager
def of_training(
    given: Callable[[Any], None] | None, recipe: Any, title: str = "training"
) -> Iterator[Callable[[Any], None]]:
    """Yields the function that training calls to report its progress, which is the function `given` of the caller.

    If `given` is None, yields a function that updates a progress bar if stderr is a terminal, and otherwise does
    nothing.
    """
    if given is not None:
        yield given
    elif not sys.stderr.isatty():
        yield lambda run: None
    else:
        with TrainingBar(recipe, title) as bar:
            yield bar.update
