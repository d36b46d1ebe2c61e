"""The command `nma materials`: lists the named materials, or prints the parameters of one material."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nma.cli import console

if TYPE_CHECKING:
    from nma.materials import Material, Texture


def register(app: typer.Typer) -> None:
    app.command()(materials)


def materials(
    name: Annotated[
        str | None,
        typer.Argument(help="A named material or a material file (.toml), whose parameters are shown."),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print nothing but JSON on stdout: numbers with all digits, for programs."
        ),
    ] = False,
) -> None:
    """List the named materials, or print the parameters of one material."""
    from nma import materials as named

    if name is None:
        known = [named.load(n) for n in named.names()]
        if as_json:
            print(json.dumps([_facts(m) for m in known]))
            return
        listed = [(m.name, m.title, m.description) for m in known]
        console.out.print(console.table(("name", "title", "description"), listed))
        return
    material = named.load(name)
    if as_json:
        print(json.dumps(_facts(material)))
        return
    rows = [
        (p.name, p.symbol, f"{p.low:g} .. {p.high:g}", _show(material.values[p.name]))
        for p in material.space.params
    ]
    console.out.print(
        console.table(
            ("parameter", "symbol", "range", "value"), rows, f"{material.title}: {material.description}"
        )
    )


def _facts(material: Material) -> dict[str, Any]:
    """A material as JSON data for other programs.

    `parameters` is the parameter vector in the order of the class, or None if a parameter comes from an image.
    """
    from nma.materials import Texture

    values = {
        name: {**asdict(value), "parameter": name, "path": str(value.path)}
        if isinstance(value, Texture)
        else value
        for name, value in material.values.items()
    }
    return {
        "name": material.name,
        "title": material.title,
        "description": material.description,
        "class": material.class_name,
        "parameters": None if material.textures else material.vector().tolist(),
        "values": values,
    }


def _show(value: float | tuple[float, ...] | Texture) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{x:.4g}" for x in value)
    return f"{value:.4g}" if isinstance(value, float) else value.path.name
