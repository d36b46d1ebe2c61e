"""An adapter as a source: what it makes of one material."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from nma import target
from nma.adapter.adapter import Adapter
from nma.errors import ParamError
from nma.ops import Color, Vec3
from nma.target import Plane


class AdapterValues:
    """One material of an adapter (`Values`), of parameters `params`, which one of a single material need not be told.

    Raises `ParamError` for parameters that the adapter does not know.
    """

    def __init__(self, adapter: Adapter, params: ArrayLike = (), name: str = "adapter"):
        self.adapter, self.name = adapter, name
        given = np.asarray(params, np.float64)
        if not given.size and adapter.space.size:
            if adapter.material is None:
                raise ParamError(
                    f"{name}: an adapter of the whole class {adapter.space.name}; name a material, too"
                )
            given = adapter.material
        self.params = adapter.check(given[None])[0].tolist()
        self.isotropic = not adapter.anisotropic

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr]."""
        blend = self.adapter.prepare([wi.z * 0.0 + p for p in self.params], wi.z, True, (wi.x, wi.y))
        plane = Plane.of(wi) if self.adapter.in_plane else Plane()
        return target.eval(blend, plane.enter(wi), plane.enter(wo))
