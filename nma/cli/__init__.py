"""The command line: parse, call, print. No physics here; one file per group of commands."""

from __future__ import annotations

import sys

import typer

from nma.cli import data, datasets, learn, library, native, principled, system, view
from nma.errors import NmaError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Neural Material Adapter: expensive materials, translated into blends of Principled BRDFs "
    "by a tiny network.\n\n"
    "Start with [bold]nma demo[/bold] and [bold]nma materials[/bold]. Simulate with [bold]simulate[/bold] and "
    "[bold]dataset[/bold], learn with [bold]train[/bold], [bold]fit[/bold] and [bold]train-library[/bold], "
    "judge with [bold]evaluate[/bold] and [bold]compare[/bold], look with [bold]render[/bold]. [bold]data[/bold] lists "
    "measured materials, [bold]library[/bold] learns codes for more of them, [bold]principled[/bold] fits plain "
    "numbers, "
    "[bold]mitsuba build[/bold] compiles plugins for the scalar renderer.",
)
for group in (data, datasets, learn, library, principled, view, native, system):
    group.register(app)


def main() -> None:
    """Entry point of the `nma` command: expected errors become one line on stderr and exit status 1."""
    try:
        app()
    except NmaError as e:
        print(f"nma: {e}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print(
            "nma: interrupted; run the same command again to go on where it can be resumed", file=sys.stderr
        )
        sys.exit(130)
