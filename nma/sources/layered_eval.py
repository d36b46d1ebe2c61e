"""Evaluates the layered source at a pair of directions: an unbiased estimate of f cos(theta_o), and a density of wo.

A renderer needs the value at a single pair of directions (wi, wo), but a random walk from wi leaves along a given wo
with probability 0. So this module starts one walk from wi and another walk from wo, and joins the two walks into one
path (bidirectional path sampling). The event at which the walks are joined is called the connection. Both directions at
the connection are known, so the density of the connection is evaluated, while all other events of the path are drawn at
random.

The light from wi to wo is split into three kinds:

- Light that the coat's upper side reflects, for which there is a closed form.
- Light that is refracted into the coat and never scatters in the medium (`_unscattered`).
- Light that is refracted into the coat and scatters in the medium at least once (`_scattered`).

A connection at a narrow lobe gives a noisy estimate, because two directions that were drawn independently seldom lie in
the same narrow lobe. So `_unscattered` prefers connections at wide lobes, and `_scattered` connects walks only in the
medium, which scatters into all directions (compare Guo, Hasan and Zhao 2018, section 5).

Throughputs count particles, as in the random walk of `nma.sources.layered`. So, unlike radiance, a throughput does not
change by the squared index of refraction when a walk enters the coat.
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

# If the coat's index of refraction is below 1 + `INDEX_MATCHED`, single precision cannot represent the refraction, so
# `match_index` sets the index to 1.
INDEX_MATCHED = 1e-3
_ISOTROPIC_PHASE = 0.25 * ops.INV_PI
# The least weight of the cosine lobe in `lobes`, before the weights are normalised. The cosine lobe covers the
# directions that the other two lobes leave out.
LEAST_DIFFUSE = 0.03


def match_index(stack: Stack) -> Stack:
    """Sets the coat's index to exactly 1 if it is almost 1, as `evaluate` and `pdf` require."""
    return replace(stack, eta_top=dr.select(stack.eta_top < 1.0 + INDEX_MATCHED, 1.0, stack.eta_top))


def evaluate(stack: Stack, wi: Vec3, wo: Vec3, rng: Random, active: Mask = True) -> Color:
    """One unbiased estimate per lane of f(wi, wo) cos(theta_o) [1/sr], for wi.z > 0 and wo.z > 0.

    `stack` must come from `match_index`. The integral of the estimate's expected value over a set of directions wo
    equals the expected throughput of the walks (`nma.sources.base.walk`) that leave the material in these directions.
    """
    there, back = _enter(stack, wi, rng), _enter(stack, wo, rng)
    there.alive = back.alive = there.alive & back.alive & active
    forward, _ = _unscattered(stack, wi, there, wo, back, rng, True)
    backward, detour = _unscattered(stack, wo, back, wi, there, rng, False)
    scattered = _scattered(stack, there, [(Vec3(*back.direction), throughput(back)), detour], rng)
    # `backward` estimates f cos(theta_i), because its walks start from wo. Since f is reciprocal, `backward` times
    # cos(theta_o) / cos(theta_i) is an estimate of f cos(theta_o). `scattered` is the radiance of light inside the
    # coat. When light leaves the coat, its radiance is divided by the squared index of refraction, so `scattered` is
    # divided by the squared index here.
    index2 = stack.eta_top * stack.eta_top
    backward = backward * (wo.z / ops.maximum(wi.z, 1e-7)) + scattered * (wo.z / index2)
    return forward + backward + coat_reflection(stack, wi, wo)


def coat_reflection(stack: Stack, wi: Vec3, wo: Vec3) -> Float:
    """f cos(theta_o) [1/sr] of the reflection at the coat's upper side alone (Walter 2007, eq. 20)."""
    m = ops.normalize(wi + wo)
    fresnel, _ = fresnel_dielectric(ops.maximum(ops.dot(wi, m), 0.0), stack.eta_top)
    alpha = stack.alpha_top
    g = smith_g1(wi, alpha, alpha) * smith_g1(wo, alpha, alpha)
    return fresnel * ggx_d(m, alpha, alpha) * g / (4.0 * ops.maximum(wi.z, 1e-7))


def _enter(stack: Stack, w: Vec3, rng: Random) -> Walk:
    """Starts a walk that has arrived from `w`, and has been refracted into the coat.

    The walk is never reflected here, because the light that the coat reflects has a closed form (`coat_reflection`).
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
    """Returns the walk after it has crossed the whole slab. The walk's throughput is multiplied by the slab's
    transmittance."""
    dimmed = throughput(walk) * _transmittance(stack, 1.0, Vec3(*walk.direction))
    return replace(walk, throughput=tuple(dimmed))


def _transmittance(stack: Stack, depth: Float, w: Vec3) -> Float:
    """The fraction of the light along `w` that crosses a layer of thickness `depth` (0 to 1) without a collision."""
    return ops.exp(-stack.sigma_t * depth / ops.maximum(ops.absolute(w.z), 1e-7))


@dataclass
class _Detour:
    """One segment of a walk, chosen at random from all but the first segment.

    The choice is weighted reservoir sampling (Chao 1982), which needs no list of the segments. `tint` is the chosen
    segment's throughput divided by its weight, and `total` is the sum of the weights of all segments so far.
    """

    direction: tuple[Float, Float, Float]
    tint: tuple[Float, Float, Float]
    total: Float

    def offer(self, walk: Walk, rng: Random) -> _Detour:
        """Considers the current segment of `walk`, and either chooses this segment or keeps the previous choice.

        A segment's weight is the brightest channel of its throughput. The probability of a segment is proportional to
        the segment's weight.
        """
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
        """The chosen segment's direction, and its throughput divided by the probability of choosing it."""
        return Vec3(*self.direction), Color(*self.tint) * self.total


