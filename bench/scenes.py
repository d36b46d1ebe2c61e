"""The scenes, materials and BSDFs that the benches render."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import nma
import nma.render.lighting
import nma.render.scene
import nma.render.textures
from nma.materials import Material
from nma.render.lighting import LAMP_RADIANCE
from nma.render.load import material_bsdf
from nma.render.scene import Camera, preview_scene
from nma.render.shaderball import shader_ball_file
from nma.render.textures import bitmap_texture, periodic_noise, procedural_textures

# The maximum path depth, and the depth at which Russian roulette begins (Mitsuba's default).
DEPTH, RR_DEPTH = 6, 5
SIMULATION, STAND_IN, NOTHING = "layered", "principled", "diffuse"
# A frame with this BSDF measures the time of everything except the material, because this BSDF takes almost no time.
DIFFUSE = {"type": "diffuse"}
TEXELS = 512
# Small, bright lights outside the camera's view. Each line is a light's direction and distance from the point
# LIGHTS_AROUND, and its colour.
LIGHTS = (
    ((-1.00, -0.70, 0.85), 2.4, (1.00, 0.85, 0.65)),
    ((0.80, -0.50, 0.55), 2.2, (0.70, 0.85, 1.00)),
    ((0.10, -0.45, 1.00), 2.0, (1.00, 0.97, 0.92)),
    ((-0.75, 0.45, 1.00), 2.6, (1.00, 0.60, 0.45)),
    ((0.70, 0.60, 0.95), 3.2, (0.60, 0.75, 1.00)),
    ((0.25, -1.00, 0.75), 4.0, (1.00, 0.92, 0.80)),
)
LIGHTS_AROUND = (0.0, 0.0, 1.1)
LIGHT_RADIUS, LIGHT_POWER = 0.06, 90.0  # a light's radiance is LIGHT_POWER x distance^2
WIDE = Camera((0.0, -8.6, 3.0), (0.0, 0.0, 1.0), 18.2)
TEASER_ASPECT = 20 / 9
SOFT_BOX_PLACE, SOFT_BOX_SIZE, SOFT_BOX_RADIANCE = (-3.4, -3.6, 4.6), (1.6, 1.0, 1.0), 0.18
Bsdf = Mapping[str, Any]


class Subject(NamedTuple):
    """A material, textures (height, width[, 3]) for some of its parameters, and how often the textures repeat."""

    material: Material
    textures: Mapping[str, NDArray[np.floating]] = {}
    repeats: float = 2.0

    def images(self) -> dict[str, Any]:
        """Returns the textures as dictionaries of Mitsuba's plugin `bitmap`."""
        return {name: bitmap_texture(values, scale=self.repeats) for name, values in self.textures.items()}


def simulation(subject: Subject) -> dict[str, Any]:
    return material_bsdf(subject.material, "layered") | subject.images()


def adapter(subject: Subject, name: str, clamp: bool = False) -> dict[str, Any]:
    """Returns the BSDF `nma` of a shipped adapter or a weights file.

    Without textures, the BSDF interpolates curves over cos(theta_i). With textures, the BSDF runs the network at every
    shading point.
    """
    return material_bsdf(subject.material, "nma", adapter=name, clamp=clamp) | subject.images()


def online(bsdf: Bsdf, precision: str = "compact") -> dict[str, Any]:
    """Returns the BSDF `nma` with the setting that makes the BSDF run its network at every shading point.

    In `scalar_rgb`, the setting is the option `online`. In Mitsuba's other variants, the network runs at every shading
    point if any parameter has a texture. In these variants, a BSDF without a texture for sigma_t gets a constant
    texture.
    """
    import mitsuba as mi

    if mi.variant() == "scalar_rgb":
        return dict(bsdf) | {"online": True, "precision": precision}
    if isinstance(bsdf["sigma_t"], float):
        return dict(bsdf) | {"sigma_t": bitmap_texture(np.full((2, 2), bsdf["sigma_t"]))}
    return dict(bsdf)


