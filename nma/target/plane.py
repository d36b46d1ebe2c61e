"""The plane of incidence as a frame: isotropic materials with stretched lobes are evaluated and sampled in it."""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Float, Vec3


class Plane(NamedTuple):
    """A turn about the normal, given by cosine and sine of the azimuth that becomes 0."""

    cos_phi: Float
    sin_phi: Float

    @staticmethod
    def of(wi: Vec3) -> Plane:
        """The plane through the normal and the unit direction `wi`; at normal incidence that of the x axis."""
        sin2 = wi.x * wi.x + wi.y * wi.y
        tilted = sin2 > 1e-12
        inverse = 1.0 / ops.sqrt(ops.select(tilted, sin2, 1.0))
        return Plane(ops.select(tilted, wi.x * inverse, 1.0), ops.select(tilted, wi.y * inverse, 0.0))

    def enter(self, v: Vec3) -> Vec3:
        """`v` as seen from the plane: `wi` itself gets the azimuth 0."""
        return Vec3(self.cos_phi * v.x + self.sin_phi * v.y, self.cos_phi * v.y - self.sin_phi * v.x, v.z)

    def leave(self, v: Vec3) -> Vec3:
        """Inverse of `enter`."""
        return Vec3(self.cos_phi * v.x - self.sin_phi * v.y, self.sin_phi * v.x + self.cos_phi * v.y, v.z)
