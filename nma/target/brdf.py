"""The analytic BRDF that `Adapter.prepare` returns for a view direction: a blend and its frame."""

from __future__ import annotations

from typing import NamedTuple

from nma.ops import Color, Float, Vec3
from nma.target import blend
from nma.target.blend import Blend
from nma.target.plane import Plane


class Brdf(NamedTuple):
    """A blend and its frame, prepared once for a view direction `wi` per lane, then evaluated and sampled.

    `plane` is the plane of incidence if lobes stretch along this plane. For other blends, `plane` is None, and the
    blend's frame is the local frame. Directions are unit vectors of the local frame. The methods need the `wi` for
    which the BRDF was prepared. A Python `Brdf` keeps the plane of this `wi`, but a C++ `Brdf` computes the plane from
    the `wi` of each call.
    """

    blend: Blend
    plane: Plane | None = None

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr], zero below the horizon."""
        return blend.eval(self.blend, self._enter(wi), self._enter(wo))

    def pdf(self, wi: Vec3, wo: Vec3) -> Float:
        """The density of `sample` per solid angle of `wo` [1/sr]."""
        return blend.pdf(self.blend, self._enter(wi), self._enter(wo))

    def eval_pdf(self, wi: Vec3, wo: Vec3) -> tuple[Color, Float]:
        """The results of `eval` and `pdf`, computed together in the time of one call."""
        return blend.eval_pdf(self.blend, self._enter(wi), self._enter(wo))

    def sample(self, wi: Vec3, u_lobe: Float, u1: Float, u2: Float) -> tuple[Vec3, Color, Float]:
        """Returns a direction `wo` drawn with three uniform numbers in [0, 1), its value, and its density (0 if `wo` is
        invalid)."""
        wo, value, pdf = blend.sample(self.blend, self._enter(wi), u_lobe, u1, u2)
        return (wo if self.plane is None else self.plane.leave(wo)), value, pdf

    def _enter(self, v: Vec3) -> Vec3:
        return v if self.plane is None else self.plane.enter(v)
