"""The command `nma fit`: trains an adapter for a single material."""

from __future__ import annotations

from typing import Annotated

import typer

from nma import files
from nma.cli import console, options, reading, training


def register(app: typer.Typer) -> None:
    app.command()(fit)


def fit(
    source: Annotated[
        str,
        typer.Argument(
            help="A named material or a material file (.toml), which are simulated; a file of values (.bsdf, "
            ".binary, .xml, NBRDF's .npz); or a reference file (.npz)."
        ),
    ],
    output: options.Weights,
    material: Annotated[
        str | None,
        typer.Option(
            help="Which material of an .npz file: the name of a network, or the number of a table, from 0."
        ),
    ] = None,
    walks: Annotated[int, options.walks("Random walks, if the material is simulated.")] = 64_000_000,
    variant: options.Variant = "blended+omega_i",
    network: options.Network = None,
    target: options.Target = None,
    steps: options.Steps = None,
    points: options.Points = None,
    points_law: options.PointsLaw = None,
    finest: options.Finest = None,
    loss: options.Loss = None,
    dim: options.Dim = None,
    albedo: options.Albedo = None,
    learning_rate: options.Rate = None,
    seed: options.TrainingSeed = 0,
) -> None:
    """Train a small network for a single material, from values of its BRDF or from its table.

    docs/bring-your-own.md describes the sources of BRDF values.

    Examples: [bold]nma fit gold-red-lacquer -o gold.safetensors[/bold],
    [bold]nma fit paper_white_rgb.bsdf -o paper.safetensors[/bold]
    """
    from nma.table import Tables
    from nma.train.fit import fit as fit_one
    from nma.train.fit import recipe_for
    from nma.train.run import fit_material

    files.try_file(output, console.loss_plot(output))
    known, record = reading.known_of(source, material, walks, seed)
    recipe = recipe_for(
        known,
        **training.of_variant(variant, target),
        network=network,
        steps=steps,
        points=points,
        points_law=points_law,
        finest=finest,
        loss=loss,
        dim=dim,
        albedo=albedo,
        learning_rate=learning_rate,
        seed=seed,
    )
    with console.TrainingBar(recipe) as bar:
        if isinstance(known, Tables) and known.space.size:
            params = known.params[0]
            adapter, run = fit_material(known.space, recipe, params, known, record, progress=bar.update)
        else:
            adapter, run = fit_one(known, recipe, record, progress=bar.update)
    training.finish(adapter, run, output)
    if not isinstance(known, Tables):
        _compare(adapter, known)


def _compare(adapter, source) -> None:
    """Prints the error of the adapter against the BRDF values of its source."""
    from nma.adapter.values import AdapterValues
    from nma.evaluate.pairs import PAIRS, compare

    figures = compare(AdapterValues(adapter), source)
    listed = ", ".join(f"{name} {value:.5f}" for name, value in figures.items())
    console.say(f"against {source.name} at {PAIRS:,} pairs of directions: {listed}")
