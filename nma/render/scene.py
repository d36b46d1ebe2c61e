"""The material-preview scene: the shader ball on graph paper under sun, sky and one small area light.

Made by code alone, no assets. Everything is a Mitsuba dictionary, so it can be changed before `mi.load_dict`. Names
that `mi.traverse` shows: `material.*` is the material under test, `floor.*` the paper, `sky.*`, `lamp.*`,
`sensor.*`. The only shape with the material is `ball`.

Lengths are in units of the shell's radius, z is up. Radiance is scaled so that exposure 0 suits the picture
(`nma.image_io.tonemap`): perfectly white paper in the sun has radiance 0.77.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma.errors import ParamError
from nma.image_io import check_size
from nma.llvm import ensure_llvm
from nma.render.shaderball import shader_ball_file


class Camera(NamedTuple):
    """A pinhole camera; `fov` is the angle over the shorter side of the image, in degrees."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float = 30.0
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


CAMERAS: dict[str, Camera] = {
    "hero": Camera((-0.55, -5.6, 2.75), (0.0, 0.0, 1.0), 27.5),
    "close": Camera((0.9, -3.4, 2.35), (0.10, -0.25, 1.20), 30.0),
    "top": Camera((0.25, -2.0, 5.6), (0.0, -0.02, 0.9), 26.0),
}

SUN_DIRECTION = (-0.62, -0.50, 0.72)
SUN_APERTURE = 4.0  # degrees; eight times the real sun, so that shadows have a soft edge
SUN_SCALE, SKY_SCALE, TURBIDITY = 1.6, 3.6, 5.0
SATURATION = 0.5  # of sun and sky; less blue lets the colours of metals read
GROUND_RADIANCE, HORIZON_BLUR = (0.28, 0.28, 0.28), 0.12
LAMP_POSITION, LAMP_SIZE, LAMP_RADIANCE = (2.6, -2.4, 3.6), 0.17, (46.0, 42.0, 36.0)
PAPER_SIZE = 240.0  # side of the floor; the pattern fades out well before
PAPER_PATTERN = 24.0  # side of the part that carries the pattern


def preview_scene(
    bsdf: Mapping[str, Any],
    *,
    size: tuple[int, int] = (256, 256),
    spp: int = 64,
    max_depth: int = 6,
    camera: str | Camera | None = None,
    envmap: str | Path | None = None,
    envmap_scale: float = 1.0,
    integrator: str | Mapping[str, Any] = "path",
    hide_sun: bool = False,
    rfilter: str = "box",
) -> dict[str, Any]:
    """The preview scene around one material, ready for `mi.load_dict`.

    Args:
        bsdf: Mitsuba dictionary of the material; it is placed under the key `material`.
        size: width and height in pixels.
        spp: samples per pixel, the default of `mi.render(scene)`.
        max_depth: longest path in edges, as Mitsuba counts (1 is emission alone).
        camera: a name in `CAMERAS`, a `Camera`, or None for "hero".
        envmap: an EXR or HDR file, latitude-longitude, y up in the file. It replaces the sun, the sky and the lamp.
        envmap_scale: factor on the environment map's radiance.
        integrator: "path", "prb", another integrator of Mitsuba's that takes `max_depth`, or a whole dictionary.
        hide_sun: leave out the disc of the sun, keep the sky and the lamp.
        rfilter: reconstruction filter of the film. "box" keeps pixels statistically independent.

    Returns:
        A new dictionary; nothing in it is shared with other calls.

    Raises:
        ParamError: an unknown camera, a size or spp that is not positive, a missing environment map, no variant of
            Mitsuba in use.
    """
    import mitsuba as mi

    if mi.variant() is None:
        raise ParamError("preview_scene needs a variant of Mitsuba; call nma.render.use() first")
    width, height = size
    if min(width, height, spp) < 1:
        raise ParamError(f"preview_scene: size {size} and spp {spp} must be at least 1")
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": _integrator(integrator, max_depth),
        "sensor": _sensor(resolve_camera(camera), size, spp, rfilter),
        "material": {key: value for key, value in bsdf.items() if key != "id"},
        "ball": {
            "type": "ply",
            "filename": str(shader_ball_file()),
            "bsdf": {"type": "ref", "id": "material"},
        },
        "floor": _floor(),
    }
    scene.update(_environment(Path(envmap), envmap_scale) if envmap else _sun_sky_lamp(hide_sun))
    return scene


