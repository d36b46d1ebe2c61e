"""Renders shader balls of unseen materials in soft light, so that the pictures have little noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import nma
from nma.materials import Material
from nma.render.lighting import LAMP_RADIANCE
from nma.render.load import load_dict
from nma.render.progressive import render_passes

# The side length of the soft box, relative to the side length of the scene's lamp.
SOFT_BOX = 7


def material(number: int, params: NDArray[np.float64]) -> Material:
    """Returns a validation material from its parameters (13,) and its index in the set, `number`."""
    return Material.of_vector(f"validation-material-{number}", params, nma.LAYERED3)


def describe(material: Material) -> str:
    """Returns a line with both microfacet widths (alphas), the coat's index of refraction, and the extinction."""
    short = "{}: alpha {alpha_top:.3f} over {alpha_bottom:.3f}, eta {eta_top:.2f}, sigma_t {sigma_t:.2f}"
    return short.format(material.title, **material.values)


def worst_to_median(errors: ArrayLike, count: int) -> NDArray[np.intp]:
    """Returns `count` indices at even steps from the largest error to the median, or fewer if errors are few."""
    worst_first = np.argsort(errors)[::-1]
    return worst_first[np.unique(np.linspace(0, len(worst_first) // 2, count).astype(int))]


def render(
    bsdf: dict[str, Any], size: int, spp: int, seed: int, sampler: str = "independent"
) -> NDArray[np.float32]:
    """Renders a picture (size, size, 3) of the shader ball with the BSDF `bsdf`."""
    return render_passes(load_dict(scene(bsdf, size, sampler)), spp, seed=seed)


def scene(bsdf: dict[str, Any], size: int, sampler: str = "independent") -> dict[str, Any]:
    """Returns the preview scene with a sky but no sun, a soft box in place of the lamp, and one bounce of light.

    Small lights and caustics are avoided, because they would cause noise that hides the differences between adapters.
    """
    made = nma.preview_scene(bsdf, size=(size, size), lighting="outdoors", hide_sun=True, max_depth=3)
    made["sensor"]["sampler"]["type"] = sampler
    made["lamp"]["to_world"] = made["lamp"]["to_world"].scale(SOFT_BOX)
    radiance = [value / SOFT_BOX**2 for value in LAMP_RADIANCE]
    made["lamp"]["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return made
