"""The command `nma evaluate`: compares an adapter with reference tables."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import RenderableType

from nma.cli import console, options

if TYPE_CHECKING:
    from nma.evaluate import Evaluation
    from nma.evaluate.brightness import Brightness


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
        print(json.dumps(_as_json(result)))
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
    console.out.print(_brightness(result))
    console.out.print(f"Non-reciprocity: {result.mean_non_reciprocity:.3f} of the reflected light.")
    if result.estimated_error:
        console.out.print(
            "The reference has no standard errors. Its noise floor is an upper bound, from the number of walks."
        )


def _brightness(result: Evaluation) -> RenderableType:
    """A table that says at which cosines the adapter is too bright (+) or too dark (-), over all materials."""
    from nma.evaluate.brightness import band_ends

    head = ("brightness [%]", *(f"{low:.1f} to {high:.1f}" for low, high in band_ends()))
    rows = [
        (f"over cos({name})", *(f"{100 * x:+.1f}" for x in errors))
        for name, errors in result.signed_of_all._asdict().items()
    ]
    return console.table(head, rows, "Signed error of brightness, by cosine")


def _as_json(result: Evaluation) -> dict[str, Any]:
    def entry(figures: dict[str, float], signed: Brightness, non_reciprocity: float) -> dict[str, Any]:
        bands = {f"signed_{name}": list(map(_number, errors)) for name, errors in signed._asdict().items()}
        return _finite(figures) | bands | {"non_reciprocity": non_reciprocity}

    each = zip(result.materials, result.signed, result.non_reciprocity, strict=True)
    return {
        "mean": entry(result.mean, result.signed_of_all, result.mean_non_reciprocity),
        "materials": [entry(*material) for material in each],
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _finite(figures: dict[str, float]) -> dict[str, float | None]:
    """The error figures with infinite values replaced by None, because JSON cannot express infinity.

    The PSNR of equal tables is infinite.
    """
    return {name: _number(value) for name, value in figures.items()}
