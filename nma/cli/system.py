"""`nma info`, `doctor`: what a weights file says, and what the machine lacks."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from nma.cli import console


def register(app: typer.Typer) -> None:
    app.command()(info)
    app.command()(doctor)


def info(
    weights: Annotated[str | None, typer.Argument(help="A weights file or a shipped adapter's name.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show what a weights file says about itself: class, network, ranges, training. Without one, list those shipped."""
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
            console.out.print(console.table((name, ""), [(k, str(v)) for k, v in value.items()]))
        else:
            console.out.print(f"[bold]{name}[/bold]: {value}")


def doctor() -> None:
    """Check that everything the package needs is there; print the command that mends what is not."""
    from nma.doctor import check

    findings = check()
    rows = [
        (f.name, "ok" if f.ok else "optional" if f.optional else "MISSING", f.found, "" if f.ok else f.fix)
        for f in findings
    ]
    console.out.print(console.table(("what", "state", "found", "to mend it"), rows))
    if not all(f.ok or f.optional for f in findings):
        raise typer.Exit(1)
