"""Rusinkiewicz coordinates: the half vector, and the light direction in the half vector's frame (difference vector).

The coordinates are those of Rusinkiewicz 1998, "A New Change of Variables for Efficient BRDF Representation". The
difference vector is built from the *light* direction. A difference vector built from the view direction would have the
azimuth phi_d + pi instead of phi_d. All functions in this module are for isotropic materials, so they rotate the half
vector to azimuth 0.
"""

from __future__ import annotations

from nma import ops
from nma.ops import Float, Vec3


def half_difference(light: Vec3, view: Vec3) -> tuple[Vec3, Vec3]:
    """Returns (half vector rotated to azimuth 0, difference vector), both of unit length.

    `light` and `view` are unit directions above the surface. For a direction below the surface the result is finite,
    but has no meaning.
    """
    h = light + view
    h = h * (1.0 / ops.maximum(ops.sqrt(ops.dot(h, h)), 1e-12))
    sin_h = ops.safe_sqrt(h.x * h.x + h.y * h.y)
    # A half vector along the normal has no azimuth, so 0 is taken as its azimuth.
    tilted = sin_h > 1e-12
    inv = 1.0 / ops.select(tilted, sin_h, 1.0)
    cos_phi, sin_phi = ops.select(tilted, h.x * inv, 1.0), ops.select(tilted, h.y * inv, 0.0)
    # Rotate the light direction by -phi_h about the normal, then by -theta_h about y.
    x, y = cos_phi * light.x + sin_phi * light.y, cos_phi * light.y - sin_phi * light.x
    difference = Vec3(h.z * x - sin_h * light.z, y, sin_h * x + h.z * light.z)
    return Vec3(sin_h, 0.0 * sin_h, h.z), difference


def angles(light: Vec3, view: Vec3) -> tuple[Float, Float, Float]:
    """The angles (theta_h, theta_d, phi_d) [rad], in the ranges 0 .. pi/2, 0 .. pi/2 and -pi .. pi."""
    h, d = half_difference(light, view)
    sin_d = ops.safe_sqrt(d.x * d.x + d.y * d.y)
    return ops.atan2(h.x, h.z), ops.atan2(sin_d, d.z), ops.atan2(d.y, d.x)


def directions(theta_h: Float, theta_d: Float, phi_d: Float) -> tuple[Vec3, Vec3]:
    """The directions (light, view) of given angles [rad] whose half vector is at azimuth 0.

    Either direction may lie below the surface.
    """
    sin_h, cos_h = ops.sin(theta_h), ops.cos(theta_h)
    sin_d, z = ops.sin(theta_d), ops.cos(theta_d)
    x, y = sin_d * ops.cos(phi_d), sin_d * ops.sin(phi_d)
    light = Vec3(cos_h * x + sin_h * z, y, cos_h * z - sin_h * x)
    view = Vec3(sin_h * z - cos_h * x, -y, cos_h * z + sin_h * x)
    return light, view
