"""The command `nma data`: lists the known measured materials and their origins, checks files, and writes MERL files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nma import files
from nma.cli import console, options, reading

data = typer.Typer(
    invoke_without_command=True,
    help="List the measured materials that this package reads: their origin, terms and files. Nothing is downloaded. "
    "[bold]check[/bold] checks your copies. [bold]merl[/bold] writes any isotropic material in MERL's format.",
)


def register(app: typer.Typer) -> None:
    app.add_typer(data, name="data")


@data.callback()
def listing(context: typer.Context) -> None:
    from nma.sources.catalogue import MEASUREMENTS

    if context.invoked_subcommand:
        return
    for n, measured in enumerate(MEASUREMENTS):
        console.out.print(f"[bold]{measured.name}[/bold]  {measured.kind}", highlight=False, soft_wrap=True)
        lines = {"from": measured.origin, "paper": measured.paper, "licence": measured.licence}
        lines["files"] = measured.files
        for name, (size, checksum) in measured.known.items():
            lines[name] = f"{size:,} bytes, SHA-256 {checksum}"
        for name, text in lines.items():
            console.tell(f"  {name}: {text}")
        if n + 1 < len(MEASUREMENTS):
            console.out.print()


@data.command()
def check(
    path: Annotated[Path, typer.Argument(help="A file, or a folder with files.", parser=options.path)],
) -> None:
    """Check files of measurements: the size, the structure, the values and, where it is known, the checksum.

    The exit status is 1 if any file has a fault.
    """
    from nma.sources import catalogue

    findings = list(catalogue.check(path))
    for f in findings:
        line = f"{'ok' if f.ok else 'FAULT':5}  {f.measurements:10}  {f.path}: {f.note}"
        console.tell(line)
    if not all(f.ok for f in findings):
        raise typer.Exit(1)


@data.command()
def merl(
    source: Annotated[
        str,
        typer.Argument(
            help="A file of values (.bsdf, .xml, .binary, NBRDF's .npz); the adapter of a single material "
            "(.safetensors); or a named material or a material file (.toml), which --adapter evaluates."
        ),
    ],
    output: Annotated[Path, options.output("The file to write.", ".binary")],
    material: Annotated[
        str | None, typer.Option(help="Which material of an NBRDF file: the name of its network.")
    ] = None,
    adapter: Annotated[
        str,
        typer.Option(
            help="The adapter of named materials and material files: a shipped adapter's name or a weights file."
        ),
    ] = options.DEFAULT_ADAPTER,
    clamp: options.Clamp = False,
) -> None:
    """Write any isotropic material as a MERL file: 90 x 90 x 180 values over half and difference angles.

    Example: [bold]nma data merl gold-red-lacquer -o gold.binary[/bold]
    """
    files.try_file(output)
    from nma.sources.merl import SCALE, Merl

    values = reading.values_of(source, material, adapter, clamp)
    written = Merl.of(values)
    written.save(output)
    seen = (written.planes >= 0).all(axis=0)
    share, brightest = seen.mean(), (written.planes[:, seen] * SCALE[:, None]).max()
    console.say(
        f"{output}: {values.name}, {share:.0%} of the entries above the horizon, f up to {brightest:.4g} 1/sr"
    )
