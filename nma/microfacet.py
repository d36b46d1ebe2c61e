"""Evaluates GGX microfacets and Fresnel reflectance, for the sources and for the target (CONVENTIONS.md).

Directions are unit vectors (`Vec3`) in the local frame, with z up, and point away from the surface. `alpha` is the
microfacet width. Anisotropic functions have two widths as arguments, along x and along y. No function branches on
values, so all of them run on Dr.Jit, JAX and NumPy.
"""

from __future__ import annotations

from nma import ops
from nma.ops import Color, Float, Vec3


def ggx_d(m: Vec3, alpha_x: Float, alpha_y: Float) -> Float:
    """GGX distribution D(m) [1/sr]: the area of microfacets with normal `m` per solid angle and unit of surface area.

    Heitz 2014, eq. 84. The formula uses m.x / alpha_x and m.y / alpha_y, because 1 - cos^2 would lose all digits in
    single precision near the peak of a narrow lobe.
    """
    sx = m.x / alpha_x
    sy = m.y / alpha_y
    e = sx * sx + sy * sy + m.z * m.z
    return 1.0 / (ops.PI * alpha_x * alpha_y * e * e)


def smith_g1(v: Vec3, alpha_x: Float, alpha_y: Float) -> Float:
    """Smith masking G1: the visible fraction of the microfacets that face `v`. Heitz 2014, eq. 72 and 86.

    `v` may lie on either side of the surface.
    """
    sx = alpha_x * v.x
    sy = alpha_y * v.y
    z2 = v.z * v.z
    return 2.0 * ops.absolute(v.z) / (ops.absolute(v.z) + ops.sqrt(z2 + sx * sx + sy * sy))


def visible_normal_pdf(wi: Vec3, m: Vec3, alpha_x: Float, alpha_y: Float) -> Float:
    """Density [1/sr] of the normals `m` that are visible from `wi` (wi.z > 0). Heitz 2018, eq. 1."""
    visible = ops.maximum(ops.dot(wi, m), 0.0)
    return smith_g1(wi, alpha_x, alpha_y) * ggx_d(m, alpha_x, alpha_y) * visible / wi.z


def sample_visible_normal(wi: Vec3, alpha_x: Float, alpha_y: Float, u1: Float, u2: Float) -> Vec3:
    """Draws a normal with the density `visible_normal_pdf`, for wi.z > 0. Dupuy and Benyoub 2023, listing 1."""
    wi_std = ops.normalize(Vec3(alpha_x * wi.x, alpha_y * wi.y, wi.z))
    # Draw a uniform point on the spherical cap z >= -wi_std.z, which contains the reflections of wi_std about all
    # visible normals of the unit hemisphere.
    phi = (2.0 * ops.PI) * u1
    z = 1.0 - u2 * (1.0 + wi_std.z)
    sin_theta = ops.safe_sqrt(1.0 - z * z)
    # The half vector of the drawn point and wi_std is the visible normal. Scale this normal back to the widths alpha.
    m_std = Vec3(sin_theta * ops.cos(phi), sin_theta * ops.sin(phi), z) + wi_std
    return ops.normalize(Vec3(alpha_x * m_std.x, alpha_y * m_std.y, ops.maximum(m_std.z, 1e-9)))


def reflect(w: Vec3, m: Vec3) -> Vec3:
    """The mirror image of `w` about the normal `m`."""
    return m * (2.0 * ops.dot(w, m)) - w


def refract(w: Vec3, m: Vec3, cos_t: Float, eta: Float) -> Vec3:
    """The direction `w` refracted at a facet with normal `m` (w.m > 0). Walter 2007, eq. 40.

    `eta` is the index of refraction beyond the facet divided by the index on `w`'s side. `cos_t` is the cosine of the
    refracted direction, from `fresnel_dielectric`.
    """
    return m * (ops.dot(w, m) / eta - cos_t) - w * (1.0 / eta)


def fresnel_dielectric(cos_i: Float, eta: Float) -> tuple[Float, Float]:
    """Unpolarised reflectance and cosine of the refracted direction for cos_i >= 0; (1, 0) at total internal
    reflection.

    `eta` is the index of refraction beyond the surface divided by the index on the incident side. The formula is that
    of Walter 2007, section 5.2, written for s and p polarisation separately.
    """
    cos2_t = 1.0 - (1.0 - cos_i * cos_i) / (eta * eta)
    cos_t = ops.safe_sqrt(cos2_t)
    r_s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    r_p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return ops.select(cos2_t > 0, 0.5 * (r_s * r_s + r_p * r_p), 1.0), cos_t


def fresnel_conductor(cos_i: Float, eta: Float, k: Float) -> Float:
    """Unpolarised reflectance of a conductor with relative index eta + i k, in one channel, for cos_i >= 0.

    The formula is that of Born and Wolf 1999, section 14.2, without complex numbers.
    """
    cos2 = cos_i * cos_i
    sin2 = 1.0 - cos2
    t0 = eta * eta - k * k - sin2
    a2b2 = ops.sqrt(t0 * t0 + 4.0 * eta * eta * k * k)
    a = ops.safe_sqrt(0.5 * (a2b2 + t0))
    t1 = a2b2 + cos2
    t2 = 2.0 * cos_i * a
    r_s = (t1 - t2) / (t1 + t2)
    t3 = cos2 * a2b2 + sin2 * sin2 + 1e-30  # avoids 0 / 0 for the index 0 + 0i, which reflects all light
    t4 = t2 * sin2
    r_p = r_s * ((t3 - t4) / (t3 + t4))
    return 0.5 * (r_s + r_p)


def fresnel_conductor_rgb(cos_i: Float, eta: Color, k: Color) -> Color:
    """`fresnel_conductor` of each colour channel."""
    return Color(*(fresnel_conductor(cos_i, e, kk) for e, kk in zip(eta, k, strict=True)))
