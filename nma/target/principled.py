"""One Principled BRDF (Burley 2012 and 2015): its value and the sampling densities of its lobes.

The dialect "mitsuba-principled-reflection" is the reflection side (spec_trans = 0) of Mitsuba 3.9's `principled`. As
CONVENTIONS.md says, directions are in the local frame, where z is up, `wi` points towards the viewer, and `wo` towards
the light. Values are f cos(theta_o).

Deliberate differences from Mitsuba's plugin, all of them small:
- Values in narrow peaks have smaller rounding errors. GGX and GTR1 are computed from the components of the half vector,
  never from 1 + (alpha^2 - 1) cos^2. In single precision, Mitsuba's clearcoat of alpha .001 is wrong by several per
  cent.
- `specular` may vary over the surface, and `specular` = 0 removes only the dielectric reflection. In Mitsuba,
  `specular` = 0 also removes the reflection of metals.
- The cosine between a direction and the half vector is computed as |wi + wo| / 2, the same for both directions. Mitsuba
  computes the dot product of `wi` and the half vector, whose rounding error is large where both directions are grazing
  and nearly opposite.
- Tints divide by max(luminance, 1e-6). For colours darker than 1e-6 the tints fade to black. In Mitsuba, the tint of
  black is white.
- An instance may fade out towards grazing half vectors (`fade`), where measurements end. Mitsuba's BRDF has no fade.
- Directions below the horizon are invalid, because the BRDF has no back side. Directions whose cosine is at most 1e-9
  are invalid, too.
- Lobes are sampled in proportion to a bound of their albedo, with one density for the whole blend (`nma.target.blend`).

The functions of this module use only straight-line arithmetic and `select`, so that `nma.export` can print them as C++.
"""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Color, Float, Mask, Vec3

DIALECT = "mitsuba-principled-reflection"
MIN_ALPHA = 0.001  # the smallest microfacet width, as in Mitsuba
MIN_COS = 1e-9  # directions with cosines up to this value are invalid
CLEARCOAT_MASKING_ALPHA = 0.25  # Burley 2012, section 5.6
CLEARCOAT_F0 = 0.04


class Principled(NamedTuple):
    """Parameters of one Principled BRDF.

    The first nine fields hold the paper's 11 numbers, each in [0, 1] (`specular` up to 1.6). `anisotropic` stretches
    the specular lobe along x, and `flatness` blends towards the fake subsurface of Burley 2015. The whole BRDF fades
    out where the half vector's cosine to the normal is less than about `fade`. The fade is a smooth step of the width
    `fade_width`. With the default values of `fade` and `fade_width`, the BRDF does not fade. `veil` and `shift` have a
    meaning only under an interface, where other fields have none (`nma.target.interface`).
    """

    base_color: Color
    roughness: Float
    metallic: Float
    specular: Float
    spec_tint: Float
    sheen: Float
    sheen_tint: Float
    clearcoat: Float
    clearcoat_gloss: Float
    anisotropic: Float = 0.0
    flatness: Float = 0.0
    fade: Float = 0.0
    fade_width: Float = 0.0
    veil: Float = 0.0
    shift: Float = 0.0


class Geometry(NamedTuple):
    """Quantities of one pair of directions that all lobes of all instances use."""

    valid: Mask  # whether both directions are above the horizon
    wi: Vec3
    wo: Vec3
    h: Vec3  # half vector
    cos_d: Float  # cosine between either direction and the half vector
    weight_i: Float  # Schlick weights of wi.z, wo.z and cos_d
    weight_o: Float
    weight_d: Float
    clearcoat: Float  # value of the clearcoat without the factors for strength and normal distribution


class Terms(NamedTuple):
    """The colour `base_color * colored + white`."""

    colored: Float
    white: Float


class Lobes(NamedTuple):
    """The value of an instance [1/sr], and the density with which each lobe of the instance samples `wo` [1/sr]."""

    value: Color
    diffuse_pdf: Float
    spec_pdf: Float
    clearcoat_pdf: Float


def schlick_weight(cos: Float) -> Float:
    """(1 - cos)^5. Schlick 1994, eq. 15."""
    m = ops.clip(1.0 - cos, 0.0, 1.0)
    m2 = m * m
    return m2 * m2 * m


def masking_denominator(v: Vec3, alpha_x: Float, alpha_y: Float) -> Float:
    """2 cos / G1(v) for v.z >= 0: Smith masking without a division by the cosine. Heitz 2014, eq. 72 and 86."""
    sx = alpha_x * v.x
    sy = alpha_y * v.y
    return v.z + ops.sqrt(v.z * v.z + sx * sx + sy * sy)


