"""Mitsuba 3 BSDF `values`: renders a source whose BRDF values are known, such as a measurement, without an adapter.

The property `file` names any file that `nma.sources.read` reads, and the property `material` chooses a material of a
file with several materials. Instead of `file`, the property `source` may be the index of a source in memory; `bsdf_of`
sets this property. The BSDF may be anisotropic, is one-sided, and is the same everywhere on a surface.

For all materials, directions are drawn from the same mixture of a cosine lobe and three microfacet lobes. This sampling
is unbiased but noisy, so the BSDF suits reference pictures with many samples.
"""

from __future__ import annotations

import math
from typing import Any

from nma import sources, target
from nma.ops import Color, select
from nma.render.bsdf import define_base, mean_of_samples, over, vec3
from nma.render.paths import scene_path
from nma.sources.base import Values
from nma.target import Blend, Principled

# The number of quadrature points for the albedo.
ALBEDO_POINTS = 256
# The widths alpha of the microfacet lobes from which directions are drawn.
_ALPHAS = (0.02, 0.08, 0.3)
_WHITE = Color(1.0, 1.0, 1.0)


def _lobe(alpha: float, metallic: float) -> Principled:
    return Principled(_WHITE, math.sqrt(alpha), metallic, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5)


_PROPOSAL = Blend(
    (_lobe(1.0, 0.0), *(_lobe(alpha, 1.0) for alpha in _ALPHAS)),
    (1.0 / (len(_ALPHAS) + 1),) * (len(_ALPHAS) + 1),
)

# Sources to which scenes refer by index, because a scene's dictionary cannot hold Python objects.
_IN_MEMORY: list[Values] = []


def bsdf_of(source: Values) -> dict[str, Any]:
    """The Mitsuba dictionary of a source in memory. The source stays in memory until the program ends."""
    if source not in _IN_MEMORY:
        _IN_MEMORY.append(source)
    return {"type": "values", "source": _IN_MEMORY.index(source)}


def define() -> type:
    """The plugin's class for Mitsuba's current variant."""
    import mitsuba

    mi: Any = mitsuba  # Mitsuba's types change with the variant

    class ValuesBsdf(define_base()):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            self.values = _IN_MEMORY[int(props["source"])] if "source" in props else self._read(props)
            super().__init__(props)
            self._declare(*([] if self.values.isotropic else [mi.BSDFFlags.Anisotropic]))

        @staticmethod
        def _read(props: mi.Properties) -> Values:
            path = scene_path(str(props["file"]))
            return sources.read(path, str(props["material"]) if "material" in props else None)

        def to_string(self) -> str:
            return f"Values[\n  source = {self.values.name}\n]"

        def eval_pdf(self, ctx, si, wo, active=True):
            value, pdf = self._eval_pdf(vec3(si.wi), vec3(wo), self._front(ctx, si, active))
            return mi.Color3f(*value), pdf

        def sample(self, ctx, si, sample1, sample2, active=True):
            front = self._front(ctx, si, active)
            wo, pdf, weight = self._draw(vec3(si.wi), (sample1, sample2.x, sample2.y), front)
            return self._sampled(wo, pdf, weight, front)

        def _albedo(self, si, active) -> Color:
            return mean_of_samples(lambda k, *u: self._draw(vec3(si.wi), u, active)[2], ALBEDO_POINTS, active)

        def _draw(self, wi, u, active):
            """A direction, its density, and the BRDF value divided by the density."""
            wo, _, _ = target.sample(_PROPOSAL, wi, *u)
            value, pdf = self._eval_pdf(wi, wo, active)
            return wo, pdf, over(value, pdf)

        def _eval_pdf(self, wi, wo, active):
            pdf = select(active, target.pdf(_PROPOSAL, wi, wo), 0.0)
            return select(pdf > 0, self.values.eval(wi, wo), Color.of(0.0)), pdf

    return ValuesBsdf
