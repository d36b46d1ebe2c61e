"""The commands `nma train-library` and `nma library` for libraries, that is, networks that many materials share."""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from nma import files
from nma.cli import console, options, training

library = typer.Typer(
    no_args_is_help=True,
    help="List the materials of a library, add one, or write one as an adapter of its own.",
)

_Library = Annotated[
    Path,
    typer.Argument(metavar="LIBRARY", help="A library that `nma train-library` made.", parser=options.path),
]


def register(app: typer.Typer) -> None:
    app.command("train-library")(train_library)
    app.add_typer(library, name="library")


def train_library(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            help="A folder with files of values, or a single such file, for example NBRDF weights (.npz).",
            parser=options.path,
        ),
    ],
    output: options.Weights,
    network: options.Network = None,
    steps: options.Steps = None,
    learning_rate: options.Rate = None,
    seed: Annotated[int, options.seed("Seed of codes, weights and batches.")] = 0,
) -> None:
    """Train a library: one small network for many materials, and a code for each material (paper Fig. 12).

    The same command continues a killed run from the tables in OUTPUT.tables and the checkpoint OUTPUT.ckpt.

    Example: [bold]nma train-library ~/merl -o library.safetensors[/bold]
    """
    from nma.table import collection
    from nma.train import library as learning

    files.try_file(output)
    kept, checkpoint = (output.with_name(output.name + ending) for ending in (".tables", ".ckpt"))
    files.try_file(checkpoint, console.loss_plot(output))
    files.try_folder(kept)
    members = collection.members(source)
    names = [member.name for member in members]
    given: dict[str, Any] = {"network": network, "steps": steps, "learning_rate": learning_rate, "seed": seed}
    recipe = replace(learning.RECIPE, **{k: v for k, v in given.items() if v is not None})
    with console.counting("tabulating", len(members), "materials/s", digits=2) as show:
        tables = collection.tables(members, kept, lambda done: show(done, done, note=names[done - 1]))
    record: dict[str, Any] = {"data": collection.origin(members), "materials": len(members)}
    record["tables"] = hashlib.sha256("\n".join(names).encode() + tables.values.tobytes()).hexdigest()[:16]
    with console.TrainingBar(recipe) as training_bar:
        made, run = learning.train_library(
            names, tables, recipe, record, checkpoint=checkpoint, progress=training_bar.update
        )
    made.save(output)
    loss, plot = training.losses(run, output)
    checkpoint.unlink(missing_ok=True)
    console.say(
        f"{output}: {run.step} steps in {run.seconds:.0f} s, log loss of the last steps {loss:.5f}; losses in {plot}"
    )
    console.tell(
        f"{len(names)} materials ({record['data']}), {made.parameters:,} parameters: {made.codes.size:,} of codes, "
        f"{made.parameters - made.codes.size:,} of the network"
    )


@library.command("list")
def listing(path: _Library) -> None:
    """List the names of the materials of a library."""
    from nma.adapter.library import Library

    for name in Library.load(path).names:
        console.tell(name)


@library.command()
def encode(
    path: _Library,
    source: Annotated[
        Path,
        typer.Argument(help="A file with the values of the new material.", parser=options.path),
    ],
    output: Annotated[Path, options.output("The library to write, with one more material.", ".safetensors")],
    material: Annotated[
        str | None, typer.Option(help="Which material, if the file contains several.")
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(help="The name of the new material; by default --material, or the name of the file."),
    ] = None,
    steps: options.Steps = None,
    seed: Annotated[int, options.seed("Seed of the batches.")] = 0,
) -> None:
    """Find the code of a new material for the unchanged network, and write a library that also contains this code.

    Example: [bold]nma library encode library.safetensors paper_white_rgb.bsdf -o more.safetensors[/bold]
    """
    from nma import sources
    from nma.adapter.library import Library
    from nma.errors import ParamError
    from nma.table.values import tabulate_values
    from nma.train import library as learning

    files.try_file(output)
    known = Library.load(path)
    name = name or material or source.stem
    if name in known.names:
        raise ParamError(
            f"{path} already has a material '{name}'; give the new material another name with --name"
        )
    values = sources.read(source, material)
    with console.err.status(f"tabulating {values.name}"):
        tables = tabulate_values(values)
    recipe = replace(learning.ENCODING, seed=seed, steps=steps or learning.ENCODING.steps)
    began = time.perf_counter()
    with console.TrainingBar(recipe, "encoding") as bar:
        found = learning.encode(known, tables, recipe=recipe, progress=bar.update)
    known.add(name, found.code).save(output)
    console.say(f"{output}: {name} added in {time.perf_counter() - began:.0f} s")
    console.tell(
        f"{name}: log loss {found.log_loss:.5f}; the nearest of the library, {found.nearest}, has "
        f"{found.nearest_log_loss:.5f}"
    )


@library.command()
def extract(
    path: _Library,
    materials: Annotated[
        list[str],
        typer.Argument(help="The name of a material; or several NAME=WEIGHT, whose codes are mixed."),
    ],
    output: options.Weights,
) -> None:
    """Write one material of a library, or a mixture of several materials, as an adapter for a single material.

    Example: [bold]nma library extract library.safetensors brass=.7 blue-rubber=.3 -o mixed.safetensors[/bold]
    """
    from nma.adapter.library import Library

    files.try_file(output)
    known = Library.load(path)
    shares = dict(_share(text) for text in materials)
    code = known.mix(list(shares), list(shares.values()))
    known.material(code, " ".join(materials)).save(output)
    console.say(f"{output}: {' '.join(materials)}")


def _share(text: str) -> tuple[str, float]:
    """Parses NAME=WEIGHT: a material of the library and its weight in a mixture. Without =WEIGHT, the weight is 1."""
    name, equals, number = text.partition("=")
    try:
        return name, float(number) if equals else 1.0
    except ValueError:
        raise typer.BadParameter(
            f"'{text}' is not of the form NAME=WEIGHT, with a number as the weight"
        ) from None
