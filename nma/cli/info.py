"""The command `nma info`: prints the contents of a weights file."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from nma.cli import console

_ABOUT_THE_LOSS = (
    "The log loss of the training includes the noise of the training tables. "
    "`nma evaluate` prints the error of an adapter against a reference, and the noise of the reference."
)


def register(app: typer.Typer) -> None:
    app.command()(info)


def info(
    weights: Annotated[str | None, typer.Argument(help="A shipped adapter's name or a weights file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the class, the network, the ranges and the training of a weights file; or list the shipped adapters."""
    from nma import network
    from nma.adapter import Adapter, shipped
    from nma.target.principled import DIALECT

    if weights is None:
        rows = [
            (name, Adapter.load(name).variant, network.parameters(Adapter.load(name).layers))
            for name in shipped()
        ]
        console.out.print(console.table(("adapter", "variant", "parameters"), rows))
        return
    adapter = Adapter.load(weights)
    facts = {
        "class": adapter.space.name,
        "variant": adapter.variant,
        "reciprocal": adapter.reciprocal,
        "bounded": adapter.bounded,
        "dialect": DIALECT,
        "encoding": adapter.encoding,
        "layers": [list(m.shape) for m, _ in adapter.layers],
        "numbers in the network": network.parameters(adapter.layers),
        "parameters": {p.name: [p.low, p.high] for p in adapter.space.params},
        "target": {p.name: [p.low, p.high, p.scale] for p in adapter.target},
        "training": adapter.training,
    }
    if as_json:
        print(json.dumps(facts))
        return
    for name, value in facts.items():
        if isinstance(value, dict):
            console.out.print("", console.table((name, ""), [(k, _plain(v)) for k, v in value.items()]))
        else:
            console.out.print(f"[bold]{name}[/bold]: {_plain(value)}", highlight=False)
    if {"dataset", "walks_per_material"} & set(adapter.training):
        console.out.print()
        console.out.print(_ABOUT_THE_LOSS, highlight=False)


def _plain(value: Any) -> str:
    """Formats a value for printing: numbers with four significant digits, lists without brackets."""
    if isinstance(value, float):
        return console.number(value)
    if isinstance(value, dict):
        return ", ".join(f"{name} {_plain(v)}" for name, v in value.items())
    if isinstance(value, list) and value and isinstance(value[0], list):
        return ", ".join(" x ".join(map(str, shape)) for shape in value)
    if isinstance(value, list):
        return ", ".join(map(_plain, value))
    return str(value)
