"""The command `nma render`: renders a picture of a material or of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nma import files
from nma.cli import console, options, preview, reading


def register(app: typer.Typer) -> None:
    app.command()(render)


def render(
    context: typer.Context,
    subject: Annotated[
        str,
        typer.Argument(
            help="A named material, a material file (.toml), the adapter of a single material (.safetensors), or a "
            "Mitsuba scene (.xml)."
        ),
    ],
    output: Annotated[
        Path | None,
        options.output(
            "NAME.png or NAME.exr; both are written.", ".png", ".exr", show_default="out/SUBJECT.png"
        ),
    ] = None,
    model: Annotated[str, typer.Option(help="nma: the adapter. layered: the reference.")] = "nma",
    adapter: options.AdapterName = options.DEFAULT_ADAPTER,
    clamp: options.Clamp = False,
    changes: options.Changes = None,
    camera: options.Camera = "hero",
    lighting: options.Lighting = "studio",
    envmap: options.Envmap = None,
    mesh: Annotated[
        Path | None,
        typer.Option(
            help="Show this mesh (PLY or OBJ) in place of the ball, scaled to its size and put on the floor.",
            parser=options.path,
        ),
    ] = None,
    mesh_up: Annotated[str, typer.Option(help="The axis of the mesh that points up: z or y.")] = "z",
    size: Annotated[
        str | None,
        typer.Option(help="Pixels: 512 for a square, or 512x384.", show_default="512, or the scene's"),
    ] = None,
    spp: Annotated[
        int | None, options.samples("Samples per pixel.", show_default="128, or the scene's")
    ] = None,
    depth: options.Depth = 6,
    seed: options.PictureSeed = 0,
    exposure: Annotated[float, options.exposure("Stops that brighten the PNG; the EXR stays linear.")] = 0.0,
    clamp_samples: Annotated[
        float | None,
        options.number(
            "Scale samples brighter than this radiance down to it, against fireflies; try 10. It darkens the picture.",
            1e-3,
            1e6,
            show_default="none",
        ),
    ] = None,
    define: Annotated[
        list[str] | None,
        typer.Option(
            "--define",
            "-D",
            metavar="NAME=VALUE",
            help="Set a parameter ($NAME) of the XML scene. May be repeated.",
        ),
    ] = None,
    variant: options.MitsubaVariant = "auto",
) -> None:
    """Render a material in the preview scene, or a Mitsuba scene unchanged, and write an EXR and a PNG file.

    A Mitsuba scene may contain the BSDFs `nma` and `layered`. (The program `mitsuba` can load these BSDFs only as
    plugins that `nma mitsuba build` compiles.) A Mitsuba scene defines its own materials, camera, lights and path
    depth, so the options that set these are rejected for a scene.

    Examples: [bold]nma render gold-red-lacquer --camera close --set alpha_top=.05[/bold],
    [bold]nma render my-material.toml --model layered -o out/my.exr[/bold], [bold]nma render scene.xml --spp 256[/bold]
    """
    pictures = _outputs(output or Path("out", Path(subject).stem + ".png"))
    files.try_file(*pictures)
    pixels = preview.pixels(size) if size is not None else None
    if subject.endswith(".xml"):
        preview.refuse(context, ("model", *preview.OPTIONS), "an XML scene")
        scene, own_spp = _load_file(subject, define, pixels, variant)
        spp = spp or own_spp
    else:
        material, adapter = preview.subject(context, subject, changes, adapter)
        spp = spp or 128
        view = preview.View(
            pixels or (512, 512), spp, depth, camera, lighting, envmap, variant, mesh, mesh_up
        )
        scene = view.load(material, model, adapter, clamp)
    integrator = _clamped(scene, clamp_samples) if clamp_samples is not None else None
    _write(preview.render(scene, spp, seed, subject, integrator), scene, pictures, exposure)


def _load_file(
    path: str, define: list[str] | None, size: tuple[int, int] | None, variant: str
) -> tuple[Any, int]:
    """Loads a scene from an XML file. Returns the scene, and the samples per pixel that the file sets."""
    import nma.render
    from nma.render.load import load_scene

    nma.render.use(variant)
    scene = load_scene(path, dict(map(reading.assignment, define or [])), size)
    return scene, scene.sensors()[0].sampler().sample_count()


def _clamped(scene: Any, limit: float) -> Any:
    from nma.render.fireflies import clamped

    return clamped(scene.integrator(), limit)


def _write(image: Any, scene: Any, pictures: tuple[Path, Path], exposure: float) -> None:
    """Writes an EXR file with all channels and a PNG file with only the colour channels."""
    from nma.images.io import write_exr, write_png
    from nma.render.channels import channel_names, colours

    names = channel_names(scene, image.shape[2])
    write_exr(pictures[0], image, names)
    write_png(pictures[1], colours(image, names), exposure=exposure)
    console.say(f"{pictures[0]} (linear), {pictures[1]}")


def _outputs(path: Path) -> tuple[Path, Path]:
    """The paths of the EXR file and of the PNG file, which differ from `path` only in their endings."""
    return path.with_suffix(".exr"), path.with_suffix(".png")
