"""The layered source at a given pair of directions: an unbiased estimate of f cos(theta_o), and a similar density.

Random walks measure the light that leaves through a set of directions. A renderer also asks for the value at a single
pair (wi, wo). The light from wi to wo splits into three kinds:

- Light that the coat's upper side reflects. It has a closed form.
- Light that enters the coat and meets interfaces only.
- Light that enters the coat and scatters in the medium at least once.

The last two kinds are sampled so that two narrow lobes never have to meet by chance (compare Guo, Hasan and Zhao 2018,
section 5). All densities are those of particles, as in the walk. Unlike radiance, they do not change by the squared
index of refraction when a walk enters the coat.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from nma import ops
from nma.jit import dr
from nma.microfacet import (
    fresnel_conductor_rgb,
    fresnel_dielectric,
    ggx_d,
    reflect,
    refract,
    sample_visible_normal,
    smith_g1,
    visible_normal_pdf,
)
from nma.ops import Color, Float, Mask, Vec3
from nma.sources.base import Random, Walk, throughput
from nma.sources.layered import Layered3, Stack

# A coat whose index is closer to 1 than this bends light too little for single precision, so `settle` sets it to 1.
INDEX_MATCHED = 1e-3
_ISOTROPIC_PHASE = 0.25 * ops.INV_PI
# The least weight of the cosine lobe before normalisation, for light that the other lobes do not cover.
LEAST_DIFFUSE = 0.03


def settle(stack: Stack) -> Stack:
    """The stack in the form that `evaluate` and `pdf` need: an almost index-matched coat gets the index 1 exactly."""
    return replace(stack, eta_top=dr.select(stack.eta_top < 1.0 + INDEX_MATCHED, 1.0, stack.eta_top))


def evaluate(stack: Stack, wi: Vec3, wo: Vec3, rng: Random, active: Mask = True) -> Color:
    """One unbiased estimate per lane of f(wi, wo) cos(theta_o) [1/sr], for wi.z > 0 and wo.z > 0.

    `stack` must come from `settle`. The expected integral over a set of wo equals the expected throughput that
    `nma.sources.base.walk` carries through the set.
    """
    there, back = _enter(stack, wi, rng), _enter(stack, wo, rng)
    there.alive = back.alive = there.alive & back.alive & active
    forward, _ = _unscattered(stack, wi, there, wo, back, rng, True)
    backward, detour = _unscattered(stack, wo, back, wi, there, rng, False)
    scattered = _scattered(stack, there, [(Vec3(*back.direction), throughput(back)), detour], rng)
    # Walks from wo estimate f cos(theta_i), which reciprocity turns into f cos(theta_o). Scattered light connects below
    # the coat, where radiance is larger by the squared index, so it is divided by that.
    index2 = stack.eta_top * stack.eta_top
    backward = backward * (wo.z / ops.maximum(wi.z, 1e-7)) + scattered * (wo.z / index2)
    return forward + backward + coat_reflection(stack, wi, wo)


def coat_reflection(stack: Stack, wi: Vec3, wo: Vec3) -> Float:
    """f cos(theta_o) [1/sr] of the reflection at the coat's upper side alone. Walter 2007, eq. 20."""
    m = ops.normalize(wi + wo)
    fresnel, _ = fresnel_dielectric(ops.maximum(ops.dot(wi, m), 0.0), stack.eta_top)
    alpha = stack.alpha_top
    g = smith_g1(wi, alpha, alpha) * smith_g1(wo, alpha, alpha)
    return fresnel * ggx_d(m, alpha, alpha) * g / (4.0 * ops.maximum(wi.z, 1e-7))


def _enter(stack: Stack, w: Vec3, rng: Random) -> Walk:
    """A walk that has come from `w` and is now just below the coat.

    The walk always refracts, because the light that the coat reflects has a closed form.
    """
    alpha = stack.alpha_top
    view = _above(w)
    m = sample_visible_normal(view, alpha, alpha, rng.next_float32(), rng.next_float32())
    fresnel, cos_t = fresnel_dielectric(ops.maximum(ops.dot(view, m), 0.0), stack.eta_top)
    down = refract(view, m, cos_t, stack.eta_top)
    weight = ops.select(down.z < 0, (1.0 - fresnel) * smith_g1(down, alpha, alpha), 0.0)
    one = w.x * 0.0 + 1.0
    return Walk(tuple(down), (weight, weight, weight), one, one > 0.5, weight > 0)


def _crossing(stack: Stack, walk: Walk) -> Walk:
    """The walk after crossing the whole slab, its throughput multiplied by the slab's transmittance."""
    dimmed = throughput(walk) * _transmittance(stack, 1.0, Vec3(*walk.direction))
    return replace(walk, throughput=tuple(dimmed))


