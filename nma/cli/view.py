"""`nma render`, `compare`, `demo`: pictures."""

from __future__ import annotations

import json
import re
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nma import files
from nma.cli import console, options
from nma.cli.preview import View, assignment, read_material, use_rgb
from nma.errors import ParamError

if TYPE_CHECKING:
    from nma.materials import Material

_Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Change a parameter of the material: alpha_top=.2, albedo=.9,.1,.1 or #3366ee, conductor=Ag, "
        "sigma_t=wear.png, alpha_bottom=orm.png,channel=g. May be repeated.",
    ),
]
_AdapterName = Annotated[str, typer.Option(help="A shipped adapter's name or a weights file.")]
_Clamp = Annotated[
    bool, typer.Option("--clamp", help="Move parameters beyond the adapter's training range to the range.")
]
_Camera = Annotated[str, typer.Option(help="hero, close or top.")]
_Envmap = Annotated[
    Path | None, typer.Option(help="Light by this environment map (EXR or HDR), instead of --lighting.")
]
_Lighting = Annotated[
    str, typer.Option(help="studio, softboxes in a dim dome, or outdoors, sun, sky and a small lamp.")
]
_Size = Annotated[str, typer.Option(help="Pixels: 512 for a square, or 512x384.")]
_Depth = Annotated[int, options.number("Longest path, in edges.", 1, 1000)]
_Seed = Annotated[int, options.seed("Equal seeds give equal pictures.")]
_Variant = Annotated[
    str,
    typer.Option(
        help="Mitsuba's variant; auto is cuda_ad_rgb where there is an NVIDIA GPU, else llvm_ad_rgb."
    ),
]


def register(app: typer.Typer) -> None:
    app.command()(render)
    app.command()(compare)
    app.command()(demo)


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
            "OUT.png or OUT.exr; both are written.", ".png", ".exr", show_default="out/SUBJECT.png"
        ),
    ] = None,
    model: Annotated[str, typer.Option(help="nma, the adapter, or layered, the reference.")] = "nma",
    adapter: _AdapterName = "layered3-5x64",
    clamp: _Clamp = False,
    changes: _Set = None,
    camera: _Camera = "hero",
    lighting: _Lighting = "studio",
    envmap: _Envmap = None,
    mesh: Annotated[
        Path | None,
        typer.Option(help="Show this mesh (PLY or OBJ) in place of the ball, on the floor and as large."),
    ] = None,
    mesh_up: Annotated[str, typer.Option(help="The axis of the mesh that points up: z or y.")] = "z",
    size: Annotated[
        str | None,
        typer.Option(help="Pixels: 512 for a square, or 512x384.", show_default="512, or the scene's"),
    ] = None,
    spp: Annotated[
        int | None, options.samples("Samples per pixel.", show_default="128, or the scene's")
    ] = None,
    depth: _Depth = 6,
    seed: _Seed = 0,
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
            help="A parameter ($NAME) of the XML scene. May be repeated.",
        ),
    ] = None,
    variant: _Variant = "auto",
) -> None:
    """Render a material in the preview scene, or a Mitsuba scene as it is, to EXR and PNG.

    Scenes may use the BSDFs `nma` and `layered`, which the `mitsuba` program cannot see. They bring their own material,
    camera, light and path depth, so options for those apply to materials alone.

    Examples: [bold]nma render gold-red-lacquer --camera close --set alpha_top=.05[/bold],
    [bold]nma render my-material.toml --model layered -o out/my.exr[/bold], [bold]nma render scene.xml --spp 256[/bold]
    """
    pictures = _outputs(output or Path("out", Path(subject).stem + ".png"))
    files.try_file(*pictures)
    pixels = _pixels(size) if size is not None else None
    if subject.endswith(".xml"):
        _refuse(context, _MATERIAL_ONLY, "an XML scene")
        scene, own_spp = _load_file(subject, define, pixels, variant)
        spp = spp or own_spp
    else:
        _refuse(context, ("define",), "a material")
        _refuse_unused(context)
        view = View(pixels or (512, 512), spp or 128, depth, camera, lighting, envmap, variant, mesh, mesh_up)
        if subject.endswith(".safetensors"):
            _refuse(context, ("model", "adapter", "changes"), "an adapter")
            adapter = subject
        scene, spp = view.load(read_material(subject, changes), model, adapter, clamp), view.spp
    integrator = _clamped(scene, clamp_samples) if clamp_samples is not None else None
    _write(_render(scene, spp, seed, subject, integrator), scene, pictures, exposure)


