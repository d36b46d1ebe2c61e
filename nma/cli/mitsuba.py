"""The command `nma mitsuba`: compiles plugins for Mitsuba's scalar renderer."""

from __future__ import annotations

import typer

from nma.cli import console

mitsuba = typer.Typer(no_args_is_help=True, help="Plugins for Mitsuba's scalar renderer and its executable.")


def register(app: typer.Typer) -> None:
    app.add_typer(mitsuba, name="mitsuba")


@mitsuba.command()
def build() -> None:
    """Compile the BSDFs nma and layered as plugins for the variant scalar_rgb of the installed Mitsuba.

    The compilation takes about ten seconds, and is skipped if the plugins exist already.
    """
    from nma.native import build

    folder = build.build_mitsuba(console.say)
    console.say(
        f'In Python: nma.render.use("scalar_rgb"). On the command line: mitsuba -a {folder} -m scalar_rgb SCENE.xml'
    )
    print(folder)
