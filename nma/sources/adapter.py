"""An adapter as a source: what it makes of one material."""

from __future__ import annotations

from collections.abc import Sequence

from nma import target
from nma.adapter import Adapter
from nma.ops import Color, Float, Vec3
from nma.target import Plane


class AdapterValues:
    """One material of an adapter (`Values`), of parameters `params`; an adapter of a single material has none."""

    def __init__(self, adapter: Adapter, params: Sequence[Float] = (), name: str = "adapter"):
        self.adapter, self.name = adapter, name
        self.params = adapter.space.check([params] if len(params) else [[]])[0].tolist()
        self.isotropic = not adapter.anisotropic

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr]."""
        blend = self.adapter.prepare([wi.z * 0.0 + p for p in self.params], wi.z, True, (wi.x, wi.y))
        plane = Plane.of(wi) if self.adapter.in_plane else Plane()
        return target.eval(blend, plane.enter(wi), plane.enter(wo))
