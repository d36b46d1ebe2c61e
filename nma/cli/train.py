"""The command `nma train`: trains an adapter for a whole class of materials."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from nma import files
from nma.cli import console, options, training


def register(app: typer.Typer) -> None:
    app.command()(train)


def train(
    class_name: Annotated[str, typer.Argument(help="The class to learn, layered3.")],
    output: options.Weights,
    data: Annotated[
        Path | None,
        typer.Option(help="A dataset made by `nma dataset`.", parser=options.path),
    ] = None,
    stream: Annotated[
        int,
        options.number(
            "Without a dataset: simulate this many materials, keep them in memory, and replace them all the time.",
            0,
            100_000,
        ),
    ] = 0,
    walks: Annotated[int, options.walks("Walks per streamed material.")] = 819_200,
    refresh: Annotated[
        int, options.number("Steps from one replacement of streamed materials to the next.", 1, 10**9)
    ] = 400,
    preset: Annotated[
        str, options.choice("class: our recipe for classes. paper: the paper's recipe.", "class", "paper")
    ] = "class",
    variant: options.Variant = "blended+omega_i",
    instances: Annotated[
        int | None, options.number("How many Principled instances to blend, whatever the variant says.", 1, 5)
    ] = None,
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
    """Train an adapter for a whole class of materials.

    The same command continues a killed run from the checkpoint OUTPUT.ckpt.

    Example: [bold]nma dataset layered3 l3.zarr && nma train layered3 --data l3.zarr -o my.safetensors[/bold]
    """
    from nma import sources
    from nma.train.recipe import for_class
    from nma.train.run import train_class

    files.try_file(output)
    checkpoint = output.with_name(output.name + ".ckpt")
    files.try_file(checkpoint, console.loss_plot(output))
    space = sources.get(class_name).space
    recipe = for_class(
        space,
        preset,
        **training.of_variant(variant, target, instances),
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
    source, record = _training_data(class_name, data, stream, walks, recipe.seed)
    with console.TrainingBar(recipe) as bar:
        adapter, run = train_class(
            space, recipe, source, record, checkpoint=checkpoint, refresh=refresh, progress=bar.update
        )
    training.finish(adapter, run, output)
    checkpoint.unlink(missing_ok=True)


def _training_data(class_name: str, data: Path | None, stream: int, walks: int, seed: int):
    """Returns a dataset's tables, or the settings of a stream of materials, and a record of their origin."""
    from nma.table.dataset import Dataset, Settings

    if (data is None) == (stream == 0):
        raise typer.BadParameter("give either --data DATASET or --stream MATERIALS")
    if data is None:
        settings = Settings(class_name, stream, walks, seed)
        return settings, {"data": "stream", "dataset": asdict(settings)}
    dataset = Dataset.open(data)
    if dataset.settings.class_name != class_name:
        raise typer.BadParameter(
            f"{data} is a dataset of the class {dataset.settings.class_name}, not of {class_name}"
        )
    with console.err.status(f"reading {dataset.settings.materials} tables"):
        tables = dataset.load()
    return tables, {"data": "dataset", "dataset": asdict(dataset.settings)}
