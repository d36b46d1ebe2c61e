"""The material-preview scene: the shader ball, or a mesh, on graph paper under a lighting of `nma.render.lighting`.

The whole scene is computed, so there are no asset files. The scene is a Mitsuba dictionary, so callers can change it
before `mi.load_dict`. In `mi.traverse`, the parameters of the material under test have the names `material.*`, those of
the paper `floor.*`, of the sky `sky.*`, of the lamp (outdoors only) `lamp.*`, and of the camera `sensor.*`. Only the
shape `ball` has the material.

Lengths are in units of the shell's radius, and z is up. Radiance is scaled so that pictures look right at exposure 0
(`nma.images.io.tonemap`). For example, perfectly white paper would have radiance 0.77 in the sun.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma.errors import ParamError
from nma.render import lighting as lights
from nma.render.lighting import smoothstep
from nma.render.mesh import mesh_shape, needs_coordinates
from nma.render.shaderball import shader_ball_file
from nma.render.textures import bitmap_texture


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

PAPER_SIZE = 240.0  # side length of the floor, whose edge lies far beyond the pattern
PAPER_PATTERN = 24.0  # side length of the part with the pattern, around the ball
# For each lighting: the paper's reflectance far from the ball, how much higher the reflectance is near the ball, and
# the contrast of the pattern.
PAPER_TONE = {"outdoors": (0.60, 0.25, 1.0), "studio": (0.08, 0.45, 0.5)}


def preview_scene(
    bsdf: Mapping[str, Any],
    *,
    size: tuple[int, int] = (256, 256),
    spp: int = 64,
    max_depth: int = 6,
    camera: str | Camera | None = None,
    envmap: str | Path | None = None,
    envmap_scale: float = 1.0,
    lighting: str = "studio",
    mesh: str | Path | None = None,
    mesh_up: str = "z",
    integrator: str | Mapping[str, Any] = "path",
    hide_sun: bool = False,
    rfilter: str = "box",
    sampler: str = "independent",
) -> dict[str, Any]:
    """The preview scene with the given material, ready for `mi.load_dict`.

    Args:
        bsdf: Mitsuba dictionary of the material; it is placed under the key `material`.
        size: width and height in pixels.
        spp: samples per pixel that `mi.render(scene)` takes by default.
        max_depth: the largest number of edges of a path, as Mitsuba counts them (1 shows only emitters).
        camera: a name in `CAMERAS`, a `Camera`, or None for "hero".
        envmap: an EXR or HDR file, latitude-longitude, y up in the file. This map replaces all other light.
        envmap_scale: factor on the environment map's radiance.
        lighting: "studio" (softboxes in a dim dome) or "outdoors" (sun, sky and a small lamp).
        mesh: a PLY or OBJ file to show in place of the shader ball, moved to the ball's place and scaled to the ball's
            size.
        mesh_up: the axis of the mesh file that points up, "z" or "y".
        integrator: "path", "prb", the name of another Mitsuba integrator that takes `max_depth`, or the dictionary of
            an integrator.
        hide_sun: whether the lighting "outdoors" leaves out the disc of the sun, but keeps the sky and the lamp.
        rfilter: reconstruction filter of the film. "box" keeps pixels statistically independent.
        sampler: name of a Mitsuba sampler. "multijitter" leaves less noise, but takes only certain sample counts; see
            `nma.render.progressive.sampler`.

    Returns:
        A new dictionary, which shares nothing with the dictionaries of other calls.

    Raises:
        ParamError: the camera or the lighting is unknown, the size or spp is not positive, the environment map is
            missing, or no variant of Mitsuba is set.
        MeshError: the mesh cannot be shown; see `nma.render.mesh.mesh_shape`.
    """
    import mitsuba as mi

    if mi.variant() is None:
        raise ParamError("preview_scene needs a variant of Mitsuba; call nma.render.use() first")
    width, height = size
    if min(width, height, spp) < 1:
        raise ParamError(f"preview_scene: size {size} and spp {spp} must be at least 1")
    light = lights.environment(Path(envmap), envmap_scale) if envmap else lights.emitters(lighting, hide_sun)
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": _integrator(integrator, max_depth),
        "sensor": _sensor(resolve_camera(camera), size, spp, rfilter, sampler),
        "material": {key: value for key, value in bsdf.items() if key != "id"},
        "ball": _subject(bsdf, mesh, mesh_up) | {"bsdf": {"type": "ref", "id": "material"}},
        "floor": _floor(*PAPER_TONE["outdoors" if envmap else lighting]),
    }
    return scene | light


def resolve_camera(camera: str | Camera | None) -> Camera:
    """Returns the given camera, the camera of `CAMERAS` with the given name, or the camera "hero" for None.

    Raises:
        ParamError: no camera has that name.
    """
    if camera is None:
        return CAMERAS["hero"]
    if isinstance(camera, Camera):
        return camera
    if camera not in CAMERAS:
        raise ParamError(
            f"unknown camera {camera!r}; choose {', '.join(CAMERAS)}, or a Camera(origin, target, fov)"
        )
    return CAMERAS[camera]


def material_mask(
    size: tuple[int, int] = (256, 256), camera: str | Camera | None = None
) -> NDArray[np.bool_]:
    """Which pixels show the material: (height, width) booleans, from one camera ray through the middle of each
    pixel."""
    import drjit as dr
    import mitsuba as mi

    width, height = size
    scene = mi.load_dict(preview_scene({"type": "diffuse"}, size=size, camera=camera))
    x, y = dr.meshgrid(dr.arange(mi.Float, width), dr.arange(mi.Float, height))
    middle = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, middle, mi.Point2f(0.5))

    # Rays that hit the ball are found by the pointer of the shape that they hit.
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    return np.array(scene.ray_intersect(ray).shape == mi.ShapePtr(ball)).reshape(height, width)


def material_coverage(size: tuple[int, int] = (256, 256), camera: str | Camera | None = None) -> float:
    """The share of the pixels, 0 to 1, whose camera ray hits the material first."""
    return float(material_mask(size, camera).mean())


def _subject(bsdf: Mapping[str, Any], mesh: str | Path | None, up: str) -> dict[str, Any]:
    """The shape that has the material: the given mesh or the shader ball."""
    if mesh is None:
        return {"type": "ply", "filename": str(shader_ball_file())}
    return mesh_shape(mesh, up=up, coordinates=needs_coordinates(bsdf))


def _integrator(integrator: str | Mapping[str, Any], max_depth: int) -> dict[str, Any]:
    return {"type": integrator, "max_depth": max_depth} if isinstance(integrator, str) else dict(integrator)


def _sensor(camera: Camera, size: tuple[int, int], spp: int, rfilter: str, sampler: str) -> dict[str, Any]:
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": rfilter}}
    return {
        "type": "perspective",
        "fov": camera.fov,
        "fov_axis": "smaller",
        "to_world": mi.ScalarTransform4f().look_at(list(camera.origin), list(camera.target), list(camera.up)),
        "film": film | {"pixel_format": "rgb", "component_format": "float32"},
        "sampler": {"type": sampler, "sample_count": spp},
    }


def _floor(far: float, near: float, contrast: float) -> dict[str, Any]:
    """A large sheet of graph paper. The pattern fades out with distance, so that the far edge is plain grey against the
    sky."""
    import mitsuba as mi

    pattern = bitmap_texture(_graph_paper(1536, far, near, contrast))
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


@lru_cache(maxsize=2)
def _graph_paper(size: int, far: float, near: float, contrast: float) -> NDArray[np.float32]:
    """Linear reflectance (size, size, 3) of the paper, with fine lines, bold lines, and a checkerboard of slightly
    darker squares."""
    place = (np.arange(size) + 0.5) / size * PAPER_PATTERN - PAPER_PATTERN / 2.0
    x, y = np.meshgrid(place, place)
    texel = PAPER_PATTERN / size

    def lines(period: float, width: float) -> NDArray[np.float64]:
        distance = np.minimum(*(np.abs((c + period / 2.0) % period - period / 2.0) for c in (x, y)))
        return np.clip((width / 2.0 - distance) / texel + 0.5, 0.0, 1.0)

    squares = (np.floor(x) + np.floor(y)) % 2.0
    distance = np.hypot(x, y) / (PAPER_PATTERN / 2.0)
    fine = 0.22 * contrast * (lines(0.25, 0.02) - 0.15) * smoothstep((0.75 - distance) / 0.5)
    bold = contrast * (0.14 * (squares - 0.5) + 0.45 * (lines(1.0, 0.045) - 0.09))
    tone = far + near * smoothstep((1.0 - distance) / 0.9) - fine - bold * smoothstep((1.0 - distance) / 0.8)
    paper = np.array([0.49, 0.485, 0.475])
    return (tone[..., None] * paper).astype(np.float32)
