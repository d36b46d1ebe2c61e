"""How the lobes of one Principled BRDF are chosen and sampled; the densities stand with the values in `principled`."""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.microfacet import reflect, sample_visible_normal
from nma.ops import Float, Vec3
from nma.target.principled import (
    CLEARCOAT_F0,
    CLEARCOAT_MASKING_ALPHA,
    Principled,
    luminance_inverse,
    masking_denominator,
    schlick_weight,
    spec_alpha,
    spec_fresnel,
)

# Keeps the densities of the broad and the coloured lobe positive where their estimated albedo is zero.
MIN_ALBEDO = 1e-4


class Albedos(NamedTuple):
    """What each lobe of an instance reflects of light from everywhere, roughly: the odds of choosing it."""

    diffuse: Float
    spec: Float
    clearcoat: Float


def diffuse_albedo(p: Principled, cos: Float, weight: Float) -> Float:
    """Mean over RGB of the diffuse lobe's albedo at cos(theta_i), sheen included; fitted, flatness ignored."""
    base = 0.98 - 0.49 * weight + p.roughness * (0.05 + weight)
    sheen = 0.08 * p.sheen * (1.0 - cos) * (1.0 - cos)
    tint = ops.lerp(1.0, luminance_inverse(p.base_color) * ops.mean(p.base_color), p.sheen_tint)
    return (1.0 - p.metallic) * (ops.mean(p.base_color) * base + sheen * tint)


def spec_albedo(p: Principled, cos: Float) -> Float:
    """Mean over RGB of the specular lobe's albedo at cos(theta_i), single scattering; fitted to quadrature.

    Rough surfaces at grazing angles show facets that are tilted towards the viewer: Fresnel takes a larger cosine.
    """
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    alpha = ops.sqrt(alpha_x * alpha_y)
    tilt = 0.62 * alpha / (alpha + 0.25)
    facet = ops.minimum(ops.sqrt(cos * cos + tilt * tilt), 1.0)
    fresnel = spec_fresnel(p, facet, schlick_weight(facet))
    unmasked = 1.0 - alpha * (0.3 + 0.35 * cos)
    return unmasked * (ops.mean(p.base_color) * fresnel.colored + fresnel.white)


def clearcoat_albedo(p: Principled, wi: Vec3, weight: Float) -> Float:
    """Albedo of the clearcoat as if it were a mirror; it fades at grazing for lack of 1 / (4 cos_i cos_o)."""
    masking = 2.0 * wi.z / masking_denominator(wi, CLEARCOAT_MASKING_ALPHA, CLEARCOAT_MASKING_ALPHA)
    fresnel = CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * weight
    return p.clearcoat * fresnel * wi.z * wi.z * masking * masking


def lobe_albedos(p: Principled, wi: Vec3) -> Albedos:
    """Estimated albedo of each lobe for the unit direction `wi` above the horizon."""
    weight = schlick_weight(wi.z)
    return Albedos(
        diffuse_albedo(p, wi.z, weight) + MIN_ALBEDO,
        spec_albedo(p, wi.z) + MIN_ALBEDO,
        clearcoat_albedo(p, wi, weight),
    )


def sample_diffuse(u1: Float, u2: Float) -> Vec3:
    """A direction with density cos(theta) / pi."""
    phi = (2.0 * ops.PI) * u1
    r = ops.safe_sqrt(u2)
    return Vec3(r * ops.cos(phi), r * ops.sin(phi), ops.safe_sqrt(1.0 - u2))


def sample_spec(wi: Vec3, alpha_x: Float, alpha_y: Float, u1: Float, u2: Float) -> Vec3:
    """A reflection of `wi` about a visible GGX normal; it may point below the horizon."""
    return reflect(wi, sample_visible_normal(wi, alpha_x, alpha_y, u1, u2))


def sample_clearcoat(wi: Vec3, alpha: Float, u1: Float, u2: Float) -> Vec3:
    """A reflection of `wi` about a normal drawn from GTR1 times its cosine. Burley 2012, appendix B, by its sine."""
    alpha2 = alpha * alpha
    phi = (2.0 * ops.PI) * u1
    sin2 = (ops.exp(ops.log(alpha2) * (1.0 - u2)) - alpha2) / (1.0 - alpha2)
    sin_theta = ops.safe_sqrt(sin2)
    return reflect(wi, Vec3(sin_theta * ops.cos(phi), sin_theta * ops.sin(phi), ops.safe_sqrt(1.0 - sin2)))
