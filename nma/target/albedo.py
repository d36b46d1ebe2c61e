"""Upper bounds of the directional albedo of each lobe of a Principled BRDF. A lobe is sampled with a probability in
proportion to its bound. `bounded` uses the bounds to keep a blend from reflecting more light than it receives.

The Principled BRDF does not conserve energy. The diffuse lobe is not reduced where the specular lobe and the clearcoat
reflect light. The albedo of the diffuse lobe, with its retro-reflection, reaches 1.5 at grazing angles. For saturated
colours, `spec_tint` may multiply a reflectance of .13 by 13. tests/test_target_albedo.py checks the bounds by
quadrature over the ranges of the parameters.
"""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Color, Float
from nma.target.interface import Interface, cos_below, cos_shifted
from nma.target.principled import (
    CLEARCOAT_F0,
    CLEARCOAT_MASKING_ALPHA,
    Principled,
    dielectric_reflectance,
    luminance_inverse,
    schlick_weight,
    spec_alpha,
    spec_fresnel,
)

# MIN_ALBEDO is added to the bounds of the diffuse and the specular lobe, so that both lobes are sampled even where they
# reflect nothing.
MIN_ALBEDO = 1e-4
# The fitted formulas are too low by at most these margins. To get upper bounds, the margins are added to the formulas.
SPEC_MARGIN = 0.009
CLEARCOAT_MARGIN = 0.005
SHEEN_MARGIN = 0.0005
INTERFACE_MARGIN = 0.007
# Cosine-weighted means over the hemisphere of wo: _W0 is the mean of the Schlick weight of wo, _W1 that of the weight
# times cos(theta_o), and _W2 that of the weight times cos^2(theta_o).
_W0, _W1, _W2 = 1.0 / 21.0, 1.0 / 84.0, 1.0 / 252.0


class Albedos(NamedTuple):
    """Upper bounds of the directional albedo of each lobe of an instance, and an estimate of the part of the specular
    lobe's light that leaves through the interface above."""

    diffuse: Color
    spec: Color
    clearcoat: Float
    leaving: Float


def lobe_albedos(p: Principled, cos_theta_i: Float) -> Albedos:
    """The bounds of all lobes at cos(theta_i) > 0. The fields `flatness` and `fade` are ignored."""
    weight = schlick_weight(cos_theta_i)
    # The three bounds are not stored in local variables, because the C++ runtime would copy them, which costs 2.5 ns
    # per query.
    return Albedos(
        diffuse_albedo(p, cos_theta_i, weight) + MIN_ALBEDO,
        spec_albedo(p, cos_theta_i) + MIN_ALBEDO,
        clearcoat_albedo(p, cos_theta_i, weight),
        1.0,
    )


def lobe_albedos_below(p: Principled, interface: Interface, cos_theta_i: Float) -> Albedos:
    """The bounds of all lobes of an instance under an interface, at cos(theta_i) > 0. `clearcoat` is the bound of the
    interface's own lobe. The bounds ignore the light that is lost on the way out."""
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    alpha = ops.minimum(alpha_x, alpha_y)
    inverse = 1.0 / interface.eta
    view = cos_shifted(cos_below(cos_theta_i, interface.eta, inverse), p.shift)
    return Albedos(
        p.base_color * (1.0 - p.metallic) + MIN_ALBEDO,
        p.base_color * (p.metallic * unmasked_albedo(alpha, view)) + (SPEC_MARGIN + MIN_ALBEDO),
        interface_albedo(interface, cos_theta_i),
        leaving(alpha, view, inverse * inverse),
    )


