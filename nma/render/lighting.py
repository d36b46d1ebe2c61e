"""Light for the preview scene: a studio of softboxes, or sun, sky and a small lamp. All lights are computed, so there
are no asset files.

Each lighting is a dictionary of Mitsuba's emitters. The sky is an image, whose pixels Mitsuba samples in proportion to
their brightness. Lengths are in units of the shader ball's radius, and z is up. Directions point from the shader ball
to the light.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma.errors import ParamError, either, one_line
from nma.images.io import load_bitmap
from nma.llvm import ensure_llvm

Array = NDArray[np.float64]
Colour = tuple[float, float, float]
LIGHTINGS = ("studio", "outdoors")

SUN_DIRECTION = (-0.62, -0.50, 0.72)
SUN_APERTURE = 4.0  # degrees, eight times the aperture of the real sun, so that shadows have soft edges
SUN_SCALE, SKY_SCALE, TURBIDITY = 1.6, 3.6, 5.0
# The colour saturation of sun and sky is reduced, because the colours of metals are easier to see in less blue light.
SATURATION = 0.5
GROUND_RADIANCE, HORIZON_BLUR = (0.28, 0.28, 0.28), 0.12
LAMP_POSITION, LAMP_SIZE, LAMP_RADIANCE = (2.6, -2.4, 3.6), 0.17, (46.0, 42.0, 36.0)


class Softbox(NamedTuple):
    """A rectangular light at infinite distance.

    `towards`: direction of the rectangle's middle. `half`: half the width and half the height, as angles seen from the
    ball [degrees]. `edge`: width of the soft edge [degrees]. `turn`: rotation about the line of sight [degrees].
    `radiance`: linear sRGB.
    """

    towards: tuple[float, float, float]
    half: tuple[float, float]
    edge: float
    turn: float
    radiance: Colour

    def coverage(self, direction: Array) -> Array:
        """The share of the light's radiance in each of the directions (..., 3): 1 inside the rectangle, 0 outside, and
        smooth between."""
        middle = np.array(self.towards) / np.linalg.norm(self.towards)
        right = np.cross(middle, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        turn = np.radians(self.turn)
        across = np.cos(turn) * right + np.sin(turn) * np.cross(right, middle)
        along = np.cross(across, middle)

        # Project onto the plane that touches the sphere at the middle.
        depth = direction @ middle
        place = np.stack([direction @ across, direction @ along], -1) / np.maximum(depth, 1e-3)[..., None]
        angle = np.degrees(np.arctan(np.abs(place)))
        sides = smoothstep((np.array(self.half) - angle) / self.edge + 0.5)
        return np.where(depth > 0.0, sides.prod(axis=-1), 0.0)


SOFTBOXES = (
    # The main light, on the left: two panes with a bar between them. This light has most of the power, so that most
    # light samples go to it. Samples of another light are wasted at all points that this other light does not reach.
    Softbox((-0.93, -0.42, 0.66), (8.0, 13.5), 1.5, 0.0, (18.0, 17.4, 16.5)),
    Softbox((-0.70, -0.72, 0.66), (8.0, 13.5), 1.5, 0.0, (18.0, 17.4, 16.5)),
    Softbox((0.92, -0.15, 0.42), (1.8, 28.0), 1.0, 8.0, (11.8, 12.5, 13.7)),  # a strip on the right
    Softbox((0.05, 0.70, 0.72), (32.0, 1.8), 1.0, 0.0, (9.4, 9.4, 9.4)),  # a bar above and behind
    Softbox((-0.85, 0.50, 0.25), (1.8, 18.0), 1.0, 0.0, (8.8, 8.8, 8.8)),  # a strip behind, on the left
)
HORIZON, ZENITH = (0.038, 0.038, 0.041), (0.20, 0.22, 0.255)
SKY_RISE = 0.55  # from the elevation with this sine upwards, the dome is as bright as at the zenith


def emitters(lighting: str, hide_sun: bool = False) -> dict[str, Any]:
    """The lights of the lighting with this name: a Mitsuba dictionary for each key of the scene.

    Raises:
        ParamError: no lighting has that name, or `hide_sun` is set and the lighting has no sun.
    """
    if lighting not in LIGHTINGS:
        raise ParamError(f"unknown lighting {lighting!r}; choose {either(LIGHTINGS)}")
    if lighting == "outdoors":
        return {"sky": _image(sky_radiance(0.0 if hide_sun else SUN_SCALE)), "lamp": _lamp()}
    if hide_sun:
        raise ParamError(f"the {lighting} has no sun to hide; choose lighting='outdoors'")
    return {"sky": _image(studio_radiance())}


def environment(path: Path, scale: float) -> dict[str, Any]:
    """An environment map as the only light: its Mitsuba dictionary under the key `sky`.

    Raises:
        ParamError: the file does not exist, is not an image, or has pixels that are not finite.
    """
    if not path.is_file():
        raise ParamError(f"environment map {path} does not exist; pass an EXR or HDR file")
    try:
        pixels = np.array(load_bitmap(path))
    except RuntimeError as error:
        raise ParamError(f"environment map {path} cannot be read: {one_line(str(error))}") from error
    if not np.isfinite(pixels).all():
        raise ParamError(f"environment map {path} has pixels that are NaN or infinite; export it anew")
    return {"sky": {"type": "envmap", "filename": str(path), "scale": scale, "to_world": _upright()}}


@lru_cache(maxsize=1)
def studio_radiance(height: int = 512) -> NDArray[np.float32]:
    """The studio as an image: (height, 2 height, 3) linear sRGB, latitude-longitude, up at the top.

    The softboxes hang in a dim dome that darkens towards the horizon, so that smooth coats have edges to reflect. No
    light is both small and very bright, so a path that hits a light by chance adds little noise.
    """
    direction = sky_directions(height)
    rise = smoothstep(direction[..., 2:] / SKY_RISE)
    radiance = np.array(HORIZON) * (1.0 - rise) + np.array(ZENITH) * rise
    for box in SOFTBOXES:
        radiance += box.coverage(direction)[..., None] * np.array(box.radiance)
    return _read_only(np.where(direction[..., 2:] < -HORIZON_BLUR, 0.0, radiance))


@lru_cache(maxsize=4)
def sky_radiance(sun_scale: float = SUN_SCALE, height: int = 512) -> NDArray[np.float32]:
    """Mitsuba's `sunsky` as an image: (height, 2 height, 3) linear sRGB, latitude-longitude, up at the top.

    As Mitsuba importance-samples the pixels of an image, a scene with only the floor has 51 times less variance per
    sample than with the emitter `sunsky`. Mitsuba's model is black below the horizon. Just below the horizon, this
    image fades into the floor's colour. Further down the image stays black, because the floor hides that part and black
    pixels get no samples.
    """
    import drjit as dr
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        raise ParamError("sky_radiance needs a variant of Mitsuba; call nma.render.use() first")
    if "scalar" in variant:
        # The model is evaluated for all pixels at once, which scalar variants cannot do.
        ensure_llvm()
        mi.set_variant("llvm_ad_rgb")
        try:
            return sky_radiance(sun_scale, height)
        finally:
            mi.set_variant(variant)
    model = {"type": "sunsky", "sun_direction": list(SUN_DIRECTION), "sun_aperture": SUN_APERTURE}
    model |= {"sun_scale": sun_scale, "sky_scale": SKY_SCALE, "turbidity": TURBIDITY}

    # Pixels below the horizon get the sky's colour just above the horizon, blended with the ground's colour.
    cosine = sky_directions(height)[..., 2]
    direction = sky_directions(height, lowest=0.01).reshape(-1, 3)
    si = dr.zeros(mi.SurfaceInteraction3f, len(direction))
    si.wi = -mi.Vector3f(direction.T.astype(np.float32))
    sky = np.array(mi.load_dict(model).eval(si)).T.reshape(height, 2 * height, 3)
    sky = SATURATION * sky + (1.0 - SATURATION) * (sky @ np.array([0.2126, 0.7152, 0.0722]))[..., None]
    ground = smoothstep(0.5 - cosine / (2.0 * HORIZON_BLUR))[..., None]
    horizon = sky + (np.array(GROUND_RADIANCE) - sky) * ground
    return _read_only(np.where(cosine[..., None] < -HORIZON_BLUR, 0.0, horizon))


def sky_directions(height: int, lowest: float = -1.0) -> Array:
    """The direction of each pixel of a latitude-longitude image: (height, 2 height, 3). z is up, and at least
    `lowest`."""
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth, polar = np.meshgrid(azimuth, polar)
    up = np.maximum(np.cos(polar), lowest)
    across = np.sqrt(1.0 - up * up)
    return np.stack([np.sin(azimuth) * across, np.cos(azimuth) * across, up], -1)


def smoothstep(x: Array) -> Array:
    """A smooth step for each element of x: 0 where x < 0, 1 where x > 1, and 3 x^2 - 2 x^3 between."""
    t = np.clip(x, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _read_only(radiance: Array) -> NDArray[np.float32]:
    made = radiance.astype(np.float32)
    made.flags.writeable = False  # because callers share the cached array
    return made


def _image(radiance: NDArray[np.float32]) -> dict[str, Any]:
    import mitsuba as mi

    return {"type": "envmap", "bitmap": mi.Bitmap(radiance.copy()), "to_world": _upright()}


def _lamp() -> dict[str, Any]:
    """A small square lamp high on the right, whose reflection shows how smooth a coat is."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at(list(LAMP_POSITION), [0.0, 0.0, 1.1], [0.0, 0.0, 1.0])
    radiance = {"type": "rgb", "value": list(LAMP_RADIANCE)}
    return {
        "type": "rectangle",
        "to_world": place @ mi.ScalarTransform4f().scale(LAMP_SIZE),
        "emitter": {"type": "area", "sampling_weight": 0.15, "radiance": radiance},
    }


def _upright() -> Any:
    """The transform from the frame of Mitsuba's environment maps, where y is up, to the frame of the scene, where z is
    up."""
    import mitsuba as mi

    return mi.ScalarTransform4f().rotate([1.0, 0.0, 0.0], 90.0)
