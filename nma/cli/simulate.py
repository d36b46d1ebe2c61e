"""The command `nma simulate`: simulates reference tables of materials."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nma import files
from nma.cli import console, options
from nma.errors import TableError, shown

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from nma.table import Tables


def register(app: typer.Typer) -> None:
    app.command()(simulate)


def simulate(
    output: Annotated[Path, options.output("The reference file to write.", ".npz")],
    params: Annotated[
        Path | None,
        typer.Option(
            help="A file (.npz) with an array `params` (n, columns of the class), as reference files have.",
            parser=options.path,
        ),
    ] = None,
    material: Annotated[
        list[str] | None, typer.Option(help="A named material or material file; may be repeated.")
    ] = None,
    draw: Annotated[int, options.number("Draw this many materials at random.", 0, 100_000)] = 0,
    population: Annotated[
        str, options.choice("Where drawn conductors come from.", *options.POPULATIONS)
    ] = "mixed",
    class_name: Annotated[
        str, typer.Option("--class", help="The class of --params and --draw.")
    ] = "layered3",
    walks: Annotated[int, options.walks("Random walks per material.")] = 16_000_000,
    seed: Annotated[int, options.seed("Seed of the walks and of the drawn materials.")] = 0,
) -> None:
    """Simulate materials, and write their tables and standard errors to a reference file.

    The same command continues a killed run from the tables in OUTPUT.parts.

    Example: [bold]nma simulate --material gold-red-lacquer --walks 128000000 -o gold.npz[/bold]
    """
    import numpy as np

    from nma import sources
    from nma.table import Tables, kept, stream_keys, tabulate

    files.try_file(output)
    # Every finished material is stored in a folder beside the output, so that the same command continues a killed run.
    parts = output.with_name(output.name + ".parts")
    files.try_folder(parts)
    source = sources.get(_class_of(material) if material else class_name)
    vectors = _vectors(source.space, params, material, draw, population, seed)
    tables: list[Tables] = []
    walked = 0

    def walk(vector: NDArray[np.float64], key: np.uint64) -> Tables:
        nonlocal walked
        walked += walks
        return tabulate(source, vector[None], walks, np.array([key]))

    with console.counting("simulating", len(vectors), "Mwalks/s") as show:
        for vector, key in zip(vectors, stream_keys(seed, range(len(vectors))), strict=True):
            part = parts / f"{source.space.name}-{key:016x}-{walks}.npz"
            tables.append(kept(part, partial(walk, vector, key), vector[None]))
            show(len(tables), walked / 1e6)
    Tables.concatenate(tables).save(output)
    _remove(parts)
    console.say(f"{output}: {len(vectors)} material(s), {walks:,} walks each")


def _remove(parts: Path) -> None:
    """Deletes the stored materials, and their folder unless the user has other files in it."""
    for pattern in ("*-????????????????-*.npz", ".nma-*.partial*"):
        for file in parts.glob(pattern):
            file.unlink(missing_ok=True)
    with suppress(OSError):
        parts.rmdir()


def _class_of(names: list[str]) -> str:
    """The class of the named materials; raises `BadParameter` if they belong to several classes."""
    from nma import materials

    classes = sorted({materials.load(name).class_name for name in names})
    if len(classes) > 1:
        raise typer.BadParameter(
            f"the materials belong to the classes {', '.join(classes)}; simulate one class at a time"
        )
    return classes[0]


def _vectors(space, params, material, draw, population, seed):
    """The parameter vectors to simulate, which the user selects by exactly one of --params, --material and --draw."""
    import numpy as np

    from nma import sources
    from nma.table.grid import class_entry

    if (params is not None) + bool(material) + bool(draw) != 1:
        raise typer.BadParameter("give exactly one of --params, --material and --draw")
    if params is not None:
        try:
            with files.arrays(params) as f:
                vectors, named = np.asarray(f["params"], np.float64), class_entry(f)
        except Exception as e:  # damaged archives raise zipfile.BadZipFile
            raise TableError(
                f"{params} is not an .npz file with an array `params` of shape (n, {space.size}): {e}"
            ) from None
        if named and named != space.name:
            advice = (
                f"add --class {named}"
                if named in sources.names()
                else f"this version simulates {', '.join(sources.names())}"
            )
            raise TableError(f"{params}: its materials are of class {shown(named)}; {advice}")
        if not vectors.size:
            raise TableError(
                f"{params}: the array `params` of shape {vectors.shape} has no materials; add a row"
            )
        return space.check(vectors)
    if material:
        from nma import materials

        return np.stack([materials.load(m).vector() for m in material])
    return space.sample(np.random.default_rng(seed), draw, population)
