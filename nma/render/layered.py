"""Mitsuba 3 BSDF `layered`: the simulated material itself, the reference for its adapter.

`sample` is one walk, `eval` one unbiased estimate, so both are noisy and no two evaluations agree; their means do.
`eval` is given no random numbers and makes its own from the bits of its arguments. Multiple importance sampling stays
unbiased with any density of wi and wo that is positive where f is, provided all methods report the same; that is `pdf`.
Inputs: `nma.render.inputs`, with the parameters of class `layered3`. One-sided; wrap it in `twosided` if needed.
"""

from __future__ import annotations

from typing import Any

from nma.errors import ParamError
from nma.ops import Color, Vec3, select
from nma.params import LAYERED3
from nma.render.inputs import Inputs
from nma.sources import layered_eval
from nma.sources.base import walk
from nma.sources.layered import Layered3, Layers


def define() -> type:
    """The plugin's class for Mitsuba's present variant."""
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # its types change with the variant

    source = Layered3()

    class Layered(mi.BSDF):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            check_variant(mi.variant(), props.plugin_name())
            self.inputs = Inputs(LAYERED3, props)
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            if self.inputs.textured:
                flags |= mi.BSDFFlags.SpatiallyVarying
            self.m_components = [flags]
            self.m_flags = flags

        def traverse(self, callback: mi.TraversalCallback) -> None:
            self.inputs.traverse(callback, mi.ParamFlags.NonDifferentiable)

        def to_string(self) -> str:
            return f"Layered[\n{self.inputs}\n]"

        def sample(self, ctx, si, sample1, sample2, active=True):
            with dr.suspend_grad():
                layers, active = self._prepare(ctx, si, active)
                return self._sample(layers, si, sample1, sample2, active)

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            with dr.suspend_grad():
                layers, active = self._prepare(ctx, si, active)
                return dr.select(active & (wo.z > 0), layered_eval.pdf(layers, _vec3(si.wi), _vec3(wo)), 0.0)

        def eval_pdf(self, ctx, si, wo, active=True):
            with dr.suspend_grad():
                layers, active = self._prepare(ctx, si, active)
                return self._eval_pdf(layers, si, wo, active)

        def eval_pdf_sample(self, ctx, si, wo, sample1, sample2, active=True):
            with dr.suspend_grad():
                layers, active = self._prepare(ctx, si, active)
                value, pdf = self._eval_pdf(layers, si, wo, active)
                return value, pdf, *self._sample(layers, si, sample1, sample2, active)

        def _prepare(self, ctx, si, active) -> tuple[Layers, Any]:
            """The layers at `si`, and the lanes that see their front."""
            active = mi.Bool(active) & (si.wi.z > 0)
            if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
                active = mi.Bool(False)
            return layered_eval.settle(source.gather(self.inputs.columns(si, active))), active

        def _sample(self, layers, si, sample1, sample2, active):
            rng = _random(sample1, sample2.x, sample2.y, *si.wi)
            wo, throughput = walk(source, layers, _vec3(si.wi), rng, active)
            pdf = layered_eval.pdf(layers, _vec3(si.wi), wo)
            left = active & ((throughput.x > 0) | (throughput.y > 0) | (throughput.z > 0)) & (pdf > 0)

            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.Vector3f(*wo)
            bs.pdf = dr.select(left, pdf, 0.0)
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = mi.UInt32(0)
            return bs, mi.Color3f(*select(left, throughput, Color.of(0.0)))

        def _eval_pdf(self, layers, si, wo, active):
            active = active & (wo.z > 0)
            wi, wo_local = _vec3(si.wi), _vec3(wo)
            rng = _random(*wo, *si.wi, *si.p, *si.uv)
            value = layered_eval.evaluate(layers, wi, wo_local, rng, active)
            pdf = layered_eval.pdf(layers, wi, wo_local)
            return mi.Color3f(*select(active, value, Color.of(0.0))), dr.select(active, pdf, 0.0)

    def _random(*numbers: Any) -> Any:
        """A random stream that depends on the bits of `numbers`."""
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(x)) for x in numbers]
        a, b = mi.UInt32(len(bits)), mi.UInt32(0x9E3779B9)
        for i, x in enumerate(bits):
            a, b = (a ^ x, b) if i % 2 == 0 else (a, b ^ x)
            if i % 2 == 1 or i == len(bits) - 1:
                a, b = mi.sample_tea_32(a, b)
        state = (mi.UInt64(a) << 32) | mi.UInt64(b)
        return mi.PCG32(1, state, mi.UInt64(b))

    return Layered


def check_variant(variant: str, plugin: str) -> None:
    """Refuses variants other than the vectorised RGB ones."""
    if not variant.endswith("_ad_rgb"):
        raise ParamError(
            f"BSDF '{plugin}' runs in the variants llvm_ad_rgb and cuda_ad_rgb, not in {variant}: its parameters are "
            "RGB and its code is vectorised; call mi.set_variant('llvm_ad_rgb') first, or make the plugin for "
            "scalar_rgb with `nma mitsuba build`"
        )


def _vec3(v: Any) -> Vec3:
    return Vec3(v.x, v.y, v.z)