def _unscattered(
    stack: Stack, wi: Vec3, there: Walk, wo: Vec3, back: Walk, rng: Random, forward: bool
) -> tuple[Color, tuple[Vec3, Color]]:
    """Estimates light from wi to wo that never scatters in the medium, and chooses one segment (`_Detour`) of `there`.

    A path enters through the coat, hits the conductor once or more, and leaves through the coat. The walk `there` from
    wi is connected with wo in two ways at each hit of the conductor:

    - Connection at the hit: the conductor reflects the walk into the first segment of `back`, along which light leaves
      towards wo.
    - Connection at the exit: the walk is reflected in a random direction, and the coat refracts the light along wo.

    If `forward` is false, the caller has exchanged wi and wo, so the connections are at the path's first hit and at its
    entrance. If a path has a single hit, the first hit is also the last hit, so only the first call connects at this
    hit.

    The balance heuristic (Veach 1997, eq. 9.8) weights each possible connection of a path by the density of sampling
    all other events of the path. This density is proportional to the reciprocal of the connection's own density, which
    the code calls the connection's bluntness.
    """
    source, clear = Layered3(), replace(stack, sigma_t=stack.sigma_t * 0.0)
    drawn_up = -Vec3(*back.direction)
    drawn_out = _out_through_coat(stack, wo, drawn_up)
    way_in = _bluntness(_out_through_coat(stack, wi, -Vec3(*there.direction))[0])
    matched = stack.eta_top == 1.0

    def visit(before: Walk, after: Walk, first: Float) -> tuple[Color, Float]:
        """Estimates the light of the two connections at one hit of the conductor.

        `before` is the walk before the hit, and `after` is the walk after the hit. `first` is the bluntness of the
        walk's first hit, or 0 if there was no hit before. Returns the estimate, and the bluntness of the first hit.
        """
        w_in, went_up = -Vec3(*before.direction), Vec3(*after.direction)
        rest = way_in + first
        # Connect at this hit. An index-matched coat neither reflects nor deflects light, so its paths have a single hit
        # and can be connected only there.
        q, t = drawn_out
        blunt = _bluntness(_sharpness(stack, w_in, drawn_up))
        share = ops.select(matched, 1.0, blunt / (blunt + rest + _bluntness(q)))
        if not forward:
            share = ops.select(first > 0, share, 0.0)
        meets = (
            _mirror_pdf(_above(w_in), drawn_up, stack.alpha_bottom) * t * _transmittance(stack, 1.0, drawn_up)
        )
        found = throughput(before) * _conductor_weight(stack, w_in, drawn_up) * (share * meets)
        # Connect at the exit after this hit.
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
    """Estimates the light that scatters in the medium.

    The walk `there` from wi scatters in the medium. Each point where the walk scatters is connected to both segments in
    `ways`, which belong to the walk from wo: the first segment, and a later segment that was chosen at random. A
    segment is given by its direction and its throughput.
    """
    source = Layered3()

    def body(walk: Walk, rng: Random, total: tuple) -> tuple:
        after = source.step(stack, walk, rng)
        out = Color.of(0.0)
        for d, reached in ways:
            # The segment began at the coat if `d` points down, and at the conductor if `d` points up. Light travels
            # along the segment in the direction -d: from the point in the medium where it scatters, to the interface
            # where the segment began.
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
    """Approximate density [1/sr] with which the conductor reflects a walk from `w_in` into `up`.

    The density of the reverse reflection, from `up` into `w_in`, is taken to be the same.
    """
    return 0.25 * ggx_d(ops.normalize(w_in + up), stack.alpha_bottom, stack.alpha_bottom)


def _conductor_weight(stack: Stack, w_in: Vec3, up: Vec3) -> Color:
    """The factor by which the throughput of a walk changes when the conductor reflects it from `w_in` into `up`."""
    view = _above(w_in)
    cos_m = ops.dot(view, ops.normalize(view + up))
    tint = fresnel_conductor_rgb(cos_m, Color(*stack.eta_bottom), Color(*stack.k_bottom))
    return tint * smith_g1(up, stack.alpha_bottom, stack.alpha_bottom)


