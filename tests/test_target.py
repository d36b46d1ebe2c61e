"""The target equals Mitsuba's `principled`, is reciprocal and finite, and is the same in all array packages."""

import warnings

import drjit as dr
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from target_cases import FAST_COMPILE, mapped, random_blend, random_directions, random_principled, stacked

from nma import ops, target
from nma.llvm import ensure_llvm
from nma.ops import Color, Vec3
from nma.target import Blend, Principled, eval_principled
from nma.target.principled import clearcoat_alpha, geometry, gtr1_d

ensure_llvm()
import mitsuba as mi  # noqa: E402  (libLLVM comes first)

SINGLE_EPS = 2.0**-24


def to_single(tree):
    """Rounds to single precision and converts back to double precision.

    After this rounding, computations in single and in double precision get exactly the same inputs.
    """
    return mapped(tree, lambda x: x.astype(np.float32).astype(np.float64))


def drjit_single(tree):
    return mapped(tree, lambda x: dr.llvm.Float(x.astype(np.float32)))


def lobe_directions(rng, blend, wi):
    """Samples one direction per lane from the blend. Random directions replace samples below the horizon."""
    wo, _, _ = target.sample(blend, wi, *rng.random((3, wi.z.size)))
    fallback = random_directions(rng, wi.z.size)
    return ops.select(wo.z > 1e-6, wo, fallback)


# ---- Mitsuba's `principled` ------------------------------------------------------------------------------------------