def resolve_camera(camera: str | Camera | None) -> Camera:
    """The camera of that name, or the camera itself; None means "hero".

    Raises:
        ParamError: no camera has that name.
    """
    if camera is None:
        return CAMERAS["hero"]
    if isinstance(camera, Camera):
        return camera
    if camera not in CAMERAS:
        raise ParamError(
            f"unknown camera {camera!r}; take {', '.join(CAMERAS)}, or a Camera(origin, target, fov)"
        )
    return CAMERAS[camera]


def material_mask(
    size: tuple[int, int] = (256, 256), camera: str | Camera | None = None
) -> NDArray[np.bool_]:
    """Which pixels show the material: (height, width), by one camera ray through the middle of each pixel."""
    import drjit as dr
    import mitsuba as mi

    width, height = size
    scene = mi.load_dict(preview_scene({"type": "diffuse"}, size=size, camera=camera))
    x, y = dr.meshgrid(dr.arange(mi.Float, width), dr.arange(mi.Float, height))
    middle = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, middle, mi.Point2f(0.5))

    # The identifiers of the shapes' pointers tell the ball from the floor.
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    return np.array(scene.ray_intersect(ray).shape == mi.ShapePtr(ball)).reshape(height, width)


def material_coverage(size: tuple[int, int] = (256, 256), camera: str | Camera | None = None) -> float:
    """Share of the pixels, 0 to 1, whose camera ray meets the material first."""
    return float(material_mask(size, camera).mean())


