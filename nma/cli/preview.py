"""A material that a command names, and how the preview scene shows it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from nma.errors import ParamError

if TYPE_CHECKING:
    from nma.materials import Material


class View(NamedTuple):
    """How the preview scene is looked at."""

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
        """The scene with this material."""
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
    """Chooses the variant for materials, whose parameters are RGB."""
    import nma.render

    if not variant.endswith("_rgb") and variant != "auto":
        raise ParamError(f"materials are rendered in RGB, not by {variant}; take llvm_ad_rgb or cuda_ad_rgb")
    nma.render.use(variant)


def read_material(name: str, changes: list[str] | None) -> Material:
    """A named material, a material file, or an adapter that knows a single one; with `changes` given by --set."""
    from nma import materials
    from nma.adapter import Adapter
    from nma.params import MEASURED

    if name.endswith(".safetensors"):
        # An adapter that knows a single material is one.
        adapter = Adapter.load(name)
        if adapter.space.size and adapter.material is None:
            raise ParamError(
                f"{name} is an adapter of the whole class {adapter.space.name}; "
                f"name a material, too: nma render MATERIAL --adapter {name}"
            )
        if adapter.material is not None:
            return materials.Material.of_vector(Path(name).stem, adapter.material, adapter.space)
        return materials.Material(Path(name).stem, name, "", MEASURED.name, {})
    material = materials.load(name)
    return material.changed(dict(map(read_change, changes)), "--set") if changes else material


def read_change(text: str) -> tuple[str, Any]:
    """`alpha_top=.2` and the like, as in a material file."""
    name, value = assignment(text)
    try:
        numbers = [float(part) for part in value.split(",")]
        return name, numbers if len(numbers) > 1 else numbers[0]
    except ValueError:
        return name, value if name == "conductor" or value.startswith("#") else _texture(value)


def _texture(text: str) -> dict[str, Any]:
    """`orm.png,channel=g,uv_scale=4` as a material file's table; what is no option belongs to the file's name."""
    from nma.materials import TEXTURE_OPTIONS

    file, *parts = re.split(rf",(?=(?:{'|'.join(TEXTURE_OPTIONS)})=)", text)
    return {"texture": file} | {key: _option(value) for key, _, value in (p.partition("=") for p in parts)}


def _option(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return {"true": True, "false": False}.get(text, text)


def assignment(text: str) -> tuple[str, str]:
    """Name and value of `NAME=VALUE`."""
    name, equals, value = text.partition("=")
    if not (equals and name and value):
        raise typer.BadParameter(f"'{text}' is not of the form NAME=VALUE")
    return name.strip(), value.strip()
