"""The preview scene: what `nma render`, `compare` and `demo` show there, and how."""

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

# The parameters of commands that say what the preview scene shows, and how.
OPTIONS = ("adapter", "clamp", "changes", "camera", "lighting", "envmap", "mesh", "mesh_up", "depth")


class View(NamedTuple):
    """How the preview scene is shown: size, samples, light, camera, and the mesh in it."""

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
        """The preview scene with this material."""
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
    """Chooses Mitsuba's variant. It must be RGB, as the parameters of materials are."""
    import nma.render

    if not variant.endswith("_rgb") and variant != "auto":
        raise ParamError(f"materials are rendered in RGB, not by {variant}; take llvm_ad_rgb or cuda_ad_rgb")
    nma.render.use(variant)


def subject(
    context: typer.Context, name: str, changes: list[str] | None, adapter: str
) -> tuple[Material, str]:
    """The material to show, and the adapter that shows it. An adapter of a single material is both.

    Options that would do nothing for it are wrong usage.
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
    """The image of a scene, behind a progress bar."""
    from nma.render.progressive import render_passes

    with samples_bar(title, spp) as advance:
        return render_passes(scene, spp, seed=seed, integrator=integrator, progress=partial(advance, title))


@contextmanager
def samples_bar(title: str, total: int) -> Iterator[Callable[[str, int], None]]:
    """A progress bar over samples per pixel. Call what it yields with what goes on and the samples just done."""
    done = 0
    with console.counting(title, total, "spp/s") as show:

        def advance(what: str, samples: int) -> None:
            nonlocal done
            done += samples
            show(done, done, description=what)

        yield advance


def pixels(text: str) -> tuple[int, int]:
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


def refuse(context: typer.Context, names: tuple[str, ...], subject: str) -> None:
    """Refuses the options that would do nothing for this subject, if the user gave them."""
    given = [name for name in names if _given(context, name)]
    if given:
        flags = ", ".join("--set" if name == "changes" else f"--{name.replace('_', '-')}" for name in given)
        raise typer.BadParameter(f"{flags} cannot be used with {subject}")


def _given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