def bitmap_texture(values: NDArray[np.floating], *, scale: float = 1.0) -> dict[str, Any]:
    """A Mitsuba `bitmap` dictionary around an array, without any colour conversion.

    Args:
        values: (height, width) or (height, width, 3), linear.
        scale: how often the texture repeats per unit of uv.
    """
    import mitsuba as mi

    texture: dict[str, Any] = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32)),
    }
    texture |= {"raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}
    return texture | {"to_uv": mi.ScalarTransform4f().scale([scale, scale, 1.0])}


def _integrator(integrator: str | Mapping[str, Any], max_depth: int) -> dict[str, Any]:
    return {"type": integrator, "max_depth": max_depth} if isinstance(integrator, str) else dict(integrator)


def _sensor(camera: Camera, size: tuple[int, int], spp: int, rfilter: str) -> dict[str, Any]:
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": rfilter}}
    return {
        "type": "perspective",
        "fov": camera.fov,
        "fov_axis": "smaller",
        "to_world": mi.ScalarTransform4f().look_at(list(camera.origin), list(camera.target), list(camera.up)),
        "film": film | {"pixel_format": "rgb", "component_format": "float32"},
        "sampler": {"type": "independent", "sample_count": spp},
    }


def _sun_sky_lamp(hide_sun: bool) -> dict[str, Any]:
    """Hosek and Wilkie's sun and sky, and a small square lamp high on the right that shows how sharp a coat is."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at(list(LAMP_POSITION), [0.0, 0.0, 1.1], [0.0, 0.0, 1.0])
    lamp = {
        "type": "rectangle",
        "to_world": place @ mi.ScalarTransform4f().scale(LAMP_SIZE),
        "emitter": {
            "type": "area",
            "sampling_weight": 0.15,
            "radiance": {"type": "rgb", "value": list(LAMP_RADIANCE)},
        },
    }
    radiance = mi.Bitmap(sky_radiance(0.0 if hide_sun else SUN_SCALE).copy())
    return {"sky": {"type": "envmap", "bitmap": radiance, "to_world": _upright()}, "lamp": lamp}


@lru_cache(maxsize=4)
def sky_radiance(sun_scale: float = SUN_SCALE, height: int = 512) -> NDArray[np.float32]:
    """Mitsuba's `sunsky` as an image: (height, 2 height, 3) linear sRGB, latitude-longitude, up at the top.

    As an image its sun is importance-sampled: lighting the floor alone, 51 times less variance per sample than the
    emitter itself. At the horizon the model, black below, goes over softly into the floor's colour; further down
    the floor hides everything, and black wastes no samples.
    """
    import drjit as dr
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        raise ParamError("sky_radiance needs a variant of Mitsuba; call nma.render.use() first")
    if "scalar" in variant:
        # The model is evaluated for all pixels at once.
        ensure_llvm()
        mi.set_variant("llvm_ad_rgb")
        try:
            return sky_radiance(sun_scale, height)
        finally:
            mi.set_variant(variant)
    model = {"type": "sunsky", "sun_direction": list(SUN_DIRECTION), "sun_aperture": SUN_APERTURE}
    model |= {"sun_scale": sun_scale, "sky_scale": SKY_SCALE, "turbidity": TURBIDITY}
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth, polar = np.meshgrid(azimuth, polar)

    # Look a little above the horizon for all directions below it, then blend to the ground's colour.
    up = np.maximum(np.cos(polar), 0.01)
    across = np.sqrt(1.0 - up * up)
    direction = np.stack([np.sin(azimuth) * across, np.cos(azimuth) * across, up]).reshape(3, -1)
    si = dr.zeros(mi.SurfaceInteraction3f, direction.shape[1])
    si.wi = -mi.Vector3f(direction.astype(np.float32))
    sky = np.array(mi.load_dict(model).eval(si)).T.reshape(height, 2 * height, 3)
    sky = SATURATION * sky + (1.0 - SATURATION) * (sky @ np.array([0.2126, 0.7152, 0.0722]))[..., None]
    ground = np.clip(0.5 - np.cos(polar) / (2.0 * HORIZON_BLUR), 0.0, 1.0)[..., None]
    ground = ground * ground * (3.0 - 2.0 * ground)
    horizon = sky + (np.array(GROUND_RADIANCE) - sky) * ground
    radiance = np.where(np.cos(polar)[..., None] < -HORIZON_BLUR, 0.0, horizon).astype(np.float32)
    radiance.flags.writeable = False  # it is cached
    return radiance


def _environment(path: Path, scale: float) -> dict[str, Any]:
    if not path.is_file():
        raise ParamError(f"environment map {path} does not exist; pass an EXR or HDR file")
    check_size(path)
    return {"sky": {"type": "envmap", "filename": str(path), "scale": scale, "to_world": _upright()}}


def _upright() -> Any:
    """From Mitsuba's environment maps, y up, to the scene, z up."""
    import mitsuba as mi

    return mi.ScalarTransform4f().rotate([1.0, 0.0, 0.0], 90.0)


def _floor() -> dict[str, Any]:
    """A large sheet of graph paper whose pattern fades out, so that its far edge is one soft grey against the sky."""
    import mitsuba as mi

    pattern = bitmap_texture(_graph_paper(1536))
    repeat = PAPER_SIZE / PAPER_PATTERN
    fit = (
        mi.ScalarTransform4f()
        .translate([0.5 - repeat / 2.0, 0.5 - repeat / 2.0, 0.0])
        .scale([repeat, repeat, 1.0])
    )
    pattern |= {"wrap_mode": "clamp", "to_uv": fit}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().scale(PAPER_SIZE / 2.0),
        "bsdf": {"type": "diffuse", "reflectance": pattern},
    }


def _smoothstep(x: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    t = np.clip(x / width, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@lru_cache(maxsize=1)
def _graph_paper(size: int) -> NDArray[np.float32]:
    """Linear reflectance (size, size, 3) of the paper: fine lines, bold lines, alternate squares a little darker."""
    place = (np.arange(size) + 0.5) / size * PAPER_PATTERN - PAPER_PATTERN / 2.0
    x, y = np.meshgrid(place, place)
    texel = PAPER_PATTERN / size

    def lines(period: float, width: float) -> NDArray[np.float64]:
        distance = np.minimum(*(np.abs((c + period / 2.0) % period - period / 2.0) for c in (x, y)))
        return np.clip((width / 2.0 - distance) / texel + 0.5, 0.0, 1.0)

    squares = (np.floor(x) + np.floor(y)) % 2.0
    distance = np.hypot(x, y) / (PAPER_PATTERN / 2.0)
    fine = 0.22 * (lines(0.25, 0.02) - 0.15) * _smoothstep(0.75 - distance, 0.5)
    bold = 0.14 * (squares - 0.5) + 0.45 * (lines(1.0, 0.045) - 0.09)
    tone = 0.60 + 0.25 * _smoothstep(1.0 - distance, 0.9) - fine - bold * _smoothstep(1.0 - distance, 0.8)
    paper = np.array([0.49, 0.485, 0.475])
    return (tone[..., None] * paper).astype(np.float32)
