"""Options and functions with which the commands `nma render`, `compare` and `demo` render the preview scene."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from nma.cli import console, reading
from nma.errors import ParamError

if TYPE_CHECKING:
    from nma.materials import Material

# The names of the command-line parameters that set how the preview scene is rendered.
OPTIONS = ("adapter", "clamp", "changes", "camera", "lighting", "envmap", "mesh", "mesh_up", "depth")


class View(NamedTuple):
    """Settings of the preview scene: size in pixels, samples per pixel, path depth, camera, light, and mesh."""

    size: tuple[int, int]
    spp: int
    depth: int
    camera: str
    lighting: str
    envmap: Path | None
    variant: str
    mesh: Path | None = None
    mesh_up: str = "z"

    def load(self, material: Material, model: str, adapter: str = "", clamp: bool = False) -> Any:
        """Loads the preview scene with `material`."""
        from nma.render import load, progressive, scene

        use_rgb(self.variant)
        bsdf = load.material_bsdf(material, model, adapter=adapter, clamp=clamp)
        options: dict[str, Any] = {"camera": self.camera, "lighting": self.lighting, "envmap": self.envmap}
        options |= {"mesh": self.mesh, "mesh_up": self.mesh_up, "max_depth": self.depth}
        pixels = self.size[0] * self.size[1]
        options |= {"sampler": progressive.sampler(self.spp, pixels), "size": self.size}
        options["spp"] = progressive.pass_sizes(self.spp, pixels)[0]
        return load.load_dict(scene.preview_scene(bsdf, **options))


def use_rgb(variant: str) -> None:
    """Sets Mitsuba's variant, which must be an RGB variant because the parameters of materials are RGB."""
    import nma.render

    if not variant.endswith("_rgb") and variant != "auto":
        raise ParamError(f"materials are rendered in RGB, not by {variant}; use llvm_ad_rgb or cuda_ad_rgb")
    nma.render.use(variant)


def subject(
    context: typer.Context, name: str, changes: list[str] | None, adapter: str
) -> tuple[Material, str]:
    """The material that the user named, and the adapter that renders it.

    If the user named the weights file of an adapter for a single material, this file gives both the material and the
    adapter. Options that would have no effect are rejected as wrong usage.
    """
    refuse(context, ("define",), "a material")
    if context.params["envmap"]:
        refuse(context, ("lighting",), "--envmap")
    if not context.params.get("mesh"):
        refuse(context, ("mesh_up",), "the shader ball")
    if name.endswith(".safetensors"):
        refuse(context, ("model", "adapter", "changes"), "an adapter")
        adapter = name
    return reading.material_of(name, changes), adapter


def render(scene: Any, spp: int, seed: int, title: str, integrator: Any = None) -> Any:
    """Renders a scene while a progress bar is shown, and returns the image."""
    from nma.render.progressive import render_passes

    with samples_bar(title, spp) as advance:
        return render_passes(scene, spp, seed=seed, integrator=integrator, progress=partial(advance, title))


@contextmanager
def samples_bar(title: str, total: int) -> Iterator[Callable[[str, int], None]]:
    """Shows a progress bar that counts samples per pixel.

    Yields a function `advance(what, samples)`, which updates the bar. `what` describes the current step, and `samples`
    is the number of samples per pixel that were rendered since the last call.
    """
    done = 0
    with console.counting(title, total, "spp/s") as show:

        def advance(what: str, samples: int) -> None:
            nonlocal done
            done += samples
            show(done, done, description=what)

        yield advance


def pixels(text: str) -> tuple[int, int]:
    """Parses a size such as `512` or `512x384` and returns the width and height in pixels."""
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


def refuse(context: typer.Context, names: tuple[str, ...], subject: str) -> None:
    """Raises `BadParameter` if the user gave any of the options `names`, which have no effect for `subject`."""
    given = [name for name in names if _given(context, name)]
    if given:
        flags = ", ".join("--set" if name == "changes" else f"--{name.replace('_', '-')}" for name in given)
        raise typer.BadParameter(f"{flags} cannot be used with {subject}")


def _given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