def compare(
    context: typer.Context,
    test: Annotated[
        str, typer.Argument(help="An image (EXR, PNG, ...), or alone: a material, or the adapter of one.")
    ],
    reference: Annotated[str | None, typer.Argument(help="The image to compare with.")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON on stdout and nothing else there.")
    ] = False,
    output: Annotated[
        Path | None, options.output("A PNG with both images and the map of their FLIP.", ".png")
    ] = None,
    exposure: Annotated[float, options.exposure("Stops before ssim, flip_ldr and in the PNG.")] = 0.0,
    adapter: _AdapterName = "layered3-5x64",
    clamp: _Clamp = False,
    changes: _Set = None,
    camera: _Camera = "hero",
    lighting: _Lighting = "studio",
    envmap: _Envmap = None,
    size: _Size = "256",
    spp: Annotated[int, options.samples("Samples per pixel.")] = 256,
    depth: _Depth = 6,
    seed: _Seed = 0,
    variant: _Variant = "auto",
) -> None:
    """Compare two images; or, for a material, its adapter with its reference, both rendered in the preview scene.

    A material's reference is rendered twice, and the column `noise` says what it scores against itself: its noise.
    The figures are defined in docs/evaluation.md.

    Examples: [bold]nma compare test.exr reference.exr -o difference.png[/bold],
    [bold]nma compare gold-red-lacquer --spp 512[/bold]
    """
    from nma.images import metrics
    from nma.images.io import read_image

    metrics.ensure_libraries()
    if output:
        files.try_file(output)
    if reference is not None:
        _refuse(context, _RENDERING, "two images")
        pictures = {"image": read_image(test), "reference": read_image(reference)}
    else:
        _refuse_unused(context)
        metrics.check_size(_pixels(size))
        view = View(_pixels(size), spp, depth, camera, lighting, envmap, variant)
        if test.endswith(".safetensors"):
            _refuse(context, ("adapter", "changes"), "an adapter")
            adapter = test
        material = read_material(test, changes)
        if not material.values:
            raise ParamError(
                f"{test} knows a material that cannot be simulated; render both and compare the images"
            )
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


def demo(
    output: Annotated[Path, options.output("The PNG to write.", ".png")] = Path("out/demo.png"),
    adapter: _AdapterName = "layered3-5x64",
    size: _Size = "256",
    spp: Annotated[int, options.samples("Samples per pixel of the frames that are timed.")] = 64,
    runs: Annotated[int, options.number("Frames of each kind, with seeds of their own.", 2, 1000)] = 2,
    reference_spp: Annotated[int, options.samples("Samples per pixel of the converged reference.")] = 144,
    variant: _Variant = "auto",
) -> None:
    """See it work: a plain and a textured layered material, by reference and by adapter, with time, variance and error.

    Writes a sheet of pictures as soon as there are some, again whenever there is more to show, and prints the table
    below it. Takes about a minute on two CPU cores.
    """
    from nma.images import metrics

    metrics.ensure_libraries(ssim=False)
    files.try_file(output)
    from nma.adapter import Adapter
    from nma.render import demo as demonstration

    metrics.check_size(_pixels(size))
    Adapter.load(adapter)
    settings = demonstration.Settings(_pixels(size), spp, runs, reference_spp, adapter)
    use_rgb(variant)
    with _samples_bar("demo", demonstration.total_samples(settings)) as advance:
        lines = demonstration.demo(output, settings, advance, lambda shown: console.say(f"{output}: {shown}"))
    for material in dict.fromkeys(line.material for line in lines):
        rows = [line.cells()[1:] for line in lines if line.material == material]
        console.out.print(console.table(demonstration.HEADINGS[1:], rows, material))
    console.out.print(demonstration.note(settings), highlight=False)


_PREVIEW = ("camera", "lighting", "envmap", "mesh", "mesh_up", "depth")  # of the preview scene
_RENDERING = ("adapter", "clamp", "changes", *_PREVIEW, "size", "spp", "seed", "variant")
_MATERIAL_ONLY = ("model", "adapter", "clamp", "changes", *_PREVIEW)


