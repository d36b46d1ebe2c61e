"""Mitsuba 3 BSDF `layered`: the simulated material itself, the reference for its adapter.

`eval` is one unbiased estimate, so no two evaluations agree; their means do. It is given no random numbers and makes
its own from the bits of its arguments. Multiple importance sampling stays unbiased with any density of wi and wo that
is positive where f is, provided all methods report the same; that is `pdf`.

`sample` is one walk. What blends BSDFs (`blendbsdf`, `mask`) takes weight times pdf for the value of a sample, which no
walk knows. Inside of those, `sample` draws from `pdf` and weighs by an estimate of the value: right in any combination,
but with 1 to 1.4 times the variance of a walk, and slower.
Inputs: `nma.render.inputs`, with the parameters of class `layered3`. One-sided; wrap it in `twosided` if needed.
"""

from __future__ import annotations

from typing import Any

from nma.ops import Color, select
from nma.params import LAYERED3
from nma.render.bsdf import blended, define_base, mean_of_samples, over, vec3
from nma.render.inputs import Inputs
from nma.sources import layered_eval
from nma.sources.base import walk
from nma.sources.layered import Layered3, Stack

# Walks behind the albedo of a point, with the same random numbers everywhere: no noise, but an error of about .03.
ALBEDO_WALKS = 128


def define() -> type:
    """The plugin's class for Mitsuba's present variant."""
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # its types change with the variant

    source = Layered3()

    class Layered(define_base()):  # type: ignore[misc]
        differentiable = False

        def __init__(self, props: mi.Properties) -> None:
            self.inputs = Inputs(LAYERED3, props)
            super().__init__(props)
            self._declare()

        def to_string(self) -> str:
            return f"Layered[\n{self.inputs}\n]"

        def pdf(self, ctx, si, wo, active=True):
            with dr.suspend_grad():
                stack, active = self._prepare(ctx, si, active)
                return dr.select(active & (wo.z > 0), layered_eval.pdf(stack, vec3(si.wi), vec3(wo)), 0.0)

        def eval_pdf(self, ctx, si, wo, active=True):
            with dr.suspend_grad():
                stack, active = self._prepare(ctx, si, active)
                return self._estimate(stack, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            with dr.suspend_grad():
                stack, active = self._prepare(ctx, si, active)
                draw = self._draw if blended(self) else self._walk
                wo, weight = draw(stack, si, (sample1, sample2.x, sample2.y), active)
                pdf = layered_eval.pdf(stack, vec3(si.wi), vec3(wo))
                return self._sampled(vec3(wo), pdf, vec3(weight), active & dr.any(weight > 0))

        def _prepare(self, ctx, si, active) -> tuple[Stack, Any]:
            """The stack at `si`, and the lanes that see its front."""
            self.inputs.check()
            front = self._front(ctx, si, active)
            return self._stack(si, front), front

        def _stack(self, si, active) -> Stack:
            return layered_eval.settle(source.gather(self.inputs.columns(si, active)))

        def _walk(self, stack, si, u, active):
            """One walk's direction and throughput."""
            wo, throughput = walk(source, stack, vec3(si.wi), _random(*u, *si.wi), active)
            return mi.Vector3f(*wo), mi.Color3f(*throughput)

        def _draw(self, stack, si, u, active):
            """A direction of density `pdf`, and an estimate of the value there over it."""
            wo = mi.Vector3f(*layered_eval.sample(stack, vec3(si.wi), *u))
            value, pdf = self._estimate(stack, si, wo, active)
            return wo, over(value, pdf)

        def _estimate(self, stack, si, wo, active):
            active = active & (wo.z > 0)
            wi, wo_local = vec3(si.wi), vec3(wo)
            rng = _random(*wo, *si.wi, *si.p, *si.uv)
            value = layered_eval.evaluate(stack, wi, wo_local, rng, active)
            pdf = layered_eval.pdf(stack, wi, wo_local)
            return mi.Color3f(*select(active, value, Color.of(0.0))), dr.select(active, pdf, 0.0)

        def _albedo(self, si, active) -> Color:
            with dr.suspend_grad():
                stack, wi = self._stack(si, active), vec3(si.wi)

                def draw(k, *_):
                    return walk(source, stack, wi, _random(mi.Float(k)), active)[1]

                return mean_of_samples(draw, ALBEDO_WALKS, active)

    def _random(*numbers: Any) -> Any:
        """A random stream that depends on the bits of `numbers`."""
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(x)) for x in numbers]
        a, b = mi.UInt32(len(bits)), mi.UInt32(0x9E3779B9)
        for i, x in enumerate(bits):
            a, b = (a ^ x, b) if i % 2 == 0 else (a, b ^ x)
            if i % 2 == 1 or i == len(bits) - 1:
                a, b = mi.sample_tea_32(a, b)
        rng = mi.PCG32()  # whose own way to start gives every lane a stream of its own
        rng.state, rng.inc = (mi.UInt64(a) << 32) | mi.UInt64(b), (mi.UInt64(b) << 1) | 1
        return rng

    return Layered
