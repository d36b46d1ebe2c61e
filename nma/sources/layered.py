"""Position-free random walks through a rough dielectric over a homogeneous medium over a rough conductor.

The method is that of Guo, Hasan and Zhao 2018, "Position-Free Monte Carlo Simulation for Arbitrary Layered BSDFs". The
layers are the same at every point of the surface, so the position along the surface does not matter. A walk consists of
a direction, a height in a slab of thickness 1, and a throughput. The code needs Dr.Jit, but no renderer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nma import ops
from nma.jit import dr
from nma.microfacet import (
    fresnel_conductor_rgb,
    fresnel_dielectric,
    reflect,
    refract,
    sample_visible_normal,
    smith_g1,
)
from nma.ops import Color, Float, Vec3
from nma.params import LAYERED3
from nma.sources.base import Random, Walk

# Russian roulette begins when the brightest channel of a walk's throughput falls below `ROULETTE_THRESHOLD`. The value
# .5 had the smallest product of variance and time among the thresholds that were tried.
ROULETTE_THRESHOLD = 0.5
# The largest probability with which a walk survives total internal reflection. If every walk survived, some walks
# between a smooth coat and a perfect mirror, without a medium, would never end.
TRAPPED_SURVIVAL = 0.999


@dataclass
class Stack:
    """The parameters of the stack, one value per lane."""

    alpha_top: Float
    alpha_bottom: Float
    eta_top: Float
    eta_bottom: tuple[Float, Float, Float]  # the conductor's index of refraction divided by eta_top
    k_bottom: tuple[Float, Float, Float]  # the conductor's extinction coefficient divided by eta_top
    albedo: tuple[Float, Float, Float]
    sigma_t: Float


class Layered3:
    """The class `layered3` (paper Table 1) as a source."""

    space = LAYERED3

    def gather(self, columns: list[Any]) -> Stack:
        """The stack from the 13 columns of the class's parameter vector."""
        alpha_top, alpha_bottom, eta_top, *rest = columns
        eta, k, albedo, sigma_t = rest[0:3], rest[3:6], rest[6:9], rest[9]
        # Light reaches the conductor from the coat, not from air, so the conductor's index is divided by the coat's
        # index.
        inv = 1.0 / eta_top
        return Stack(
            alpha_top,
            alpha_bottom,
            eta_top,
            tuple(e * inv for e in eta),
            tuple(x * inv for x in k),
            tuple(albedo),
            sigma_t,
        )

    def step(self, params: Stack, walk: Walk, rng: Random) -> Walk:
        """Simulates one free flight and one event.

        The event is scattering in the medium, or reflection or refraction at an interface.
        """
        u_flight, u_lobe = rng.next_float32(), rng.next_float32()
        u1, u2 = rng.next_float32(), rng.next_float32()
        d = Vec3(*walk.direction)
        upward = walk.inside & (d.z > 0)
        at_bottom = walk.inside & (d.z <= 0)

        # Fly to the next event, which is in the medium or at the interface ahead.
        optical_depth = -dr.log(1.0 - u_flight)
        height = walk.height + d.z * (optical_depth / dr.maximum(params.sigma_t, 1e-20))
        in_medium = walk.inside & (params.sigma_t > 0) & (height > 0) & (height < 1)

        # At an interface, work in a frame whose normal points to the side that the walk comes from.
        alpha = dr.select(at_bottom, params.alpha_bottom, params.alpha_top)
        w = Vec3(-d.x, -d.y, dr.maximum(dr.abs(d.z), 1e-7))
        m = sample_visible_normal(w, alpha, alpha, u1, u2)
        cos_m = dr.maximum(ops.dot(w, m), 0.0)

        # The coat reflects with a probability equal to its Fresnel term. The conductor always reflects, and its Fresnel
        # reflectance multiplies the throughput.
        eta = dr.select(upward, 1.0 / params.eta_top, params.eta_top)
        fresnel, cos_t = fresnel_dielectric(cos_m, eta)
        reflects = at_bottom | (u_lobe < fresnel)
        mirrored = reflect(w, m)
        refracted = refract(w, m, cos_t, eta)
        valid = dr.select(reflects, mirrored.z > 0, refracted.z < 0)
        out = ops.select(reflects, mirrored, refracted)
        tint = fresnel_conductor_rgb(cos_m, Color(*params.eta_bottom), Color(*params.k_bottom))
        weight = ops.select(at_bottom, tint, Color.of(1.0)) * smith_g1(out, alpha, alpha)
        weight = ops.select(valid, weight, Color.of(0.0))
        # Convert the direction to the slab's frame, in which z points up. In the frame used above, z points down for
        # a walk that hits the coat from below, so the sign of z changes for this walk.
        out = Vec3(out.x, out.y, dr.select(upward, -out.z, out.z))

        # In the medium, scatter isotropically.
        out = ops.select(in_medium, _uniform_sphere(u1, u2), out)
        weight = ops.select(in_medium, Color(*params.albedo), weight)
        leaves = ~in_medium & (out.z > 0) & ~at_bottom & (reflects ^ walk.inside)
        height = dr.select(in_medium, height, dr.select(at_bottom, 0.0, 1.0))

        result = Color(*walk.throughput) * weight
        totally_reflected = upward & ~in_medium & (cos_t <= 0)
        survival, result = _roulette(result, leaves, totally_reflected, rng)
        return Walk(tuple(out), tuple(result), height, walk.inside | ~reflects, survival & ~leaves)


def _uniform_sphere(u1: Float, u2: Float) -> Vec3:
    z = 1.0 - 2.0 * u1
    r = ops.safe_sqrt(1.0 - z * z)
    phi = (2.0 * ops.PI) * u2
    return Vec3(r * ops.cos(phi), r * ops.sin(phi), z)


def _roulette(value: Color, exempt: Any, trapped: Any, rng: Random) -> tuple[Any, Color]:
    """Russian roulette by the brightest channel: returns (survives, `value` divided by the probability of survival).

    Walks that are `exempt` always survive. Walks that are `trapped` survive with a probability of at most
    `TRAPPED_SURVIVAL`.
    """
    most = dr.select(trapped, TRAPPED_SURVIVAL, 1.0)
    chance = dr.select(exempt, 1.0, dr.minimum(ops.max_component(value) * (1.0 / ROULETTE_THRESHOLD), most))
    survives = rng.next_float32() < chance
    return survives, ops.select(survives, value * (1.0 / dr.maximum(chance, 1e-20)), Color.of(0.0))