def leaving(alpha: Float, cos: Float, cone: Float) -> Float:
    """An estimate of the part of a specular lobe's light that leaves through a smooth interface, where the rest is
    reflected back down. `cos` is the cosine of the view below the interface, and `cone` is 1 / eta^2, the part of
    diffuse light that leaves.

    A sharp lobe leaves if its mirror direction does, and of a wide lobe, a part leaves that is in proportion to `cone`.
    The constants are fitted to 3000 random lobes, for which the estimate is wrong by .034 on average.
    """
    # The squared cosine of the mirror direction above the interface, times `cone`; negative if it does not leave.
    mirror = cone - (1.0 - cos * cos)
    # Of a lobe of this reach, a part leaves that grows evenly from 0 to 1 while `mirror` grows by the reach.
    reach = (8.44 * alpha + 0.0066) * cone
    sharp = ops.minimum(ops.maximum(0.5 * reach + mirror, 0.0), reach)
    # The mean of sharp / reach and .75 cone, with the weights .283 and alpha.
    found = (0.283 * sharp + (0.75 * cone * alpha) * reach) / ((alpha + 0.283) * reach)
    return ops.maximum(found, 0.05)


def interface_albedo(interface: Interface, cos: Float) -> Float:
    """The bound of the interface's own lobe: a bound of the masking, times the reflectance of a typical facet.

    The bound is closer than that of `spec_albedo`, because together with the light from below the interface, the lobe
    often reflects nearly all light. Widths above .3 have the bound of .3, and indices below 1.05 that of 1.05.
    """
    alpha = ops.minimum(interface.alpha, 0.3)
    grazing = cos / alpha
    tilt = 0.37 * alpha / (alpha + 0.205)
    facet2 = ops.minimum(cos * cos + tilt * tilt / (1.0 + 0.2 * grazing), 1.0)
    masked = 0.13 / (1.0 + 0.22 * grazing * grazing) + alpha * (0.87 - 1.7 * cos)
    unmasked = ops.minimum(1.0 - masked + 0.3 * ops.maximum(interface.eta - 2.0, 0.0), 1.0)
    fresnel = dielectric_reflectance(ops.sqrt(facet2), facet2, ops.maximum(interface.eta, 1.05))
    return fresnel * unmasked + INTERFACE_MARGIN


def diffuse_albedo(p: Principled, cos: Float, weight: Float) -> Color:
    """The bound of the diffuse lobe: the closed-form integral of base and retro-reflection, plus a fitted formula for
    the sheen."""
    r = p.roughness
    lambert = (1.0 - 0.5 * weight) * (1.0 - 0.5 * _W0)
    # In `diffuse_terms`, the factor of retro-reflection is F = r (1 + wi . wo). With the Schlick weight w of wo, the
    # cosine-weighted means over wo are `retro` of F, `retro_w` of F w, and `retro2_w` of F^2 w.
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
    """The bound of the specular lobe (single scattering): a bound of the masking, times the Fresnel reflectance of a
    typical facet.

    The typical facet is tilted towards the viewer, as the visible facets of rough surfaces are at grazing angles.
    """
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    alpha = ops.minimum(alpha_x, alpha_y)  # facets tilt less along the axis of the smaller width
    tilt = 0.62 * alpha / (alpha + 0.35)
    facet2 = ops.minimum(cos * cos + tilt * tilt, 1.0)
    facet = ops.sqrt(facet2)
    fresnel = spec_fresnel(p, facet, facet2, schlick_weight(facet))
    return (p.base_color * fresnel.colored + fresnel.white) * unmasked_albedo(alpha, cos) + SPEC_MARGIN


def unmasked_albedo(alpha: Float, cos: Float) -> Float:
    """The bound of the albedo of a specular lobe that reflects all light: its masking."""
    return ops.minimum(1.1 - alpha * (0.33 + 0.385 * cos), 1.0)


def clearcoat_albedo(p: Principled, cos: Float, weight: Float) -> Float:
    """The bound of the clearcoat, which is treated as a mirror.

    The bound minus its margin goes to 0 at grazing angles, because the clearcoat has no factor 1 / (4 cos_i cos_o).
    """
    # The masking G1 is that of `masking_denominator`, with sin^2(theta_i) computed from the cosine.
    cos2 = cos * cos
    alpha2 = CLEARCOAT_MASKING_ALPHA * CLEARCOAT_MASKING_ALPHA
    masking = 2.0 * cos / (cos + ops.sqrt(cos2 + alpha2 * (1.0 - cos2)))
    fresnel = ops.lerp(CLEARCOAT_F0, 1.0, weight)
    return p.clearcoat * (fresnel * cos2 * masking * masking + CLEARCOAT_MARGIN)
