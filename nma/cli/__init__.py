"""Parses the arguments of the command `nma`, calls the other rooms, and prints their results.

Each command is implemented in a file of the same name. Commands that share a first word, such as `nma library list` and
`nma library encode`, share one file. To add a command, write a file with a function `register`, and add the file's name
to `COMMANDS`.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

import nma
from nma.cli import signals
from nma.errors import NmaError, one_line
from nma.files import close_stdout


class _Commands(TyperGroup):
    """The group of all commands, which prints a message on Ctrl-C; typer alone prints none."""

    def invoke(self, ctx: Any) -> Any:
        try:
            with signals.handled(lambda: _interruption(ctx.invoked_subcommand)):
                return super().invoke(ctx)
        # In a thread, where no signal is handled, the code that started the thread may raise a KeyboardInterrupt.
        except KeyboardInterrupt:
            _interrupted(ctx.invoked_subcommand)


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Neural Material Adapter: replaces the simulation of layered materials by a tiny network and a blend of "
    "Principled BRDFs.\n\n"
    "Start with [bold]nma demo[/bold] and [bold]nma materials[/bold]. [bold]simulate[/bold] and [bold]dataset[/bold] "
    "simulate materials. [bold]train[/bold], [bold]fit[/bold] and [bold]train-library[/bold] train adapters. "
    "[bold]evaluate[/bold] and [bold]compare[/bold] measure errors. [bold]render[/bold] renders pictures. "
    "[bold]data[/bold] lists measured materials. [bold]library[/bold] adds materials to a library and extracts them. "
    "[bold]principled[/bold] fits one Principled BRDF with constant parameters. [bold]mitsuba build[/bold] compiles "
    "plugins for Mitsuba's scalar renderer.",
)
# The files of this folder that define commands, in the order of `nma --help`, which lists single commands before groups
# of commands.
COMMANDS = (
    "materials",
    "simulate",
    "dataset",
    "data",
    "train",
    "fit",
    "evaluate",
    "library",
    "principled",
    "render",
    "compare",
    "demo",
    "mitsuba",
    "info",
    "doctor",
)
# The commands that store results while they run, and continue from these results when they are run again.
RESUMING = ("simulate", "dataset", "train", "train-library")
for name in COMMANDS:
    import_module(f"nma.cli.{name}").register(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"nma {nma.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """The entry point of the program `nma`. Expected errors are printed as one line on stderr, with exit status 1."""
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except NmaError as e:
        _fail(str(e))
    except BrokenPipeError:
        close_stdout()
        sys.exit(1)
    except OSError as e:
        close_stdout()
        _fail(f"{e.filename}: {e.strerror}" if e.filename else str(e))
    except (MemoryError, RuntimeError) as e:
        # If memory runs out, Dr.Jit and JAX raise a RuntimeError.
        if isinstance(e, RuntimeError) and "out of memory" not in str(e).lower():
            raise
        _fail(
            f"out of memory ({one_line(str(e))}); ask for less at a time: fewer pixels, materials or points"
        )
    except KeyboardInterrupt:
        _interrupted(None)


def _fail(message: str) -> NoReturn:
    print(f"nma: {message}", file=sys.stderr)
    sys.exit(1)


def _interruption(command: str | None) -> str:
    """What to print when a command is interrupted."""
    advice = (
        "run the same command again to continue from its stored results"
        if command in RESUMING
        else "unfinished results were not written; run the command again"
    )
    return f"interrupted; {advice}"


def _interrupted(command: str | None) -> NoReturn:
    """Ends the command after a `KeyboardInterrupt` that no signal handler of `nma.cli.signals` has replaced."""
    print(f"nma: {_interruption(command)}", file=sys.stderr)
    sys.exit(130)