def _transmittance(stack: Stack, depth: Float, w: Vec3) -> Float:
    """Fraction of light along `w` that passes `depth` of the slab (1: the whole slab) without meeting the medium."""
    return ops.exp(-stack.sigma_t * depth / ops.maximum(ops.absolute(w.z), 1e-7))


@dataclass
class _Detour:
    """One segment of a walk after its first segment, chosen by weighted reservoir sampling (Chao 1982)."""

    direction: tuple[Float, Float, Float]
    tint: tuple[Float, Float, Float]
    total: Float

    def offer(self, walk: Walk, rng: Random) -> _Detour:
        """Chooses the current segment of `walk` instead, with a chance in proportion to its brightest channel."""
        weight = ops.select(walk.alive, ops.max_component(throughput(walk)), 0.0)
        total = self.total + weight
        take = rng.next_float32() * total < weight
        tint = throughput(walk) * (1.0 / ops.maximum(weight, 1e-20))
        return _Detour(
            tuple(ops.select(take, Vec3(*walk.direction), Vec3(*self.direction))),
            tuple(ops.select(take, tint, Color(*self.tint))),
            total,
        )

    def chosen(self) -> tuple[Vec3, Color]:
        """The segment's direction, and its throughput divided by the probability that it was chosen."""
        return Vec3(*self.direction), Color(*self.tint) * self.total


def _unscattered(
    stack: Stack, wi: Vec3, there: Walk, wo: Vec3, back: Walk, rng: Random, forward: bool
) -> tuple[Color, tuple[Vec3, Color]]:
    """Light from wi to wo that meets interfaces only, and one segment of the walk `there` after its first segment.

    A path enters through the coat, visits the conductor once or more, and leaves through the coat. It is sampled from
    both ends. All events are drawn except one, the connection: there the two ends meet, and the density of the event is
    evaluated. The best connection is the event with the widest lobe. The walk from wi connects at the way out (the walk
    goes on, and its density of leaving along wo is evaluated) or at the last visit (the way out is drawn from wo, as
    `back`). The walk from wo connects at the way in or at the first visit. A path with one visit thus has three
    possible connections. The balance heuristic (Veach 1997, eq. 9.8) combines the connections by the sharpness of their
    events.
    """
    source, clear = Layered3(), replace(stack, sigma_t=stack.sigma_t * 0.0)
    drawn_up = -Vec3(*back.direction)
    drawn_out = _out_through_coat(stack, wo, drawn_up)
    way_in = _bluntness(_out_through_coat(stack, wi, -Vec3(*there.direction))[0])
    matched = stack.eta_top == 1.0

    def visit(before: Walk, after: Walk, first: Float) -> tuple[Color, Float]:
        """Light that a visit to the conductor sends to wo, and the bluntness of the walk's first visit.

        `first` is 0 before the first visit, then its bluntness.
        """
        w_in, went_up = -Vec3(*before.direction), Vec3(*after.direction)
        rest = way_in + first
        # Connect at the last visit. This is the only connection under an index-matched coat, which turns no light back.
        q, t = drawn_out
        blunt = _bluntness(_sharpness(stack, w_in, drawn_up))
        share = ops.select(matched, 1.0, blunt / (blunt + rest + _bluntness(q)))
        if not forward:
            share = ops.select(first > 0, share, 0.0)
        meets = (
            _mirror_pdf(_above(w_in), drawn_up, stack.alpha_bottom) * t * _transmittance(stack, 1.0, drawn_up)
        )
        found = throughput(before) * _conductor_weight(stack, w_in, drawn_up) * (share * meets)
        # Connect at the way out.
        q, t = _out_through_coat(stack, wo, went_up)
        blunt = _bluntness(_sharpness(stack, w_in, went_up))
        share = ops.select(matched, 0.0, _bluntness(q) / (_bluntness(q) + blunt + rest))
        found = found + throughput(after) * (share * q * t * _transmittance(stack, 1.0, went_up))
        return found, ops.select(first > 0, first, blunt)

    def body(walk: Walk, rng: Random, total: tuple, first: Float, detour: _Detour) -> tuple:
        before = _crossing(stack, walk)
        after = source.step(clear, before, rng)
        found, blunt = visit(before, after, first)
        at_bottom = after.height < 1
        total = Color(*total) + ops.select(at_bottom, found, Color.of(0.0))
        return after, rng, tuple(total), ops.select(at_bottom, blunt, first), detour.offer(after, rng)

    zero = wo.x * 0.0
    state = (there, rng, (zero, zero, zero), zero, _Detour(there.direction, (zero, zero, zero), zero))
    _, _, total, _, detour = dr.while_loop(state, lambda walk, *rest: walk.alive, body, label="unscattered")
    return Color(*total), detour.chosen()