class Oracle:
    """Mitsuba's BSDF `principled` with n parameter sets at once, which are stored as the texels of textures."""

    def __init__(self, p: Principled):
        mi.set_variant("llvm_ad_rgb")
        self.side = int(np.sqrt(p.roughness.size))
        # Mitsuba's BSDF has none of the fields from `fade` on.
        names = [k for k in p._fields[: p._fields.index("fade")] if k not in ("base_color", "specular")]
        textures = {k: self.texture(getattr(p, k)) for k in names}
        self.bsdf = mi.load_dict(
            {
                "type": "principled",
                "base_color": self.texture(np.stack(p.base_color, -1)),
                "specular": 0.5,
                **textures,
            }
        )
        params = mi.traverse(self.bsdf)
        params["specular"] = mi.Float(p.specular.astype(np.float32))
        params.update()

    def texture(self, values):
        texels = values.astype(np.float32).reshape(self.side, self.side, -1)
        return {"type": "bitmap", "data": mi.TensorXf(texels), "raw": True, "filter_type": "nearest"}

    def eval(self, wi, wo):
        n = self.side**2
        si = dr.zeros(mi.SurfaceInteraction3f, n)
        si.wi = mi.Vector3f(stacked(wi).astype(np.float32))
        index = np.arange(n)
        si.uv = mi.Point2f((index % self.side + 0.5) / self.side, (index // self.side + 0.5) / self.side)
        return np.array(self.bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(stacked(wo).astype(np.float32))))


def test_eval_equals_mitsuba_principled():
    """Our values equal Mitsuba's within 1e-4 relative, for 10,000 parameter sets with alpha down to .001.

    Half of the directions are sampled from the lobes. A failure means that our formulas differ from Mitsuba's. Mitsuba
    computes in single precision, so that the test allows larger differences in two cases:
    - The clearcoat is divided by the sum 1 + (alpha^2 - 1) cos^2(theta_h), so that the relative error of the clearcoat
      may be a few rounding errors divided by this sum.
    - If both directions are grazing and almost opposite (cos(theta_d) < .005), the cosine between direction and half
      vector loses digits, so that a relative difference of 2e-3 is allowed.

    Directions whose cosine is below .001 are not compared. Near the horizon, Mitsuba's cosine between direction and
    half vector may become negative by rounding, and Mitsuba returns zero.
    """
    rng = np.random.default_rng(11)
    n = 10_000
    p = to_single(random_principled(rng, n))
    # A tenth of the parameter sets have alpha at its lower bound of .001, and a tenth have a smaller alpha.
    floor = rng.random(n)
    rough = np.where(floor < 0.1, np.sqrt(np.float32(0.001)), np.where(floor > 0.9, 0.01, p.roughness))
    p = p._replace(roughness=rough.astype(np.float32).astype(np.float64))
    oracle = Oracle(p)
    allowed, worst = 0, 0.0
    for repeat in range(16):
        wi = to_single(random_directions(rng, n))
        wo = lobe_directions(rng, Blend((p,), (1.0,)), wi) if repeat % 2 else random_directions(rng, n)
        wo = to_single(wo)
        expected = oracle.eval(wi, wo)
        value = stacked(eval_principled(p, wi, wo))
        base = stacked(eval_principled(p._replace(clearcoat=0.0 * p.clearcoat), wi, wo))
        g = geometry(wi, wo)
        cancelling = g.h.x**2 + g.h.y**2 + clearcoat_alpha(p.clearcoat_gloss) ** 2 * g.h.z**2
        allowance = (value - base) * np.minimum(8 * SINGLE_EPS / cancelling, 10.0)
        error = np.abs(value - expected)
        opposite = g.cos_d < 0.005
        compared = (wi.z > 1e-3) & (wo.z > 1e-3)
        assert compared.mean() > 0.8
        error = np.where(compared, error, 0.0)
        assert np.all(error <= np.where(opposite, 2e-3, 1e-4) * np.abs(value) + allowance + 1e-9)
        plain = (allowance < 1e-5 * np.abs(value)) & ~opposite
        worst = max(worst, np.max((error / (np.abs(value) + 1e-9))[plain]))
        allowed += np.sum(~plain.all(axis=0))
    # At least 92 % of the pairs of directions are neither of the two cases in which the test allows larger differences.
    # For these pairs, the values agree within single precision.
    assert allowed < 0.08 * 16 * n
    assert worst < 2e-5


@pytest.mark.parametrize("gloss", (0.0, 0.3, 0.9, 1.0))
def test_clearcoat_distribution_is_normalised(gloss):
    # Rounding in Mitsuba prevents a precise comparison of clearcoats, so that this test checks the scale of the
    # clearcoat's distribution D. The integral of D cos(theta_h) over all half vectors must be 1. With the variable
    # s = sin^2(theta_h), the integrand is pi D. Equal steps of the variable x = log(s + alpha^2) sample the peak of D
    # densely.
    alpha = clearcoat_alpha(gloss)
    low, high = np.log(alpha**2), np.log(1 + alpha**2)
    x = low + (high - low) * (np.arange(20_000) + 0.5) / 20_000
    s = np.exp(x) - alpha**2
    h = Vec3(np.sqrt(s), 0.0, np.sqrt(1 - s))
    integral = np.mean(np.pi * gtr1_d(h, alpha) * np.exp(x)) * (high - low)
    assert integral == pytest.approx(1.0, abs=1e-6)


# ---- Laws ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_instances", (1, 2, 5))
def test_blends_are_reciprocal(n_instances):
    rng = np.random.default_rng(12)
    blend = random_blend(rng, 5000, n_instances)
    wi, wo = random_directions(rng, 5000), random_directions(rng, 5000)
    there = stacked(target.eval(blend, wi, wo)) / wo.z
    back = stacked(target.eval(blend, wo, wi)) / wi.z
    np.testing.assert_allclose(there, back, rtol=1e-9)


def test_values_and_densities_are_zero_below_the_horizon():
    rng = np.random.default_rng(13)
    blend = random_blend(rng, 1000, 2)
    wi, wo = random_directions(rng, 1000), random_directions(rng, 1000)
    below = lambda w: Vec3(w.x, w.y, -w.z)
    for i, o in ((below(wi), wo), (wi, below(wo)), (below(wi), below(wo)), (wi, -wi)):
        value, pdf = target.eval_pdf(blend, i, o)
        assert not np.any(stacked(value))
        assert not np.any(pdf)
    _, value, pdf = target.sample(blend, below(wi), *rng.random((3, 1000)))
    assert not np.any(stacked(value))
    assert not np.any(pdf)


def test_a_blend_is_the_weighted_sum_of_its_instances():
    rng = np.random.default_rng(14)
    blend = random_blend(rng, 1000, 3)
    wi, wo = random_directions(rng, 1000), random_directions(rng, 1000)
    parts = [
        stacked(eval_principled(p, wi, wo)) * w for p, w in zip(blend.instances, blend.weights, strict=True)
    ]
    np.testing.assert_allclose(stacked(target.eval(blend, wi, wo)), sum(parts), rtol=1e-12)
    np.testing.assert_array_equal(
        stacked(target.eval_pdf(blend, wi, wo)[0]), stacked(target.eval(blend, wi, wo))
    )


@pytest.mark.slow
def test_ten_million_evaluations_are_finite_and_not_negative():
    """`eval_pdf` and `sample` return finite values of at least 0 in single precision.

    Parameters are random or extreme, and directions are random or grazing.
    """
    Float = dr.llvm.Float
    n = 5_000_000
    rng = dr.llvm.PCG32(size=n, initstate=15)

    def number(low=0.0, high=1.0):
        # About a quarter of all numbers lie at an end of their range.
        u = rng.next_float32()
        return low + (high - low) * dr.clip(1.3 * u - 0.15, 0.0, 1.0)

    def instance():
        color = Color(number(), number(), number())
        return Principled(color, number(), number(), number(high=1.8), *(number() for _ in range(7)))

    def direction():
        u = rng.next_float32()
        cos = dr.select(rng.next_float32() < 0.3, dr.exp(-40.0 * u), 1.2 * u - 0.1)
        cos = dr.clip(cos, -1.0, 1.0)
        sin, c = dr.sincos(dr.two_pi * rng.next_float32())
        r = dr.safe_sqrt(1.0 - cos * cos)
        return Vec3(r * c, r * sin, cos)

    weight = number()
    blend = Blend((instance(), instance()), (weight, 1.0 - weight))
    wi, wo = direction(), direction()
    # In every tenth pair, the azimuths of the two directions are opposite.
    opposite = rng.next_float32() < 0.1
    wo = Vec3(dr.select(opposite, -wi.x, wo.x), dr.select(opposite, -wi.y, wo.y), wo.z)
    value, pdf = target.eval_pdf(blend, wi, wo)
    sampled, drawn, density = target.sample(blend, wi, *(rng.next_float32() for _ in range(3)))
    results = [*value, pdf, *drawn, density]
    for x in results:
        assert dr.all(dr.isfinite(x) & (x >= 0.0))
    assert all(dr.all(dr.isfinite(Float(x))) for x in sampled)
    # Every direction wo with a value above 0 has a pdf above 0.
    assert dr.all((pdf > 0) | (value.x + value.y + value.z == 0))


@pytest.mark.slow
def test_derivatives_are_finite_everywhere():
    """Derivatives are finite in single precision for extreme raw outputs and degenerate pairs of directions."""
    rng = np.random.default_rng(16)
    s = float(np.sqrt(0.5))
    special = [
        ((1, 0, 0), (-1, 0, 0)), ((1, 0, 0), (-1, 0, -1e-20)), ((0, 0, 1), (0, 0, -1)), ((0, 0, 1), (0, 0, 1)),
        ((s, 0, s), (-s, 0, s)), ((1, 0, 1e-9), (-1, 0, 1e-9)), ((1, 0, 1e-8), (-1, 0, 1e-8)), ((0, 0, 0), (0, 0, 0)),
        ((1, 0, 1e-6), (1, 0, 1e-6)), ((0, 1, 1e-7), (0, 0, 1)),
    ]  # fmt: skip
    pairs = np.array(special, np.float32)
    params = target.MEASURED_PARAMS
    size = target.output_size(1, params)
    raw = rng.normal(size=(400, 1, size)) * rng.choice([1, 10, 100, 1000], (400, 1, 1))
    raw[0] = 0.0

    def total(raw, wi, wo):
        blend = target.decode([raw[..., k] for k in range(size)], 1, params)
        value, pdf = target.eval_pdf(blend, Vec3(*wi), Vec3(*wo))
        return sum(jnp.sum(jnp.log1p(c)) for c in (*value, pdf))

    gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2)), **FAST_COMPILE)
    for g in gradients(jnp.asarray(raw, jnp.float32), pairs[:, 0].T, pairs[:, 1].T):
        assert bool(jnp.all(jnp.isfinite(g)))


