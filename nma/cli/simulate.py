"""`nma materials`, `simulate`, `dataset`: what there is, and what it looks like when simulated."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from nma import files
from nma.cli import console, options
from nma.errors import TableError

if TYPE_CHECKING:
    from nma.materials import Material, Texture
    from nma.table import Tables


def register(app: typer.Typer) -> None:
    app.command()(materials)
    app.command()(simulate)
    app.command()(dataset)


def materials(
    name: Annotated[
        str | None,
        typer.Argument(help="Show this material's parameters, or those of a material file (.toml)."),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print JSON on stdout and nothing else there: all digits, for programs."),
    ] = False,
) -> None:
    """List the named materials, or show one of them."""
    from nma import materials as library

    if name is None:
        known = [library.load(n) for n in library.names()]
        if as_json:
            print(json.dumps([_facts(m) for m in known]))
            return
        listed = [(m.name, m.title, m.description) for m in known]
        console.out.print(console.table(("name", "title", "description"), listed))
        return
    material = library.load(name)
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


def simulate(
    output: Annotated[Path, options.output("The reference file to write.", ".npz")],
    params: Annotated[
        Path | None, typer.Option(help="A file (.npz) with `params` (n, 13), a reference file for example.")
    ] = None,
    material: Annotated[
        list[str] | None, typer.Option(help="A named material or material file; may be repeated.")
    ] = None,
    draw: Annotated[int, options.number("Draw this many materials at random instead.", 0, 100_000)] = 0,
    population: Annotated[
        str, options.choice("Where drawn conductors come from.", *options.POPULATIONS)
    ] = "mixed",
    class_name: Annotated[
        str, typer.Option("--class", help="The class of the source materials.")
    ] = "layered3",
    walks: Annotated[int, options.walks("Random walks per material.")] = 16_000_000,
    seed: Annotated[int, options.seed("Seed of the walks and of the drawn materials.")] = 0,
) -> None:
    """Simulate materials and write their tables with standard errors: a reference file.

    Example: [bold]nma simulate --material gold-red-lacquer --walks 128000000 -o gold.npz[/bold]
    """
    from nma import sources
    from nma.table import Tables, kept, stream_keys, tabulate

    files.try_file(output)
    # Finished materials wait beside the output, so that a killed run goes on where it stopped.
    parts = output.with_name(output.name + ".parts")
    files.try_folder(parts)
    source = sources.get(class_name)
    vectors = _vectors(source.space, params, material, draw, population, seed)
    tables: list[Tables] = []
    walked = 0

    def walk(vector: NDArray[np.float64], key: np.uint64) -> Tables:
        nonlocal walked
        walked += walks
        return tabulate(source, vector[None], walks, np.array([key]))

    with console.progress("Mwalks/s") as bar:
        task = bar.add_task("simulating", total=len(vectors), rate="", note="")
        began = time.perf_counter()
        for vector, key in zip(vectors, stream_keys(seed, range(len(vectors))), strict=True):
            part = parts / f"{key:016x}-{walks}.npz"
            tables.append(kept(part, partial(walk, vector, key), vector[None]))
            rate = walked / (time.perf_counter() - began) / 1e6
            bar.update(task, completed=len(tables), rate=f"{rate:.1f}")
    Tables.concatenate(tables).save(output)
    shutil.rmtree(parts, ignore_errors=True)
    console.say(f"{output}: {len(vectors)} material(s), {walks:,} walks each")


def dataset(
    class_name: Annotated[str, typer.Argument(help="The class to sample, layered3.")],
    output: Annotated[Path, typer.Argument(help="The dataset (.zarr folder) to create or complete.")],
    materials: Annotated[int, options.number("Number of materials.", 1, 10**6)] = 8000,
    walks: Annotated[int, options.walks("Random walks per material.")] = 819_200,
    seed: Annotated[int, options.seed("Equal seeds give equal datasets.")] = 0,
    population: Annotated[
        str, options.choice("Where conductors come from.", *options.POPULATIONS[:-1])
    ] = "mixed",
) -> None:
    """Sample a class into a dataset for training. Resumes what was killed; several workers may write one dataset."""
    from nma.table.dataset import Dataset, Settings

    files.try_folder(output)
    data = Dataset.create(output, Settings(class_name, materials, walks, seed, population))  # type: ignore[arg-type]
    before = materials - len(data.missing())
    with console.progress("Mwalks/s") as bar:
        task = bar.add_task("simulating", total=materials, completed=before, rate="", note="")
        began, told = time.perf_counter(), False

        def progress(done: int) -> None:
            nonlocal told
            rate = (done - before) * walks / (time.perf_counter() - began) / 1e6
            bar.update(task, completed=done, rate=f"{rate:.1f}")
            if rate and not told:
                left = (materials - done) * walks / (1e6 * rate)
                console.say(f"{_span(left)} to go at {rate:.1f} million walks per second")
                told = True

        data.write(progress)
    console.say(f"{output}: complete, {materials} materials")


def _span(seconds: float) -> str:
    """So long, in the unit that suits it."""
    for unit, size in (("days", 86_400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} seconds"


def _vectors(space, params, material, draw, population, seed):
    """The parameter vectors that `simulate` was asked for, from exactly one of its three sources."""
    if (params is not None) + bool(material) + bool(draw) != 1:
        raise typer.BadParameter("give exactly one of --params, --material and --draw")
    if params is not None:
        try:
            with files.arrays(params) as f:
                vectors = np.asarray(f["params"], np.float64)
        except Exception as e:  # zipfile raises a kind of its own for damaged archives
            raise TableError(
                f"{params}: no .npz file with an array `params` (n, {space.size}): {e}"
            ) from None
        return space.check(vectors)
    if material:
        from nma import materials as library

        return np.stack([library.load(m).vector() for m in material])
    return space.sample(np.random.default_rng(seed), draw, population)


def _facts(material: Material) -> dict[str, Any]:
    """A material for other programs: its vector in the order of the class, null where images drive it, and by name."""
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
