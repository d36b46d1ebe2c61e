"""One material of an adapter as a source, so that the material can be compared and tabulated like a measured
material."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from nma.adapter.adapter import Adapter
from nma.errors import ParamError
from nma.ops import Color, Vec3


class AdapterValues:
    """One material of an adapter, as a source of BRDF values (the protocol `Values`).

    `params` are the parameters of the material; an adapter of a single material does not need them. Raises `ParamError`
    for parameters for which the adapter was not trained.
    """

    def __init__(self, adapter: Adapter, params: ArrayLike = (), name: str = "adapter"):
        self.adapter, self.name = adapter, name
        given = np.asarray(params, np.float64)
        if not given.size and adapter.space.size:
            if adapter.material is None:
                raise ParamError(
                    f"{name} is an adapter of the whole class {adapter.space.name}; name a material"
                )
            given = adapter.material
        self.params = adapter.check(given[None])[0].tolist()
        self.isotropic = not adapter.anisotropic

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """The value f cos(theta_o) [1/sr] of the material's BRDF."""
        return self.adapter.prepare([wi.z * 0.0 + p for p in self.params], wi).eval(wi, wo)
