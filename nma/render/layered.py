"""Mitsuba 3 BSDF `layered`: the simulated material, which is the reference for its adapter.

`eval` returns one unbiased random estimate. Mitsuba passes no random numbers to `eval`, so `eval` makes them from the
bits of its arguments. The density of the simulated walks is unknown, so `pdf` and `sample` report an approximate
density. Multiple importance sampling stays unbiased, because the reported density is positive wherever f is positive,
and `pdf` and `sample` report the same density.

`sample` simulates one random walk. BSDFs that blend other BSDFs (`blendbsdf`, `mask`) assume that weight times pdf is
the BRDF value, which is wrong for a walk. Inside a blend, `sample` draws a direction from `pdf`, and its weight is an
estimate of the value divided by `pdf`. Drawing from `pdf` is unbiased in every BSDF, but slower than a walk, and has 1
to 1.4 times the variance of a walk.

`nma.render.inputs` reads the parameters of class `layered3`. The BSDF is one-sided; wrap it in `twosided` if needed.
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

# The albedo at a point is the mean of ALBEDO_WALKS walks. The walks have the same random numbers at all points, so the
# albedo has an error of up to .06, but no noise.
ALBEDO_WALKS = 128


def define() -> type:
    """The plugin's class for Mitsuba's current variant."""
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # Mitsuba's types change with the variant

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
                stack, front = self._prepare(ctx, si, active)
                return dr.select(front & (wo.z > 0), layered_eval.pdf(stack, vec3(si.wi), vec3(wo)), 0.0)

        def eval_pdf(self, ctx, si, wo, active=True):
            with dr.suspend_grad():
                stack, front = self._prepare(ctx, si, active)
                return self._estimate(stack, si, wo, front)

        def sample(self, ctx, si, sample1, sample2, active=True):
            with dr.suspend_grad():
                stack, front = self._prepare(ctx, si, active)
                draw = self._draw if blended(self) else self._walk
                wo, weight = draw(stack, si, (sample1, sample2.x, sample2.y), front)
                pdf = layered_eval.pdf(stack, vec3(si.wi), vec3(wo))
                return self._sampled(vec3(wo), pdf, vec3(weight), front & dr.any(weight > 0))

        def _prepare(self, ctx, si, active) -> tuple[Stack, Any]:
            """The stack at `si`, and `front`: the active lanes that see the front of the surface."""
            self.inputs.check()
            front = self._front(ctx, si, active)
            return self._stack(si, front), front

        def _stack(self, si, active) -> Stack:
            return layered_eval.match_index(source.gather(self.inputs.columns(si, active)))

        def _walk(self, stack, si, u, active):
            """The direction and the throughput of one walk."""
            wo, throughput = walk(source, stack, vec3(si.wi), _random(*u, *si.wi), active)
            return mi.Vector3f(*wo), mi.Color3f(*throughput)

        def _draw(self, stack, si, u, active):
            """A direction drawn from `pdf`, and an estimate of the BRDF value for this direction divided by `pdf`."""
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
        """A random stream seeded by the bits of `numbers`."""
        bits = [dr.reinterpret_array(mi.UInt32, mi.Float(x)) for x in numbers]
        a, b = mi.UInt32(len(bits)), mi.UInt32(0x9E3779B9)
        for i, x in enumerate(bits):
            a, b = (a ^ x, b) if i % 2 == 0 else (a, b ^ x)
            if i % 2 == 1 or i == len(bits) - 1:
                a, b = mi.sample_tea_32(a, b)
        rng = mi.PCG32()  # the constructor's own seeding would also depend on the lane
        rng.state, rng.inc = (mi.UInt64(a) << 32) | mi.UInt64(b), (mi.UInt64(b) << 1) | 1
        return rng

    return Layered