def _out_through_coat(stack: Stack, wo: Vec3, up: Vec3) -> tuple[Float, Float]:
    """Returns (q, t) for light that travels along `up` inside the coat and leaves the coat along `wo`.

    q [1/sr] is the density with which a walk from wo is refracted into the opposite direction of `up`. q t [1/sr] is
    the density with which light along `up` is refracted into wo, times the fraction of the light that passes. If `up`
    was drawn with the density q, the estimate is q t divided by q, which is t. In t the microfacet distribution and the
    Jacobian cancel, so t has no peak, however narrow the coat's lobe is. The half vector is that of Walter 2007, eq.
    16, and the Jacobian that of eq. 17.

    An index-matched coat does not deflect light, so q would be infinite, and 0 is returned for q.
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
    """Density [1/sr] of `out` when `w` is reflected at a visible normal (Walter 2007, eq. 14)."""
    m = ops.normalize(w + out)
    return visible_normal_pdf(w, m, alpha, alpha) / (4.0 * ops.maximum(ops.dot(w, m), 1e-7))


def _above(w: Vec3) -> Vec3:
    """`w`, moved slightly above the horizon, because visible normals are undefined at the horizon."""
    return Vec3(w.x, w.y, ops.maximum(w.z, 1e-7))


def lobes(stack: Stack, wi: Vec3) -> tuple[tuple[Float, Float, Float], Float]:
    """Weights of the three lobes of `pdf`, whose sum is 1, and the width (alpha) of the second lobe.

    The lobes are the coat's reflection, the conductor's reflection seen through the coat, and a cosine lobe. Tilted
    facets of the conductor and of the coat widen the second lobe. Let cos_i be the cosine of wi, and cos_t the cosine
    after refraction. A facet of the conductor shifts the tangential part of a direction by 2 cos_t times the facet's
    slope. A facet of the coat shifts the tangential part by (eta cos_t - cos_i) / eta times the facet's slope. Light
    crosses the coat twice, so the variances of three shifts are added. The second lobe is that of a conductor whose
    facets alone would cause the total variance.
    """
    eta, cos_i = stack.eta_top, ops.maximum(wi.z, 1e-3)
    fresnel, cos_t = fresnel_dielectric(cos_i, eta)
    crossing = stack.alpha_top * (eta * cos_t - cos_i) / (2.0 * eta * cos_t)
    width2 = stack.alpha_bottom * stack.alpha_bottom + 2.0 * crossing * crossing
    # Beyond the critical angle, the coat reflects light of the conductor's lobe back down. The light may later leave in
    # any direction, so it increases the weight of the cosine lobe.
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
    """A density of wo [1/sr] for importance sampling.

    The density is similar to that of the random walk, and also gives the weights of multiple importance sampling. The
    density is positive for wo.z > 0, and its integral is at most 1.
    """
    (coat, bottom, diffuse), width = lobes(stack, wi)
    inside_i, inside_o = refract_flat(wi, stack.eta_top), refract_flat(wo, stack.eta_top)
    jacobian = wo.z / (stack.eta_top * stack.eta_top * inside_o.z)
    mirrored = coat * _mirror_pdf(_above(wi), wo, stack.alpha_top)
    seen = bottom * _mirror_pdf(inside_i, inside_o, width) * jacobian
    return ops.select(wo.z > 0, mirrored + seen + diffuse * ops.INV_PI * wo.z, 0.0)


def sample(stack: Stack, wi: Vec3, u_lobe: Float, u1: Float, u2: Float) -> Vec3:
    """Draws a direction with density `pdf` from three numbers uniform in [0, 1).

    If the direction does not point up, the sample is invalid.
    """
    (coat, bottom, _), width = lobes(stack, wi)
    on_coat, eta = u_lobe < coat, stack.eta_top
    view = ops.select(on_coat, _above(wi), refract_flat(wi, eta))
    alpha = ops.select(on_coat, stack.alpha_top, width)
    mirrored = reflect(view, sample_visible_normal(view, alpha, alpha, u1, u2))
    # The direction is refracted out through a flat coat. A direction that is totally reflected inside the coat makes
    # the sample invalid.
    cos2 = 1.0 - eta * eta * (1.0 - mirrored.z * mirrored.z)
    leaves = (mirrored.z > 0) & (cos2 > 0)
    seen = Vec3(mirrored.x * eta, mirrored.y * eta, ops.select(leaves, ops.safe_sqrt(cos2), -1.0))

    r, phi = ops.safe_sqrt(u2), (2.0 * ops.PI) * u1
    cosine = Vec3(r * ops.cos(phi), r * ops.sin(phi), ops.safe_sqrt(1.0 - u2))
    return ops.select(on_coat, mirrored, ops.select(u_lobe < coat + bottom, seen, cosine))


def refract_flat(w: Vec3, eta: Float) -> Vec3:
    """The direction `w` refracted into a flat coat of index `eta` (Snell's law), mirrored to point up."""
    x, y = w.x / eta, w.y / eta
    return Vec3(x, y, ops.sqrt(ops.maximum(1.0 - x * x - y * y, 1e-7)))


def _mean(c: Color) -> Float:
    return (c.x + c.y + c.z) * (1.0 / 3.0)
