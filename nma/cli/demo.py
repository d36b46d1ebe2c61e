"""The command `nma demo`: renders two materials with the reference and with the adapter, side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nma import files
from nma.cli import console, options, preview


def register(app: typer.Typer) -> None:
    app.command()(demo)


def demo(
    output: Annotated[Path, options.output("The PNG to write.", ".png")] = Path("out/demo.png"),
    adapter: options.AdapterName = options.DEFAULT_ADAPTER,
    size: options.Size = "256",
    spp: Annotated[int, options.samples("Samples per pixel of the frames that are timed.")] = 64,
    runs: Annotated[
        int, options.number("How many frames of each kind are timed, each with its own seed.", 2, 1000)
    ] = 2,
    reference_spp: Annotated[int, options.samples("Samples per pixel of the converged reference.")] = 144,
    variant: options.MitsubaVariant = "auto",
) -> None:
    """Render two layered materials with the reference and with the adapter, and measure time, variance and error.

    The first material has no textures, and the second material has three textures. `nma demo` writes a sheet of
    pictures as soon as they are rendered, writes the sheet again with the measured results, and prints the results as a
    table. `nma demo` takes about a minute on two CPU cores.
    """
    from nma.images import metrics

    metrics.ensure_packages(ssim=False)
    files.try_file(output)
    from nma.adapter import Adapter
    from nma.render import demo as demonstration

    metrics.check_size(preview.pixels(size))
    Adapter.load(adapter)
    settings = demonstration.Settings(preview.pixels(size), spp, runs, reference_spp, adapter)
    preview.use_rgb(variant)
    with preview.samples_bar("demo", demonstration.total_samples(settings)) as advance:
        lines = demonstration.demo(output, settings, advance, lambda shown: console.say(f"{output}: {shown}"))
    for material in dict.fromkeys(line.material for line in lines):
        rows = [line.cells()[1:] for line in lines if line.material == material]
        console.out.print(console.table(demonstration.HEADINGS[1:], rows, material))
    console.out.print(demonstration.note(settings), highlight=False)