def network(subject: Subject, name: str, precision: str = "compact") -> dict[str, Any]:
    """Returns the BSDF `nma` of an adapter whose network runs at every shading point."""
    return online(adapter(subject, name), precision)


def stand_in(subject: Subject) -> dict[str, Any]:
    """Returns Mitsuba's `principled` with the subject's textures, but with another material."""
    names = {"albedo": "base_color", "alpha_bottom": "roughness", "sigma_t": "metallic"}
    images = {names[name]: image for name, image in subject.images().items()}
    return {"type": "principled", "metallic": 0.7, "roughness": 0.3, "clearcoat": 0.5} | images


def short(name: str) -> str:
    """Returns the size of the network from an adapter's name: layered3-5x64 -> 5x64."""
    return name.partition("-")[2]


def unseen(count: int, seed: int = 92) -> list[Subject]:
    """Draws materials from the paper's ranges; no adapter was trained on these materials."""
    params = nma.LAYERED3.sample(np.random.default_rng(seed), count, "range")
    return [Subject(Material.of_vector(f"unseen-{n}", row, nma.LAYERED3)) for n, row in enumerate(params)]


def worn_silver() -> Subject:
    """Silver under worn, marbled lacquer. Roughness, colour and amount of pigment come from textures."""
    silver = nma.load_material("frosted-silver").changed({"alpha_top": 0.02, "eta_top": 1.5})
    return Subject(silver, procedural_textures(TEXELS), repeats=1.0)


def patinated_copper() -> Subject:
    """Copper under verdigris. The verdigris has an uneven tone, and crumbles where it is thin."""
    rng = np.random.default_rng(3)
    large, fine = (
        periodic_noise(rng, TEXELS, period=period, slope=slope) for period, slope in ((0.3, 2.0), (0.06, 1.3))
    )
    cover = 1.0 / (1.0 + np.exp(-4.0 * (large + 0.45 * fine + 0.35)))
    tone = 1.0 / (1.0 + np.exp(-1.2 * (fine - 0.4 * large)))[..., None]
    greens = np.array([0.20, 0.66, 0.58]) * (1.0 - tone) + np.array([0.84, 0.98, 0.92]) * tone
    copper = nma.load_material("verdigris-bronze").changed({"alpha_top": 0.15})
    textures = {"albedo": greens, "sigma_t": cover, "alpha_bottom": 0.12 + 0.4 * cover}
    return Subject(copper, {name: values.astype(np.float32) for name, values in textures.items()})


def scratched_gold() -> Subject:
    """Gold with finger prints and scratches, below a smooth red lacquer of uneven thickness."""
    textures = procedural_textures(TEXELS, seed=7)
    amount = 0.15 + 0.5 * textures["sigma_t"]
    gold = nma.load_material("gold-red-lacquer")
    return Subject(gold, {"alpha_bottom": textures["alpha_bottom"], "sigma_t": amount})


TEXTURED: dict[str, Callable[[], Subject]] = {
    "worn silver": worn_silver,
    "patinated copper": patinated_copper,
    "scratched gold": scratched_gold,
}


def preview(bsdf: Bsdf, size: tuple[int, int], rr_depth: int = RR_DEPTH) -> dict[str, Any]:
    """The preview scene outdoors: sun, sky and a lamp."""
    return preview_scene(bsdf, size=size, integrator=_path(rr_depth), lighting="outdoors")


def lights(bsdf: Bsdf, size: tuple[int, int], rr_depth: int = RR_DEPTH) -> dict[str, Any]:
    """The shader ball in the dark among small, bright lights. Light sampling and highlights cause most of the noise."""
    scene = preview(bsdf, size, rr_depth)
    del scene["sky"], scene["lamp"]
    return scene | {f"light-{n}": _light(*light) for n, light in enumerate(LIGHTS)}


