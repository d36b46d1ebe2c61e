"""`nma mitsuba`: plugins for Mitsuba's scalar renderer."""

from __future__ import annotations

import typer

from nma.cli import console

mitsuba = typer.Typer(no_args_is_help=True, help="Plugins for Mitsuba's scalar renderer and its executable.")


def register(app: typer.Typer) -> None:
    app.add_typer(mitsuba, name="mitsuba")


@mitsuba.command()
def build() -> None:
    """Compile the BSDFs nma and layered for scalar_rgb and the installed Mitsuba. It takes about ten seconds, once."""
    from nma.native import build

    folder = build.build_mitsuba(console.say)
    console.say(
        f'In Python: nma.render.use("scalar_rgb"). On the command line: mitsuba -a {folder} -m scalar_rgb SCENE.xml'
    )
    print(folder)
