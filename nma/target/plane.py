"""The frame of the plane of incidence, in which stretched lobes of isotropic materials are evaluated and sampled."""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Float, Vec3


class Plane(NamedTuple):
    """A rotation about the normal, given by the cosine and sine of the azimuth that the rotation maps to 0."""

    cos_phi: Float
    sin_phi: Float

    @staticmethod
    def of(wi: Vec3) -> Plane:
        """The plane through the normal and the unit direction `wi`; at normal incidence, the plane of the x axis."""
        sin2 = wi.x * wi.x + wi.y * wi.y
        tilted = sin2 > 1e-12
        inverse = 1.0 / ops.sqrt(ops.select(tilted, sin2, 1.0))
        return Plane(ops.select(tilted, wi.x * inverse, 1.0), ops.select(tilted, wi.y * inverse, 0.0))

    def enter(self, v: Vec3) -> Vec3:
        """Rotates `v` from the local frame to the frame of the plane, where `wi` has the azimuth 0."""
        return Vec3(self.cos_phi * v.x + self.sin_phi * v.y, self.cos_phi * v.y - self.sin_phi * v.x, v.z)

    def leave(self, v: Vec3) -> Vec3:
        """Rotates `v` from the frame of the plane to the local frame: the inverse of `enter`."""
        return Vec3(self.cos_phi * v.x - self.sin_phi * v.y, self.sin_phi * v.x + self.cos_phi * v.y, v.z)