def test_derivatives_equal_finite_differences():
    rng = np.random.default_rng(17)
    with jax.enable_x64(True), warnings.catch_warnings():
        raw = jnp.asarray(rng.normal(size=(300, 23)))
        # Directions are given by cosine and azimuth, so that finite differences do not move them below the horizon.
        cosines, phis = rng.uniform(0.05, 0.95, (2, 300)), rng.uniform(0, 6, (2, 300))
        near = rng.random(300) < 0.5
        cosines[1] = np.where(near, np.clip(cosines[0] + rng.normal(size=300) * 0.02, 0.05, 0.99), cosines[1])
        phis[1] = np.where(near, phis[0] + np.pi + rng.normal(size=300) * 0.02, phis[1])
        x = jnp.concatenate([raw, cosines.T, phis.T], axis=1)

        def f(x):
            blend = target.decode([x[k] for k in range(23)], 2)
            wi, wo = (
                Vec3(jnp.sqrt(1 - c * c) * jnp.cos(phi), jnp.sqrt(1 - c * c) * jnp.sin(phi), c)
                for c, phi in ((x[23], x[25]), (x[24], x[26]))
            )
            value, pdf = target.eval_pdf(blend, wi, wo)
            return value.x + 2 * value.y + 3 * value.z + pdf

        exact = jax.jit(jax.vmap(jax.grad(f)), **FAST_COMPILE)(x)
        batched = jax.jit(jax.vmap(f), **FAST_COMPILE)
        for k in range(27):
            step = jnp.zeros(27).at[k].set(1e-6)
            difference = (batched(x + step) - batched(x - step)) / 2e-6
            scale = jnp.abs(batched(x)) + jnp.abs(exact[:, k])
            assert float(jnp.max(jnp.abs(difference - exact[:, k]) / scale)) < 1e-5