def sphere(
    bsdf: Bsdf, size: tuple[int, int], rr_depth: int = RR_DEPTH, hide_sun: bool = False
) -> dict[str, Any]:
    """A sphere that fills the picture under sun and sky (one environment map)."""
    options: dict[str, Any] = {"integrator": _path(rr_depth), "lighting": "outdoors", "hide_sun": hide_sun}
    scene = preview_scene(bsdf, size=size, **options)
    del scene["floor"], scene["lamp"]
    scene["sensor"]["fov"] = 19.0
    ball = {"type": "sphere", "center": [0.0, 0.0, 1.0], "radius": 1.0}
    return scene | {"ball": ball | {"bsdf": {"type": "ref", "id": "material"}}}


def environment(bsdf: Bsdf, size: tuple[int, int], rr_depth: int = RR_DEPTH) -> dict[str, Any]:
    """The scene `sphere` without the sun, so that the sky has no bright spot."""
    return sphere(bsdf, size, rr_depth, hide_sun=True)


SCENES: dict[str, Callable[[Bsdf, tuple[int, int], int], dict[str, Any]]] = {
    "preview": preview,
    "lights": lights,
    "environment": environment,
    "sphere": sphere,
}


def teaser(
    model: Callable[[Subject], Bsdf], size: tuple[int, int], rr_depth: int = RR_DEPTH
) -> dict[str, Any]:
    """Three shader balls, one for each textured material; `model` returns the BSDF of a material.

    The scene has soft lights and no sun. Under a sun, a few pixels would hold nearly all of the noise, so many more
    frames would be needed to compare the BSDFs.
    """
    import mitsuba as mi

    subjects = [make() for make in TEXTURED.values()]
    options: dict[str, Any] = {"integrator": _path(rr_depth), "lighting": "outdoors", "hide_sun": True}
    scene = preview_scene(model(subjects[0]), size=size, camera=WIDE, **options)
    scene["lamp"]["to_world"] = (
        mi.ScalarTransform4f()
        .look_at(list(SOFT_BOX_PLACE), [0.0, 0.0, 0.9], [0.0, 0.0, 1.0])
        .scale(list(SOFT_BOX_SIZE))
    )
    radiance = {"type": "rgb", "value": [SOFT_BOX_RADIANCE * value for value in LAMP_RADIANCE]}
    scene["lamp"]["emitter"] = {"type": "area", "radiance": radiance}
    places = ((-2.12, 0.3, 10.0), (0.0, -0.1, 0.0), (2.12, 0.3, -16.0))
    del scene["ball"], scene["material"]
    for n, (subject, (x, y, turn)) in enumerate(zip(subjects, places, strict=True)):
        place = mi.ScalarTransform4f().translate([x, y, 0.0]).rotate([0.0, 0.0, 1.0], turn)
        ball = {"type": "ply", "filename": str(shader_ball_file()), "to_world": place}
        scene[f"ball-{n}"] = ball | {"bsdf": dict(model(subject))}
    return scene


def teaser_size(height: int) -> tuple[int, int]:
    """Returns width and height of the teaser, in pixels."""
    return round(TEASER_ASPECT * height), height


def digest() -> str:
    """Returns a hash of the code that makes the scenes.

    The file names of stored pictures contain the hash, so a scene is rendered again after its code has changed.
    """
    modules = (nma.render.scene, nma.render.lighting, nma.render.textures)
    files = [__file__, *(module.__file__ for module in modules)]
    return hashlib.sha256(b"".join(Path(str(file)).read_bytes() for file in files)).hexdigest()[:8]


def _path(rr_depth: int) -> dict[str, Any]:
    return {"type": "path", "max_depth": DEPTH, "rr_depth": rr_depth}


def _light(towards: tuple[float, ...], distance: float, colour: tuple[float, ...]) -> dict[str, Any]:
    """A small spherical light. The radiance grows with distance^2, so all lights illuminate the ball equally."""
    direction = np.array(towards) / np.linalg.norm(towards)
    radiance = (LIGHT_POWER * distance**2 * np.array(colour)).tolist()
    return {
        "type": "sphere",
        "center": (np.array(LIGHTS_AROUND) + distance * direction).tolist(),
        "radius": LIGHT_RADIUS,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }
