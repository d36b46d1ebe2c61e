"""The command `nma dataset`: simulates tables of many random materials of a class, for training."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nma import files
from nma.cli import console, options


def register(app: typer.Typer) -> None:
    app.command()(dataset)


def dataset(
    class_name: Annotated[str, typer.Argument(help="The class to sample, layered3.")],
    output: Annotated[
        Path,
        typer.Argument(help="The dataset (.zarr folder) to create or complete.", parser=options.path),
    ],
    materials: Annotated[int, options.number("Number of materials.", 1, 10**6)] = 8000,
    walks: Annotated[int, options.walks("Random walks per material.")] = 819_200,
    seed: Annotated[int, options.seed("Equal seeds give equal datasets.")] = 0,
    population: Annotated[
        str, options.choice("Where conductors come from.", *options.POPULATIONS[:-1])
    ] = "mixed",
) -> None:
    """Simulate tables of many random materials of a class, as a dataset for training.

    The same command continues a killed run. Several runs may write to one dataset at the same time.
    """
    from nma.table.dataset import Dataset, Settings, check_folder

    check_folder(output)
    files.try_folder(output)
    data = Dataset.create(output, Settings(class_name, materials, walks, seed, population))  # type: ignore[arg-type]
    before = materials - len(data.missing())
    told = False
    with console.counting("simulating", materials, "Mwalks/s", before) as show:

        def progress(done: int) -> None:
            nonlocal told
            rate = show(done, (done - before) * walks / 1e6)
            if rate and not told:
                left = (materials - done) * walks / (1e6 * rate)
                console.say(f"{_span(left)} to go at {rate:.1f} million walks per second")
                told = True

        data.write(progress)
    console.say(f"{output}: complete, {materials} materials")


def _span(seconds: float) -> str:
    """Formats a time in the largest unit (days, hours, minutes or seconds) in which its value is at least 2."""
    for unit, size in (("days", 86_400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} seconds"