# ---- Array packages and precisions -----------------------------------------------------------------------------------


def test_single_precision_keeps_its_digits():
    """Dr.Jit and JAX in single precision equal NumPy in double precision within a factor of 1 +- 2e-5, even in peaks.

    NumPy, Dr.Jit and JAX get the same inputs, which are rounded to single precision.
    """
    rng = np.random.default_rng(18)
    n = 100_000
    blend = to_single(random_blend(rng, n, 2))
    wi = to_single(random_directions(rng, n))
    wo = to_single(lobe_directions(rng, blend, wi))
    value, pdf = target.eval_pdf(blend, wi, wo)
    expected = np.concatenate([stacked(value), pdf[None]])

    value, pdf = target.eval_pdf(drjit_single(blend), drjit_single(wi), drjit_single(wo))
    from_drjit = np.concatenate([stacked(value), pdf.numpy()[None]])

    to_jax = lambda tree: mapped(tree, lambda x: jnp.asarray(x, jnp.float32))
    value, pdf = jax.jit(target.eval_pdf)(to_jax(blend), to_jax(wi), to_jax(wo))
    from_jax = np.concatenate([stacked(value), np.asarray(pdf)[None]])

    np.testing.assert_allclose(from_drjit, expected, rtol=2e-5)
    np.testing.assert_allclose(from_jax, expected, rtol=2e-5)


def test_samples_are_the_same_in_every_array_package():
    rng = np.random.default_rng(19)
    n = 20_000
    blend, wi = to_single(random_blend(rng, n, 3)), to_single(random_directions(rng, n))
    u = to_single(tuple(rng.random((3, n))))
    expected = stacked(target.sample(blend, wi, *u)[0])
    from_drjit = stacked(target.sample(drjit_single(blend), drjit_single(wi), *drjit_single(u))[0])
    # A random number within a rounding error of the border between two lobes may choose either lobe.
    close = np.abs(from_drjit - expected).max(axis=0) < 1e-4
    assert close.mean() > 0.999
