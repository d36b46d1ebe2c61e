"""`nma train`, `fit`, `evaluate`: learning adapters, and judging them."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from nma import files
from nma.cli import console, options
from nma.params import LAYERED3

_Seed = Annotated[int, options.seed("Seed of the weights, of the batches and of a simulated table.")]
_Points = Annotated[int | None, options.number("Points per bin of the AvA estimate (eq. 6).", 1, 4096)]
_PointsLaw = Annotated[
    str | None,
    options.choice(
        "Where points lie: centre is point supervision, uniform the paper's.", *options.POINTS_LAWS
    ),
]
_Target = Annotated[
    str | None,
    options.choice(
        "The first has the paper's 11 numbers, the second stretches lobes along the plane of incidence, the third "
        "lets them fade out, too, the last does the same along the surface's axes.",
        *options.TARGETS,
    ),
]
_Albedo = Annotated[
    float | None, options.number("Weight of the error of the directional albedo; 0: none.", 0, 1e6)
]
_Finest = Annotated[float | None, options.number("Microfacet width down to which points crowd.", 1e-6, 1)]
_Loss = Annotated[str | None, options.choice("log is the paper's eq. 7.", *options.LOSSES)]


def register(app: typer.Typer) -> None:
    app.command()(train)
    app.command()(fit)
    app.command()(evaluate)


def train(
    class_name: Annotated[str, typer.Argument(help="The class to learn, layered3.")],
    output: options.Weights,
    data: Annotated[Path | None, typer.Option(help="A dataset made by `nma dataset`.")] = None,
    stream: Annotated[
        int,
        options.number(
            "Without a dataset: keep this many fresh materials in memory, replaced as training goes on.",
            0,
            100_000,
        ),
    ] = 0,
    walks: Annotated[int, options.walks("Walks per streamed material.")] = 819_200,
    refresh: Annotated[
        int, options.number("Steps between two exchanges of streamed materials.", 1, 10**9)
    ] = 400,
    preset: Annotated[
        str, options.choice("Our recipe for classes, or the paper's.", "class", "paper")
    ] = "class",
    variant: options.Variant = "blended+omega_i",
    instances: Annotated[
        int | None, options.number("Principled instances in the blend, instead of the variant's.", 1, 5)
    ] = None,
    network: options.Network = None,
    target: _Target = None,
    steps: options.Steps = None,
    points: _Points = None,
    points_law: _PointsLaw = None,
    finest: _Finest = None,
    loss: _Loss = None,
    albedo: _Albedo = None,
    learning_rate: options.Rate = None,
    seed: _Seed = 0,
) -> None:
    """Train an adapter for a whole class. A killed run goes on from its checkpoint (OUTPUT.ckpt).

    Example: [bold]nma dataset layered3 l3.zarr && nma train layered3 --data l3.zarr -o my.safetensors[/bold]
    """
    from nma import sources
    from nma.train import recipe as recipes
    from nma.train import run as training

    files.try_file(output)
    checkpoint = output.with_name(output.name + ".ckpt")
    files.try_file(checkpoint, console.loss_plot(output))
    lobes, directional = options.VARIANTS[variant]
    recipe = recipes.preset(
        preset,
        network=network,
        target=target or _target(directional),
        steps=steps,
        points=points,
        points_law=points_law,
        finest=finest,
        loss=loss,
        albedo=albedo,
        learning_rate=learning_rate,
        seed=seed,
        instances=instances or lobes,
        directional=directional,
    )
    space = sources.get(class_name).space
    source, record = _training_data(class_name, data, stream, walks, recipe.seed)
    with console.TrainingBar(recipe) as bar:
        adapter, run = training.train_class(
            space, recipe, source, record, checkpoint=checkpoint, refresh=refresh, progress=bar.update
        )
    _finish(adapter, run, output)
    checkpoint.unlink(missing_ok=True)


def fit(
    source: Annotated[
        str,
        typer.Argument(
            help="A named material or a material file (.toml), which is simulated; a file of values (.bsdf, .binary, "
            ".xml, NBRDF's .npz); or a reference file (.npz)."
        ),
    ],
    output: options.Weights,
    material: Annotated[
        str | None,
        typer.Option(
            help="Which material of a file that holds several: a name, or a number in a reference file."
        ),
    ] = None,
    walks: Annotated[int, options.walks("Walks of the table of a simulated material.")] = 64_000_000,
    variant: options.Variant = "blended+omega_i",
    network: options.Network = None,
    target: _Target = None,
    steps: options.Steps = None,
    points: _Points = None,
    points_law: _PointsLaw = None,
    finest: _Finest = None,
    loss: _Loss = None,
    albedo: _Albedo = None,
    learning_rate: options.Rate = None,
    seed: _Seed = 0,
) -> None:
    """Overfit one material: train a small network on its values, or on its table. See docs/bring-your-own.md.

    Examples: [bold]nma fit gold-red-lacquer -o gold.safetensors[/bold],
    [bold]nma fit paper_white_rgb.bsdf -o paper.safetensors[/bold]
    """
    from nma.cli.material import read
    from nma.table import Tables
    from nma.train import run as training
    from nma.train.fit import fit as fit_one
    from nma.train.fit import recipe_for

    files.try_file(output)
    files.try_file(console.loss_plot(output))
    known, record = read(source, material, walks, seed)
    lobes, directional = options.VARIANTS[variant]
    recipe = recipe_for(
        known,
        network=network,
        target=target or _target(directional),
        steps=steps,
        points=points,
        points_law=points_law,
        finest=finest,
        loss=loss,
        albedo=albedo,
        learning_rate=learning_rate,
        seed=seed,
        instances=lobes,
        directional=directional,
    )
    with console.TrainingBar(recipe) as bar:
        if isinstance(known, Tables) and known.params.shape[1] == LAYERED3.size:
            adapter, run = training.fit_material(
                LAYERED3, recipe, known.params[0], known, record, progress=bar.update
            )
        else:
            adapter, run = fit_one(known, recipe, record, progress=bar.update)
    _finish(adapter, run, output)
    if not isinstance(known, Tables):
        _compare(adapter, known)


def evaluate(
    weights: Annotated[str, typer.Argument(help="A weights file or the name of a shipped adapter.")],
    reference: Annotated[Path, typer.Option(help="A reference file made by `nma simulate`.")],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON on stdout and nothing else there.")
    ] = False,
    clamp: Annotated[
        bool,
        typer.Option("--clamp", help="Move parameters beyond the adapter's training range to the range."),
    ] = False,
) -> None:
    """Compare an adapter with reference tables over the paper's bins: means over bins and RGB, then over materials.

    The adapter's own bin averages are integrated with points in every bin and samples of its narrow lobes; the line
    below the table says how exact they are. See docs/evaluation.md for every figure's formula.
    """
    from nma.adapter import Adapter
    from nma.evaluate import evaluate as run
    from nma.evaluate.metrics import FIGURES
    from nma.table import Tables

    adapter = Adapter.load(weights)
    tables = Tables.load(reference)
    with console.progress("materials/s") as bar:
        task = bar.add_task("evaluating", total=len(tables.params), rate="", note="")
        began = time.perf_counter()

        def progress(done: int) -> None:
            bar.update(task, completed=done, rate=f"{done / (time.perf_counter() - began):.2f}")

        result = run(adapter, tables, progress, clamp=clamp)
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
            "The reference has no standard errors; its noise floor is an upper bound from counting walks."
        )


def _compare(adapter, source) -> None:
    """Says how far the adapter is from a source with values."""
    from nma.adapter.values import AdapterValues
    from nma.evaluate.pairs import PAIRS, compare

    figures = compare(AdapterValues(adapter), source)
    listed = ", ".join(f"{name} {value:.5f}" for name, value in figures.items())
    console.say(f"against {source.name} at {PAIRS:,} pairs of directions: {listed}")


def _finite(figures: dict[str, float]) -> dict[str, float | None]:
    """The figures for JSON, which has no infinity: the PSNR of equal tables becomes null."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


