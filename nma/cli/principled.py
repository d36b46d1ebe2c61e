"""The command `nma principled`: fits one Principled BRDF to a material, for renderers that cannot run an adapter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nma import files
from nma.cli import console, options, reading
from nma.export import TEXTS, principled_text

# If the mean error of the directional albedo exceeds ALBEDO_LIMIT, the error is visible in pictures, so the command
# prints a warning.
ALBEDO_LIMIT = 0.05
_RENDERERS = ", ".join(f"{ending}: {text.renderer}" for ending, text in TEXTS.items())


def register(app: typer.Typer) -> None:
    app.command()(principled)


def principled(
    source: Annotated[
        str,
        typer.Argument(
            help="A named material or a material file (.toml), which are simulated; a file of values (.bsdf, "
            ".binary, .xml, NBRDF's .npz); or a reference file (.npz)."
        ),
    ],
    material: Annotated[
        str | None,
        typer.Option(
            help="Which material of an .npz file: the name of a network, or the number of a table, from 0."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        options.output(
            f"A file to write too: weights (.safetensors), or the BRDF for a renderer ({_RENDERERS}).",
            *TEXTS,
            ".safetensors",
        ),
    ] = None,
    walks: Annotated[int, options.walks("Random walks, if the material is simulated.")] = 16_000_000,
    steps: options.Steps = None,
    seed: Annotated[int, options.seed("Seed of the walks and of the batches.")] = 0,
) -> None:
    """Fit one Principled BRDF with constant parameters to a material, and print its parameters for Mitsuba.

    The fit uses no network and no blend, and the parameters do not depend on the direction, so any renderer with a
    Principled BRDF can use the fitted parameters.

    Examples: [bold]nma principled gold-red-lacquer -o gold.xml[/bold],
    [bold]nma principled paper_white_rgb.bsdf[/bold]
    """
    if output is not None:
        files.try_file(output)
    from nma.train.principled import CONSTANT, fit_constant

    tables, record = reading.tables_of(source, material, walks, seed)
    recipe = replace(CONSTANT, seed=seed)
    if steps is not None:
        recipe = replace(recipe, steps=steps)
    with console.TrainingBar(recipe, "fitting") as bar:
        fit = fit_constant(tables, recipe, record, progress=bar.update)
    print(principled_text(".json", fit.principled), end="")
    error = fit.figures["albedo_error"]
    console.say(
        f"log loss {fit.log_loss:.5f} over the table, albedo error {error:.4f}",
    )
    if error > ALBEDO_LIMIT:
        console.say(_warning(error, fit.brightness))
    if output is None:
        return
    kind = options.ending(output, TEXTS)
    if kind is None:
        fit.adapter.save(output)
        console.say(f"wrote {output}")
    else:
        files.write_text(output, principled_text(kind, fit.principled))
        console.say(f"wrote {output} for {TEXTS[kind].renderer}")


def _warning(error: float, brightness: float) -> str:
    """The text of the warning that is printed if the albedo error of a fit is above `ALBEDO_LIMIT`."""
    percent = 100.0 * (brightness - 1.0)
    tone = "bright" if percent > 0 else "dark"
    return (
        f"warning: an albedo error of {error:.4f} is above {ALBEDO_LIMIT:g} ({abs(percent):.1f} % too {tone} in all): "
        "one Principled BRDF with constant parameters cannot match this material; `nma fit` trains an adapter that can"
    )