def _scattered(stack: Stack, there: Walk, ways: list[tuple[Vec3, Color]], rng: Random) -> Color:
    """Light that scatters in the medium. Every scattering vertex of the walk is connected to each of the `ways` out.

    A way out is the direction and the throughput of a segment of a walk from wo that met interfaces only. The medium
    scatters into all directions, so a connection succeeds however narrow the lobes along the way out are.
    """
    source = Layered3()

    def body(walk: Walk, rng: Random, total: tuple) -> tuple:
        after = source.step(stack, walk, rng)
        out = Color.of(0.0)
        for d, reached in ways:
            # The light travels against the segment, from the vertex to the interface where the segment began.
            depth = ops.select(d.z < 0, 1.0 - after.height, after.height)
            out = out + reached * (_transmittance(stack, depth, d) / ops.maximum(ops.absolute(d.z), 1e-7))
        found = throughput(walk) * Color(*stack.albedo) * out * _ISOTROPIC_PHASE
        scatters = (after.height > 0) & (after.height < 1)
        return after, rng, tuple(Color(*total) + ops.select(scatters, found, Color.of(0.0)))

    zero = stack.sigma_t * 0.0
    there = replace(there, alive=there.alive & (stack.sigma_t > 0))
    state = (there, rng, (zero, zero, zero))
    _, _, total = dr.while_loop(state, lambda walk, *rest: walk.alive, body, label="scattered")
    return Color(*total)


def _bluntness(density: Float) -> Float:
    return 1.0 / ops.maximum(density, 1e-20)


def _sharpness(stack: Stack, w_in: Vec3, up: Vec3) -> Float:
    """Approximate density [1/sr] of the conductor's reflection from `w_in` to `up`. It is the same in reverse."""
    return 0.25 * ggx_d(ops.normalize(w_in + up), stack.alpha_bottom, stack.alpha_bottom)


def _conductor_weight(stack: Stack, w_in: Vec3, up: Vec3) -> Color:
    """Factor of a walk's throughput where the conductor reflects it from `w_in` into `up`."""
    view = _above(w_in)
    cos_m = ops.dot(view, ops.normalize(view + up))
    tint = fresnel_conductor_rgb(cos_m, Color(*stack.eta_bottom), Color(*stack.k_bottom))
    return tint * smith_g1(up, stack.alpha_bottom, stack.alpha_bottom)


def _out_through_coat(stack: Stack, wo: Vec3, up: Vec3) -> tuple[Float, Float]:
    """Two densities of refraction at the coat, returned as (q, t).

    q [1/sr] is the density of `up` when wo is refracted down at a visible normal. t is the density of wo given `up`,
    divided by q; the microfacet distribution and the Jacobian cancel in t. Walter 2007, eq. 16 (half vector) and 17
    (Jacobian).
    """
    alpha, eta = stack.alpha_top, stack.eta_top
    matched = eta == 1.0
    half = up * eta - wo
    length2 = ops.maximum(ops.dot(half, half), 1e-20)
    m = half * (1.0 / ops.sqrt(length2))
    cos_o, cos_up = ops.dot(wo, m), ops.dot(up, m)
    q = visible_normal_pdf(_above(wo), m, alpha, alpha) * (eta * eta) * cos_up / length2
    fresnel, _ = fresnel_dielectric(ops.clip(cos_o, 0.0, 1.0), eta)
    passes = ops.select(matched, 1.0, 1.0 - fresnel) * smith_g1(up, alpha, alpha)
    t = passes * wo.z / (eta * eta * ops.maximum(up.z, 1e-7))
    valid = matched | ((m.z > 0) & (cos_o > 0) & (cos_up > 0))
    return ops.select(valid & ~matched, q, 0.0), ops.select(valid, t, 0.0)


def _mirror_pdf(w: Vec3, out: Vec3, alpha: Float) -> Float:
    """Density [1/sr] of `out` when `w` is reflected at a visible normal. Walter 2007, eq. 14."""
    m = ops.normalize(w + out)
    return visible_normal_pdf(w, m, alpha, alpha) / (4.0 * ops.maximum(ops.dot(w, m), 1e-7))


def _above(w: Vec3) -> Vec3:
    """`w` moved slightly above the horizon, where visible normals are undefined."""
    return Vec3(w.x, w.y, ops.maximum(w.z, 1e-7))


