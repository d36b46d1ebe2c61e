"""The command `nma compare`: compares two images, or a picture of an adapter with its reference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nma import files
from nma.cli import console, options, preview
from nma.errors import ParamError

if TYPE_CHECKING:
    from nma.materials import Material


def register(app: typer.Typer) -> None:
    app.command()(compare)


def compare(
    context: typer.Context,
    test: Annotated[
        str,
        typer.Argument(
            help="An image (EXR, PNG, ...); or, without REFERENCE, a material or the adapter of a single material."
        ),
    ],
    reference: Annotated[str | None, typer.Argument(help="The reference image.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print nothing but JSON on stdout.")] = False,
    output: Annotated[
        Path | None, options.output("A PNG to write, with both images and the map of their FLIP.", ".png")
    ] = None,
    exposure: Annotated[
        float, options.exposure("Stops that brighten the images for ssim, flip_ldr and the PNG.")
    ] = 0.0,
    adapter: options.AdapterName = options.DEFAULT_ADAPTER,
    clamp: options.Clamp = False,
    changes: options.Changes = None,
    camera: options.Camera = "hero",
    lighting: options.Lighting = "studio",
    envmap: options.Envmap = None,
    size: options.Size = "256",
    spp: Annotated[int, options.samples("Samples per pixel.")] = 256,
    depth: options.Depth = 6,
    seed: options.PictureSeed = 0,
    variant: options.MitsubaVariant = "auto",
) -> None:
    """Compare an image with a reference image, or compare two renderings of a material.

    For a material, the command compares a picture rendered by its adapter with a picture rendered by the reference
    simulation. The command renders the reference twice, with different seeds. The column `noise` compares the two
    pictures of the reference, which differ only by their noise. The figures are defined in docs/evaluation.md.

    Examples: [bold]nma compare test.exr reference.exr -o difference.png[/bold],
    [bold]nma compare gold-red-lacquer --spp 512[/bold]
    """
    from nma.images import metrics
    from nma.images.io import read_image

    metrics.ensure_packages()
    if output:
        files.try_file(output)
    if reference is not None:
        preview.refuse(context, (*preview.OPTIONS, "size", "spp", "seed", "variant"), "two images")
        pictures = {"image": read_image(test), "reference": read_image(reference)}
    else:
        pixels = preview.pixels(size)
        metrics.check_size(pixels)
        material, adapter = preview.subject(context, test, changes, adapter)
        if not material.values:
            raise ParamError(
                f"{test}: this material cannot be simulated, so there is no reference; "
                "render both pictures yourself and compare the images"
            )
        view = preview.View(pixels, spp, depth, camera, lighting, envmap, variant)
        pictures = _renderings(material, view, seed, adapter, clamp)
    truth = pictures.pop("reference")
    errors = {
        name: metrics.compare_images(picture, truth, ldr_exposure=exposure)
        for name, picture in pictures.items()
    }
    first = next(iter(pictures))
    if output:
        _write_difference(output, test, first, pictures[first], truth, exposure)
    if as_json:
        print(json.dumps(errors[first] | ({"noise": errors["noise"]} if "noise" in errors else {})))
        return
    rows = [(metric, *(values[metric] for values in errors.values())) for metric in metrics.METRICS]
    console.tell(f"{test} against {reference or 'its reference'}")
    console.out.print(console.table(("", *errors), rows))


def _renderings(
    material: Material, view: preview.View, seed: int, adapter: str, clamp: bool
) -> dict[str, Any]:
    """Renders a material once with its adapter and twice with its reference, each time with another seed."""
    by_adapter = view.load(material, "nma", adapter, clamp)
    by_walks = view.load(material, "layered")
    return {
        "adapter": preview.render(by_adapter, view.spp, seed, "adapter"),
        "noise": preview.render(by_walks, view.spp, seed + 1, "reference again"),
        "reference": preview.render(by_walks, view.spp, seed + 2, "reference"),
    }


def _write_difference(path: Path, title: str, name: str, test: Any, reference: Any, exposure: float) -> None:
    from nma.images.metrics import difference_image
    from nma.images.sheet import Row, contact_sheet

    difference = difference_image(test, reference, kind="flip", exposure=exposure)
    contact_sheet(
        path, [Row(title, [reference, test, difference])], ("reference", name, "FLIP"), exposure=exposure
    )
    console.say(f"{path}: reference, {name}, and FLIP from black (0) to yellow (1)")
