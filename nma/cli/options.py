"""Options that several commands share. Numbers have a smallest and a largest value, where they are declared."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def number(help: str, low: float, high: float, **more: Any) -> Any:
    """A number between two bounds, both included; NaN lies outside."""
    return typer.Option(min=low, max=high, help=help, callback=_no_nan, **more)


def _no_nan(value: float | None) -> float | None:
    """Which no bounds of typer's keep out, in some of its versions."""
    if value is not None and value != value:
        raise typer.BadParameter("NaN is no number between the bounds")
    return value


def walks(help: str) -> Any:
    return number(help, 1, 10**12)


def seed(help: str) -> Any:
    return number(help, 0, 2**32 - 1)


def samples(help: str, **more: Any) -> Any:
    """Samples per pixel."""
    return number(help, 1, 2**16, **more)


def exposure(help: str) -> Any:
    return number(help, -32, 32)


def choice(help: str, *values: str) -> Any:
    """One of some words."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in values:
            raise typer.BadParameter(f"'{value}' is not one of {', '.join(values)}")
        return value

    return typer.Option(help=f"{', '.join(values)}. {help}", callback=check)


def output(help: str, *endings: str, **more: Any) -> Any:
    """A file to write, whose name ends as those do that read it."""

    def check(path: Path | None) -> Path | None:
        if path is not None and path.suffix not in endings:
            raise typer.BadParameter(f"{path} must end in {' or '.join(endings)}")
        return path

    return typer.Option("--output", "-o", help=help, callback=check, **more)


def _network(name: str | None) -> str | None:
    """Refused at once rather than after the simulation of a material."""
    if name is not None:
        from nma.network import hidden

        hidden(name)
    return name


_STEPS = number("Number of optimisation steps.", 1, 10**9)
_RATE = number("Learning rate of Adam, its peak under the one-cycle schedule.", 1e-9, 10)

Steps = Annotated[int | None, _STEPS]
Rate = Annotated[float | None, _RATE]
# As `nma.train.recipe.Recipe` and `nma.params` declare them.
TARGETS = ("principled", "stretched", "measured", "anisotropic")
POINTS_LAWS = ("crowded", "uniform", "centre")
LOSSES = ("huber", "log")
POPULATIONS = ("mixed", "range", "metals", "held_out_metals", "unseen_metals")
# Of the paper: how many instances, and whether they follow the view direction.
VARIANTS = {"blended+omega_i": (2, True), "blended": (2, False), "omega_i": (1, True), "single": (1, False)}

Variant = Annotated[str, choice("Whether two instances are blended, and follow the direction.", *VARIANTS)]
Network = Annotated[
    str | None,
    typer.Option(help="Hidden layers, DEPTHxWIDTH, for example 5x64 or 3x32.", callback=_network),
]
Weights = Annotated[Path, output("The weights file to write.", ".safetensors")]