def lobes(stack: Stack, wi: Vec3) -> tuple[tuple[Float, Float, Float], Float]:
    """Weights of the three lobes of `pdf`, which sum to 1, and the width of the second lobe.

    The lobes are the coat's reflection, the conductor's reflection seen through the coat, and a cosine lobe. The
    squared width of the second lobe is the sum of the variances that tilted facets cause. A facet of the conductor
    shifts the tangential part of a direction by 2 cos_t times the facet's slope. A facet of the coat shifts it by (eta
    cos_t - cos_i) / eta times the facet's slope, and light crosses the coat twice.
    """
    eta, cos_i = stack.eta_top, ops.maximum(wi.z, 1e-3)
    fresnel, cos_t = fresnel_dielectric(cos_i, eta)
    crossing = stack.alpha_top * (eta * cos_t - cos_i) / (2.0 * eta * cos_t)
    width2 = stack.alpha_bottom * stack.alpha_bottom + 2.0 * crossing * crossing
    # The coat reflects the part of the conductor's lobe beyond the critical angle back down. That light may later leave
    # in any direction.
    critical = 1.0 / (eta + ops.safe_sqrt(eta * eta - 1.0))
    trapped = width2 / (width2 + critical * critical)
    metal = _mean(fresnel_conductor_rgb(cos_t, Color(*stack.eta_bottom), Color(*stack.k_bottom)))
    passes = (1.0 - fresnel) * ops.exp(-2.0 * stack.sigma_t / cos_t)
    bottom = passes * metal
    medium = (1.0 - fresnel - passes) * _mean(Color(*stack.albedo))
    diffuse = LEAST_DIFFUSE + 0.5 * (medium + bottom * trapped)
    norm = 1.0 / (fresnel + bottom + diffuse)
    width = ops.sqrt(width2)
    return (fresnel * norm, bottom * norm, diffuse * norm), ops.clip(width, 1e-4, 1.0)


def pdf(stack: Stack, wi: Vec3, wo: Vec3) -> Float:
    """A density of wo [1/sr] similar to that of the walk, for importance sampling and for weighing estimators.

    It is positive for wo.z > 0, and its integral is at most 1.
    """
    (coat, bottom, diffuse), width = lobes(stack, wi)
    inside_i, inside_o = refract_flat(wi, stack.eta_top), refract_flat(wo, stack.eta_top)
    jacobian = wo.z / (stack.eta_top * stack.eta_top * inside_o.z)
    mirrored = coat * _mirror_pdf(_above(wi), wo, stack.alpha_top)
    seen = bottom * _mirror_pdf(inside_i, inside_o, width) * jacobian
    return ops.select(wo.z > 0, mirrored + seen + diffuse * ops.INV_PI * wo.z, 0.0)


def sample(stack: Stack, wi: Vec3, u_lobe: Float, u1: Float, u2: Float) -> Vec3:
    """Draws a direction with density `pdf` from three numbers uniform in [0, 1).

    A direction that does not point up is an invalid sample.
    """
    (coat, bottom, _), width = lobes(stack, wi)
    on_coat, eta = u_lobe < coat, stack.eta_top
    view = ops.select(on_coat, _above(wi), refract_flat(wi, eta))
    alpha = ops.select(on_coat, stack.alpha_top, width)
    mirrored = reflect(view, sample_visible_normal(view, alpha, alpha, u1, u2))
    # Light from the conductor leaves through a flat coat. Total internal reflection keeps oblique light inside.
    cos2 = 1.0 - eta * eta * (1.0 - mirrored.z * mirrored.z)
    leaves = (mirrored.z > 0) & (cos2 > 0)
    seen = Vec3(mirrored.x * eta, mirrored.y * eta, ops.select(leaves, ops.safe_sqrt(cos2), -1.0))

    r, phi = ops.safe_sqrt(u2), (2.0 * ops.PI) * u1
    cosine = Vec3(r * ops.cos(phi), r * ops.sin(phi), ops.safe_sqrt(1.0 - u2))
    return ops.select(on_coat, mirrored, ops.select(u_lobe < coat + bottom, seen, cosine))


def refract_flat(w: Vec3, eta: Float) -> Vec3:
    """The direction `w` refracted into a flat coat of index `eta` (Snell's law), turned to point up."""
    x, y = w.x / eta, w.y / eta
    return Vec3(x, y, ops.sqrt(ops.maximum(1.0 - x * x - y * y, 1e-7)))


def _mean(c: Color) -> Float:
    return (c.x + c.y + c.z) * (1.0 / 3.0)
