"""Functions that the commands share to print progress bars on stderr and tables on stdout."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table

from nma.progress import TrainingBar, err, progress

__all__ = ["TrainingBar", "counting", "err", "loss_plot", "number", "out", "progress", "say", "table", "tell"]

out = Console()

_GAP = 2
# A cell with more characters than `_SENTENCE` is treated as a sentence, which may be wrapped between words.
_SENTENCE = 24


def table(headings: Sequence[str], rows: Iterable[Sequence[object]], title: str | None = None) -> Group:
    """Returns a table that fits the width of the terminal. Sentences are wrapped between words; numbers are never
    wrapped.

    Columns that do not fit are printed in further tables below the first table. Each further table repeats the first
    column. Brackets in a cell are printed as text and not interpreted as markup.
    """
    cells = [[number(cell) if isinstance(cell, float) else str(cell) for cell in row] for row in rows]
    columns = [
        _Column(heading, [row[n] for row in cells], first=n == 0) for n, heading in enumerate(headings)
    ]
    parts: list[RenderableType] = [f"[bold]{escape(title)}[/bold]"] if title else []
    return Group(*parts, *(_table([columns[0], *part]) for part in _parts(columns)))


def say(text: str) -> None:
    """Prints a line on stderr unchanged: long paths are not broken, and brackets are not interpreted as markup."""
    err.print(text, soft_wrap=True, markup=False, highlight=False)


def tell(text: str) -> None:
    """Prints a line on stdout unchanged, as `say` does on stderr."""
    out.print(text, soft_wrap=True, markup=False, highlight=False)


@contextmanager
def counting(
    title: str, total: int, unit: str, before: int = 0, digits: int = 1
) -> Iterator[Callable[..., Any]]:
    """Shows a progress bar that counts from `before` to `total`, with a rate in `unit`.

    Yields a function `show(done, work, **more)`, which updates the bar and returns the work per second. `done` is the
    count so far, `work` is the work since the start, and `more` may set the `note` and the `description` of the bar.
    """
    with progress(unit) as bar:
        task = bar.add_task(title, total=total, completed=before, rate="", note="")
        began = time.perf_counter()

        def show(done: int, work: float, **more: str) -> float:
            rate = work / (time.perf_counter() - began)
            bar.update(task, completed=done, rate=f"{rate:.{digits}f}", **more)  # type: ignore[arg-type]
            return rate

        yield show


def number(value: float) -> str:
    """Formats a number with four significant digits (.01382), or with two below 1e-4 (6.5e-06)."""
    text = f"{value:.4g}" if abs(value) >= 1e-4 or value == 0 else f"{value:.1e}"
    return text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text


def loss_plot(output: Path) -> Path:
    """The file for the plot of the training loss, in the folder of the weights file `output`."""
    return output.with_suffix(".loss.png")


class _Column:
    """A column of a table. `width` is the smallest number of characters in which the column fits."""

    def __init__(self, heading: str, cells: Sequence[str], first: bool):
        widest = max(map(cell_len, cells), default=0)
        self.sentences = widest > _SENTENCE
        if cell_len(heading) > widest:
            heading = heading.replace("_", "\n")
        self.heading, self.cells, self.first = heading, cells, first
        words = [word for text in (*cells, heading) for word in text.split()] if self.sentences else []
        lines = [*cells, *heading.split("\n")]
        self.width = max(_SENTENCE, *map(cell_len, words)) if words else max(map(cell_len, lines))


def _parts(columns: Sequence[_Column]) -> list[list[_Column]]:
    """Divides all columns except the first among as few tables as possible that fit the width of the terminal."""
    parts: list[list[_Column]] = [[]]
    room = out.width - columns[0].width
    for column in columns[1:]:
        if parts[-1] and sum(c.width + _GAP for c in (*parts[-1], column)) > room:
            parts.append([])
        parts[-1].append(column)
    return parts


def _table(columns: Sequence[_Column]) -> Table:
    result = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, _GAP - 1, 0, 0), pad_edge=False)
    for column in columns:
        left = column.first or column.sentences
        result.add_column(
            escape(column.heading),
            justify="left" if left else "right",
            no_wrap=not column.sentences,
            min_width=min(column.width, out.width),
            overflow="fold",
        )
    for row in zip(*(column.cells for column in columns), strict=True):
        result.add_row(*map(escape, row))
    return result
