"""Mitsuba 3 BSDF `values`: a source that knows its value, such as a measurement, as it is, without an adapter.

Properties: `file`, anything that `nma.sources.read` understands, and `material`, which chooses in a file of several; or
`source`, the number of one in memory, which `bsdf_of` gives out.
Isotropic or not, one-sided, the same everywhere on a surface. Directions are drawn from a fixed mixture of lobes, a
cosine and three reflections, whatever the material: unbiased, but a reference for converged pictures, not a fast one.
"""

from __future__ import annotations

import math
from typing import Any

from nma import sources, target
from nma.ops import Color, Vec3
from nma.render.layered import check_variant
from nma.sources.base import Values
from nma.target import Blend, Principled

# Widths of the reflections that directions are drawn from, beside the cosine.
_ALPHAS = (0.02, 0.08, 0.3)
_WHITE = Color(1.0, 1.0, 1.0)


def _lobe(alpha: float, metallic: float) -> Principled:
    return Principled(_WHITE, math.sqrt(alpha), metallic, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5)


_PROPOSAL = Blend(
    (_lobe(1.0, 0.0), *(_lobe(alpha, 1.0) for alpha in _ALPHAS)),
    (1.0 / (len(_ALPHAS) + 1),) * (len(_ALPHAS) + 1),
)

# Sources that scenes refer to by their place, as descriptions of scenes hold no objects of Python.
_IN_MEMORY: list[Values] = []


def bsdf_of(source: Values) -> dict[str, Any]:
    """The Mitsuba dictionary of a source in memory, which is kept for as long as the program runs."""
    if source not in _IN_MEMORY:
        _IN_MEMORY.append(source)
    return {"type": "values", "source": _IN_MEMORY.index(source)}


def define() -> type:
    """The plugin's class for Mitsuba's present variant."""
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # its types change with the variant

    class ValuesBsdf(mi.BSDF):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            check_variant(mi.variant(), props.plugin_name())
            self.values = _IN_MEMORY[int(props["source"])] if "source" in props else self._read(props)
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            if not self.values.isotropic:
                flags |= mi.BSDFFlags.Anisotropic
            self.m_components = [flags]
            self.m_flags = flags

        @staticmethod
        def _read(props: mi.Properties) -> Values:
            # Files lie beside the scene, as those of Mitsuba's own plugins do.
            path = str(mi.file_resolver().resolve(str(props["file"])))
            return sources.read(path, str(props["material"]) if "material" in props else None)

        def to_string(self) -> str:
            return f"Values[\n  source = {self.values.name}\n]"

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return target.pdf(_PROPOSAL, _vec3(si.wi), _vec3(wo)) & self._active(ctx, si, active)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self._eval_pdf(si, _vec3(wo), self._active(ctx, si, active))

        def sample(self, ctx, si, sample1, sample2, active=True):
            wo, _, _ = target.sample(_PROPOSAL, _vec3(si.wi), sample1, sample2.x, sample2.y)
            value, pdf = self._eval_pdf(si, wo, self._active(ctx, si, active))
            valid = pdf > 0
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.Vector3f(*wo)
            bs.pdf = pdf
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = mi.UInt32(0)
            return bs, (value / dr.select(valid, pdf, 1.0)) & valid

        def _active(self, ctx, si, active):
            """The lanes that see the front."""
            if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
                return mi.Bool(False)
            return mi.Bool(active) & (si.wi.z > 0)

        def _eval_pdf(self, si, wo, active):
            wi = _vec3(si.wi)
            pdf = target.pdf(_PROPOSAL, wi, wo) & active
            return mi.Color3f(*self.values.eval(wi, wo)) & (pdf > 0), pdf

    return ValuesBsdf


def _vec3(v: Any) -> Vec3:
    return Vec3(v.x, v.y, v.z)