def _target(directional: bool) -> str | None:
    """The target that a variant needs whatever the preset says: without wi there is no plane to stretch along."""
    return None if directional else "principled"


def _training_data(class_name: str, data: Path | None, stream: int, walks: int, seed: int):
    """(tables of a dataset, or the settings of a stream; record of their origin)."""
    from nma.table.dataset import Dataset, Settings

    if (data is None) == (stream == 0):
        raise typer.BadParameter("give either --data DATASET or --stream MATERIALS")
    if data is None:
        settings = Settings(class_name, stream, walks, seed)
        return settings, {"data": "stream", "dataset": asdict(settings)}
    dataset = Dataset.open(data)
    if dataset.settings.class_name != class_name:
        raise typer.BadParameter(f"{data} holds class {dataset.settings.class_name}, not {class_name}")
    with console.err.status(f"reading {dataset.settings.materials} tables"):
        tables = dataset.load()
    return tables, {"data": "dataset", "dataset": asdict(dataset.settings)}


def _finish(adapter, run, output: Path) -> None:
    """Writes weights and loss plot, and says so."""
    from nma.train.plot import plot_losses

    adapter.save(output)
    plot = plot_losses(run.log_losses, console.loss_plot(output), output.name)
    console.say(
        f"{output}: {adapter.variant}, {run.step} steps in {run.seconds:.0f} s, "
        f"log loss of the last steps {np.mean(run.log_losses[-500:]):.5f} (against noisy bins); losses in {plot}"
    )
