"""The command `nma evaluate`: compares an adapter with reference tables."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from nma.cli import console, options


def register(app: typer.Typer) -> None:
    app.command()(evaluate)


def evaluate(
    weights: Annotated[str, typer.Argument(help="A weights file or the name of a shipped adapter.")],
    reference: Annotated[
        Path,
        typer.Option(help="A reference file made by `nma simulate`.", parser=options.path),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print nothing but JSON on stdout.")] = False,
    clamp: options.Clamp = False,
) -> None:
    """Compare an adapter with reference tables, bin by bin, and print the errors of each material and their means.

    The adapter is averaged over each bin by numerical integration, whose error is printed below the table. The page
    docs/evaluation.md defines the printed errors.
    """
    from nma.adapter import Adapter
    from nma.evaluate import evaluate as run
    from nma.evaluate.metrics import FIGURES
    from nma.table import Tables
    from nma.table.grid import check_class

    adapter = Adapter.load(weights)
    tables = Tables.load(reference)
    check_class(tables.class_name, adapter.space.name, weights, f"{reference}: ")
    with console.counting("evaluating", len(tables.params), "materials/s", digits=2) as show:
        result = run(adapter, tables, lambda done: show(done, done), clamp=clamp)
    if as_json:
        print(json.dumps({"mean": _finite(result.mean), "materials": [_finite(m) for m in result.materials]}))
        return
    rows = [(str(n), *(m[f] for f in FIGURES)) for n, m in enumerate(result.materials)]
    rows.append(("mean", *(result.mean[f] for f in FIGURES)))
    console.out.print(
        console.table(("material", *FIGURES), rows, f"{weights} ({adapter.variant}) against {reference}")
    )
    console.out.print(
        f"The adapter's bin averages are exact to {result.integration_error:.1e} in log loss, "
        f"its albedos to {result.albedo_integration_error:.1e}."
    )
    if result.estimated_error:
        console.out.print(
            "The reference has no standard errors. Its noise floor is an upper bound, from the number of walks."
        )


def _finite(figures: dict[str, float]) -> dict[str, float | None]:
    """The error figures with infinite values replaced by None, because JSON cannot express infinity.

    The PSNR of equal tables is infinite.
    """
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}