def geometry(wi: Vec3, wo: Vec3) -> Geometry:
    """The half vector, the Schlick weights and the part of the clearcoat that all instances share, for unit directions
    `wi` and `wo`."""
    valid = (wi.z > MIN_COS) & (wo.z > MIN_COS)
    # In invalid pairs both cosines are set to 1, so that values and derivatives are always finite.
    i = Vec3(wi.x, wi.y, ops.select(valid, wi.z, 1.0))
    o = Vec3(wo.x, wo.y, ops.select(valid, wo.z, 1.0))
    h = i + o
    length = ops.sqrt(ops.dot(h, h))
    cos_d = 0.5 * length
    weight_d = schlick_weight(cos_d)
    fresnel = ops.lerp(CLEARCOAT_F0, 1.0, weight_d)
    masking_i = 2.0 * i.z / masking_denominator(i, CLEARCOAT_MASKING_ALPHA, CLEARCOAT_MASKING_ALPHA)
    masking_o = 2.0 * o.z / masking_denominator(o, CLEARCOAT_MASKING_ALPHA, CLEARCOAT_MASKING_ALPHA)
    clearcoat = 0.25 * fresnel * masking_i * masking_o * o.z
    m = h * (1.0 / length)
    return Geometry(valid, i, o, m, cos_d, schlick_weight(i.z), schlick_weight(o.z), weight_d, clearcoat)


def spec_alpha(roughness: Float, anisotropic: Float) -> tuple[Float, Float]:
    """Microfacet widths of the specular lobe along x and y. Burley 2012, section 5.4."""
    alpha = roughness * roughness
    aspect = ops.sqrt(1.0 - 0.9 * anisotropic)
    return ops.maximum(alpha / aspect, MIN_ALPHA), ops.maximum(alpha * aspect, MIN_ALPHA)


def clearcoat_alpha(clearcoat_gloss: Float) -> Float:
    """Width of the clearcoat's GTR1 lobe, .1 to .001. Burley 2012, section 5.4."""
    return ops.lerp(0.1, 0.001, clearcoat_gloss)


def specular_f0(specular: Float) -> Float:
    """Dielectric reflectance at normal incidence. Burley 2012, section 5.5."""
    return 0.08 * specular


def specular_eta(specular: Float) -> Float:
    """The index of refraction whose reflectance at normal incidence is `specular_f0`."""
    return 2.0 / (1.0 - ops.safe_sqrt(specular_f0(specular))) - 1.0


def dielectric_reflectance(cos: Float, cos2: Float, eta: Float) -> Float:
    """Unpolarised Fresnel reflectance, seen from the side of lower index, for eta >= 1 and cos >= 0. Walter 2007, eq.
    22."""
    eta2 = eta * eta
    g = ops.sqrt(ops.maximum(eta2 - 1.0 + cos2, 1e-12))
    r_s = (cos - g) / (cos + g)
    r_p = (eta2 * cos - g) / (eta2 * cos + g)
    return 0.5 * (r_s * r_s + r_p * r_p)


def luminance_inverse(base_color: Color) -> Float:
    """The factor that scales a colour to luminance 1, so that only its tint remains. Burley 2012, section 5.3."""
    return 1.0 / ops.maximum(ops.luminance(base_color), 1e-6)


def microfacet_lobe(wi: Vec3, wo: Vec3, alpha_x: Float, alpha_y: Float) -> tuple[Float, Float]:
    """A GGX reflection without its Fresnel term: its value, times cos(theta_o), and the density with which its visible
    normals reflect light to `wo`, both [1/sr]."""
    # `ggx_d` of the half vector. The half vector is not normalised, which would take a square root and a division.
    h = wi + wo
    per_area = 1.0 / (alpha_x * alpha_y)
    sx = h.x * alpha_y * per_area
    sy = h.y * alpha_x * per_area
    ratio = ops.dot(h, h) / (sx * sx + sy * sy + h.z * h.z)
    d = ops.INV_PI * per_area * ratio * ratio
    # The density is D G1(wi) / (4 cos_i). Heitz 2018, eq. 17. The value is the density times the masking of `wo`.
    # Walter 2007, eq. 20.
    masked_i = masking_denominator(wi, alpha_x, alpha_y)
    masked_o = masking_denominator(wo, alpha_x, alpha_y)
    value = d * (1.0 / (masked_i * masked_o))
    return value * wo.z, 0.5 * value * masked_o


