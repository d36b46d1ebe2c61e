"""Samples the lobes of one Principled BRDF. The densities are in `nma.target.principled`."""

from __future__ import annotations

from nma import ops
from nma.microfacet import reflect, sample_visible_normal
from nma.ops import Float, Vec3


def sample_diffuse(u1: Float, u2: Float) -> Vec3:
    """A direction with density cos(theta) / pi."""
    phi = (2.0 * ops.PI) * u1
    r = ops.safe_sqrt(u2)
    return Vec3(r * ops.cos(phi), r * ops.sin(phi), ops.safe_sqrt(1.0 - u2))


def sample_spec(wi: Vec3, alpha_x: Float, alpha_y: Float, u1: Float, u2: Float) -> Vec3:
    """The reflection of `wi` about a random visible GGX normal, which may point below the horizon."""
    return reflect(wi, sample_visible_normal(wi, alpha_x, alpha_y, u1, u2))


def sample_clearcoat(wi: Vec3, alpha: Float, u1: Float, u2: Float) -> Vec3:
    """The reflection of `wi` about a random normal h, whose density is GTR1 times h.z. Burley 2012, appendix B."""
    alpha2 = alpha * alpha
    phi = (2.0 * ops.PI) * u1
    sin2 = (ops.exp(ops.log(alpha2) * (1.0 - u2)) - alpha2) / (1.0 - alpha2)
    sin_theta = ops.safe_sqrt(sin2)
    return reflect(wi, Vec3(sin_theta * ops.cos(phi), sin_theta * ops.sin(phi), ops.safe_sqrt(1.0 - sin2)))