def _load_file(
    path: str, define: list[str] | None, size: tuple[int, int] | None, variant: str
) -> tuple[Any, int]:
    """A scene from an XML file, and its samples per pixel."""
    import nma.render
    from nma.render.load import load_scene

    nma.render.use(variant)
    scene = load_scene(path, dict(map(assignment, define or [])), size)
    return scene, scene.sensors()[0].sampler().sample_count()


def _renderings(material: Material, view: View, seed: int, adapter: str, clamp: bool) -> dict[str, Any]:
    """A material by its adapter, by its reference, and by the reference again, each with a seed of its own."""
    by_adapter = view.load(material, "nma", adapter, clamp)
    by_walks = view.load(material, "layered")
    return {
        "adapter": _render(by_adapter, view.spp, seed, "adapter"),
        "noise": _render(by_walks, view.spp, seed + 1, "reference again"),
        "reference": _render(by_walks, view.spp, seed + 2, "reference"),
    }


def _clamped(scene: Any, limit: float) -> Any:
    from nma.render.clamp import clamped

    return clamped(scene.integrator(), limit)


def _render(scene: Any, spp: int, seed: int, title: str, integrator: Any = None) -> Any:
    from nma.render.progressive import render_passes

    with _samples_bar(title, spp) as advance:
        return render_passes(scene, spp, seed=seed, integrator=integrator, progress=partial(advance, title))


@contextmanager
def _samples_bar(title: str, total: int):
    """A progress bar over samples per pixel; yields a function of what goes on and the samples done."""
    import time

    with console.progress("spp/s") as bar:
        task = bar.add_task(title, total=total, rate="", note="")
        began = time.perf_counter()

        def advance(what: str, samples: int) -> None:
            bar.advance(task, samples)
            rate = bar.tasks[0].completed / (time.perf_counter() - began)
            bar.update(task, rate=f"{rate:.1f}", description=what)

        yield advance


def _write(image: Any, scene: Any, pictures: tuple[Path, Path], exposure: float) -> None:
    """All channels as EXR, the colours as PNG."""
    from nma.images.io import write_exr, write_png
    from nma.render.channels import channel_names, colours

    names = channel_names(scene, image.shape[2])
    write_exr(pictures[0], image, names)
    write_png(pictures[1], colours(image, names), exposure=exposure)
    console.say(f"{pictures[0]} (linear), {pictures[1]}")


def _write_difference(path: Path, title: str, name: str, test: Any, reference: Any, exposure: float) -> None:
    from nma.images.metrics import difference_image
    from nma.images.sheet import Row, contact_sheet

    difference = difference_image(test, reference, kind="flip", exposure=exposure)
    contact_sheet(
        path, [Row(title, [reference, test, difference])], ("reference", name, "FLIP"), exposure=exposure
    )
    console.say(f"{path}: reference, {name}, and FLIP from black (0) to yellow (1)")


def _pixels(text: str) -> tuple[int, int]:
    """Width and height from `512` or `512x384`."""
    from nma.render.progressive import check_size

    found = re.fullmatch(r"([1-9]\d{0,8})(?:x([1-9]\d{0,8}))?", text.lower(), re.ASCII)
    if found is None:
        raise typer.BadParameter(f"size '{text}' is neither a number of pixels nor WIDTHxHEIGHT")
    size = int(found[1]), int(found[2] or found[1])
    try:
        check_size(size)
    except ParamError as error:
        raise typer.BadParameter(str(error)) from None
    return size


def _outputs(path: Path) -> tuple[Path, Path]:
    """The EXR and the PNG that belong to an output file's name."""
    return path.with_suffix(".exr"), path.with_suffix(".png")


def _refuse_unused(context: typer.Context) -> None:
    """Options of the preview scene that others put out of use."""
    if context.params["envmap"]:
        _refuse(context, ("lighting",), "--envmap")
    if not context.params.get("mesh"):
        _refuse(context, ("mesh_up",), "the shader ball")


def _given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _refuse(context: typer.Context, names: tuple[str, ...], subject: str) -> None:
    """An option that would do nothing is a mistake."""
    given = [name for name in names if _given(context, name)]
    if given:
        flags = ", ".join("--set" if name == "changes" else f"--{name.replace('_', '-')}" for name in given)
        raise typer.BadParameter(f"{flags} cannot be used with {subject}")