def gtr1_d(m: Vec3, alpha: Float) -> Float:
    """GTR1 distribution of normals [1/sr], with 1 + (alpha^2 - 1) cos^2 written as sin^2 + alpha^2 cos^2.

    Burley 2012, appendix B.
    """
    alpha2 = alpha * alpha
    e = m.x * m.x + m.y * m.y + alpha2 * m.z * m.z
    return (1.0 - alpha2) / (-ops.PI * ops.log(alpha2) * e)


def diffuse_terms(p: Principled, g: Geometry) -> Terms:
    """Diffuse reflection, retro-reflection, fake subsurface and sheen. Burley 2012, section 5.3; 2015, section 3."""
    retro = 2.0 * p.roughness * g.cos_d * g.cos_d
    lambert = (1.0 - 0.5 * g.weight_i) * (1.0 - 0.5 * g.weight_o)
    rough = lambert + retro * (g.weight_o + g.weight_i + g.weight_o * g.weight_i * (retro - 1.0))
    flat_90 = 0.5 * retro - 1.0
    flat_f = (1.0 + flat_90 * g.weight_o) * (1.0 + flat_90 * g.weight_i)
    flat = 1.25 * (flat_f * (1.0 / (g.wi.z + g.wo.z) - 0.5) + 0.5)
    # Metals have neither a diffuse base nor a sheen.
    nonmetal = (1.0 - p.metallic) * g.wo.z
    sheen = nonmetal * p.sheen * g.weight_d
    tinted = sheen * p.sheen_tint
    colored = nonmetal * ops.INV_PI * ops.lerp(rough, flat, p.flatness)
    return Terms(colored + tinted * luminance_inverse(p.base_color), sheen - tinted)


def spec_fresnel(p: Principled, cos: Float, cos2: Float, weight: Float) -> Terms:
    """The sum of the Fresnel reflectances of metal, tinted dielectric and plain dielectric, each multiplied by the
    weight of its material.

    `cos2` is cos^2, which some callers have already computed, and `weight` is `schlick_weight(cos)`.
    """
    tinted = (1.0 - p.metallic) * p.spec_tint
    plain = (1.0 - p.metallic) - tinted
    # The metal and the tinted dielectric use Schlick's F0 + (1 - F0) weight. The variable f0 is the sum of F0 of the
    # metal times `metallic` and F0 of the tinted dielectric times `tinted`.
    f0 = p.metallic + tinted * specular_f0(p.specular) * luminance_inverse(p.base_color)
    white = (
        plain * dielectric_reflectance(cos, cos2, specular_eta(p.specular)) + (p.metallic + tinted) * weight
    )
    return Terms(f0 * (1.0 - weight), white)


def faded(p: Principled, cos_h: Float) -> Float:
    """The factor of the fade, where `cos_h` is the half vector's cosine to the normal: a smooth step that is 1/2 at
    `fade`."""
    t = ops.clip((cos_h - p.fade) / ops.maximum(p.fade_width, 1e-6) + 0.5, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def eval_pdf_lobes(p: Principled, g: Geometry) -> Lobes:
    """The value of one instance, f cos(theta_o) [1/sr], and the density with which each lobe samples `wo` [1/sr]."""
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    spec, spec_pdf = microfacet_lobe(g.wi, g.wo, alpha_x, alpha_y)
    # Density of directions reflected about normals drawn from D cos(theta_h): D cos(theta_h) / (4 cos_d).
    clearcoat_d = gtr1_d(g.h, clearcoat_alpha(p.clearcoat_gloss))
    clearcoat_pdf = clearcoat_d * g.h.z / (4.0 * g.cos_d)
    clearcoat = p.clearcoat * clearcoat_d * g.clearcoat
    # Every lobe has the form base_color * colored + white.
    diffuse = diffuse_terms(p, g)
    fresnel = spec_fresnel(p, g.cos_d, g.cos_d * g.cos_d, g.weight_d)
    left = faded(p, g.h.z)
    colored = left * (diffuse.colored + spec * fresnel.colored)
    white = left * (diffuse.white + spec * fresnel.white + clearcoat)
    return Lobes(p.base_color * colored + white, g.wo.z * ops.INV_PI, spec_pdf, clearcoat_pdf)


def eval_principled(p: Principled, wi: Vec3, wo: Vec3) -> Color:
    """f cos(theta_o) [1/sr] of one instance, zero below the horizon. `wi` and `wo` are unit vectors."""
    g = geometry(wi, wo)
    return ops.select(g.valid, eval_pdf_lobes(p, g).value, 0.0)
