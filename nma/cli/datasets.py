"""`nma data`: measured materials and their reconstructions, where to get them and whether a copy is sound."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nma.cli import console

data = typer.Typer(
    invoke_without_command=True,
    help="List the data sets of measured materials that sources read: origin, terms, files. Nothing is downloaded.",
)


def register(app: typer.Typer) -> None:
    app.add_typer(data, name="data")


@data.callback()
def listing(context: typer.Context) -> None:
    from nma.sources.datasets import DATASETS

    if context.invoked_subcommand:
        return
    for n, dataset in enumerate(DATASETS):
        console.out.print(f"[bold]{dataset.name}[/bold]  {dataset.kind}", highlight=False, soft_wrap=True)
        lines = {"from": dataset.origin, "paper": dataset.paper, "licence": dataset.licence}
        lines["files"] = dataset.files
        for name, (size, checksum) in dataset.known.items():
            lines[name] = f"{size:,} bytes, SHA-256 {checksum}"
        for name, text in lines.items():
            console.tell(f"  {name}: {text}")
        if n + 1 < len(DATASETS):
            console.out.print()


@data.command()
def check(path: Annotated[Path, typer.Argument(help="A file, or a folder that holds files.")]) -> None:
    """Check files of these data sets: size, structure, values, and checksum where one is known.

    The exit status is 1 if a file has a fault.
    """
    from nma.sources import datasets

    findings = list(datasets.check(path))
    for f in findings:
        line = f"{'ok' if f.ok else 'FAULT':5}  {f.dataset:10}  {f.path}: {f.note}"
        console.tell(line)
    if not all(f.ok for f in findings):
        raise typer.Exit(1)
