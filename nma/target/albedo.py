"""Directional albedos of the lobes of a Principled BRDF, as upper bounds: they are the odds of sampling a lobe, and
keep a blend from reflecting more light than it receives.

The Principled BRDF does not conserve energy: a bright diffuse base does not know of the reflection above it, its
retro-reflection alone reaches 1.5 at grazing angles, and `spec_tint` may multiply a reflectance of .13 by 13.
Checked by quadrature over the parameters' ranges (tests/test_target_albedo.py).
"""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Color, Float
from nma.target.principled import (
    CLEARCOAT_F0,
    CLEARCOAT_MASKING_ALPHA,
    Principled,
    luminance_inverse,
    schlick_weight,
    spec_alpha,
    spec_fresnel,
)

# Keep the densities of the broad and the coloured lobe positive where they reflect nothing.
MIN_ALBEDO = 1e-4
# By how much the fitted parts of the bounds fall short, at worst.
SPEC_MARGIN = 0.009
CLEARCOAT_MARGIN = 0.005
SHEEN_MARGIN = 0.0005
# Means of the Schlick weight of wo times the powers 0, 1 and 2 of cos(theta_o), over the cosine-weighted hemisphere.
_W0, _W1, _W2 = 1.0 / 21.0, 1.0 / 84.0, 1.0 / 252.0


class Albedos(NamedTuple):
    """What each lobe of an instance reflects of uniform light, at most."""

    diffuse: Color
    spec: Color
    clearcoat: Float


def lobe_albedos(p: Principled, cos_theta_i: Float) -> Albedos:
    """Bounds for `wi` at cos(theta_i) > 0; `flatness` is taken for 0, and nothing fades."""
    weight = schlick_weight(cos_theta_i)
    # Names for the parts would cost the C++ runtime copies: 2.5 ns of a query.
    return Albedos(
        diffuse_albedo(p, cos_theta_i, weight) + MIN_ALBEDO,
        spec_albedo(p, cos_theta_i) + MIN_ALBEDO,
        clearcoat_albedo(p, cos_theta_i, weight),
    )


def diffuse_albedo(p: Principled, cos: Float, weight: Float) -> Color:
    """The diffuse lobe with its retro-reflection, integrated in closed form, and the sheen, fitted."""
    r = p.roughness
    lambert = (1.0 - 0.5 * weight) * (1.0 - 0.5 * _W0)
    # The retro-reflection of `diffuse_terms` is r (1 + wi . wo); means over wo of it, of it times the weight of wo,
    # and of its square times that weight.
    retro = r * (1.0 + (2.0 / 3.0) * cos)
    retro_w = r * (_W0 + cos * _W1)
    sin2 = 1.0 - cos * cos
    retro2_w = r * r * (_W0 + 2.0 * cos * _W1 + cos * cos * _W2 + 0.5 * sin2 * (_W0 - _W2))
    base = lambert + retro_w + weight * (retro + retro2_w - retro_w)
    x = 1.0 - cos
    sheen = x * x * (0.0904 + x * (-0.1469 + x * (0.2194 - 0.0745 * x))) + SHEEN_MARGIN
    tint = p.base_color * (p.sheen_tint * luminance_inverse(p.base_color)) + (1.0 - p.sheen_tint)
    return (p.base_color * base + tint * (p.sheen * sheen)) * (1.0 - p.metallic)


def spec_albedo(p: Principled, cos: Float) -> Color:
    """The specular lobe, single scattering: masking at most 1, and Fresnel at the cosine of a typical facet.

    Rough surfaces at grazing angles show facets that are tilted towards the viewer.
    """
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    alpha = ops.minimum(alpha_x, alpha_y)  # the direction in which facets tilt least
    tilt = 0.62 * alpha / (alpha + 0.35)
    facet2 = ops.minimum(cos * cos + tilt * tilt, 1.0)
    facet = ops.sqrt(facet2)
    fresnel = spec_fresnel(p, facet, facet2, schlick_weight(facet))
    unmasked = ops.minimum(1.1 - alpha * (0.33 + 0.385 * cos), 1.0)
    return (p.base_color * fresnel.colored + fresnel.white) * unmasked + SPEC_MARGIN


def clearcoat_albedo(p: Principled, cos: Float, weight: Float) -> Float:
    """The clearcoat as if it were a mirror; it fades at grazing for lack of 1 / (4 cos_i cos_o)."""
    # `masking_denominator` without the root that is sin(theta_i).
    cos2 = cos * cos
    alpha2 = CLEARCOAT_MASKING_ALPHA * CLEARCOAT_MASKING_ALPHA
    masking = 2.0 * cos / (cos + ops.sqrt(cos2 + alpha2 * (1.0 - cos2)))
    fresnel = ops.lerp(CLEARCOAT_F0, 1.0, weight)
    return p.clearcoat * (fresnel * cos2 * masking * masking + CLEARCOAT_MARGIN)
