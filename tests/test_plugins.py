"""Every BSDF that this package registers with Mitsuba keeps the promises that integrators rely on.

The tests loop over `PLUGINS` of nma/render/register.py, so they also test a new BSDF.
"""

import mitsuba as mi
import numpy as np
import pytest
from density_cases import p_values

import nma.render
from nma.jit import dr
from nma.ops import Color, Vec3
from nma.render.bsdf import define_base
from nma.render.register import PLUGINS
from nma.render.values_bsdf import bsdf_of
from nma.sources.coating import Coating

SAMPLES, COSINE = 100_000, 0.6
# For each plugin, the description of a BSDF whose lobes are wide enough for the bins of `p_values`.
ROUGH = {"alpha_top": 0.3, "alpha_bottom": 0.4, "eta_top": 1.5, "sigma_t": 0.7}
EXAMPLES = {
    "layered": {"material": "rusty-iron"} | ROUGH,
    "nma": {"adapter": "layered3-3x32", "material": "rusty-iron"} | ROUGH,
    "values": bsdf_of(Coating(alpha=0.4)),
}


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")


def load(plugin):
    assert plugin in EXAMPLES, (
        f"the tests do not know the properties of the BSDF '{plugin}': add a line for '{plugin}' to EXAMPLES in "
        "tests/test_plugins.py"
    )
    return mi.load_dict({"type": plugin} | EXAMPLES[plugin])


def interactions(n):
    """Interactions whose `wi` has the cosine COSINE. The position varies, because random BSDFs may depend on it."""
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - COSINE**2)), 0.0, COSINE) + dr.zeros(mi.Float, n)
    si.p = mi.Point3f(dr.arange(mi.Float, n) / n, 0.25, 0.5)
    return si


def random_numbers(seed):
    rng = mi.PCG32(SAMPLES, seed)
    return rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())


def mean_and_error(values):
    """Returns the mean of the values (3, n) and its standard error, each (3,)."""
    return values.mean(axis=1), values.std(axis=1) / np.sqrt(values.shape[1])


def check_values(bsdf):
    """Values and densities are finite, at least 0, and 0 below the horizon; `eval` and `pdf` agree with `eval_pdf`."""
    ctx, si = mi.BSDFContext(), interactions(SAMPLES)
    wo = mi.warp.square_to_uniform_sphere(random_numbers(1)[1])
    value, pdf = bsdf.eval_pdf(ctx, si, wo)
    numbers, below = np.vstack([np.array(value), np.array(pdf)[None]]), np.array(wo.z) <= 0
    assert np.isfinite(numbers).all(), "a value or a density is not finite"
    assert (numbers >= 0).all(), "a value or a density is negative"
    assert (numbers[:, below] == 0).all(), "a value or a density below the horizon is not 0"
    assert (numbers > 0).any(axis=1).all(), "all values or all densities are 0"
    np.testing.assert_array_equal(np.array(bsdf.eval(ctx, si, wo)), numbers[:3])
    np.testing.assert_allclose(np.array(bsdf.pdf(ctx, si, wo)), numbers[3], rtol=1e-5)


def check_densities(bsdf):
    """Inside a BSDF that blends others, samples follow `pdf`, whose integral is at most 1.

    A chi-square test of 24 x 48 bins has a false-alarm rate of 1e-4 and must find a density that is up to 10 % off. The
    seeds are fixed. Outside of blends, samples of `layered` do not follow its `pdf`.
    """
    blend = mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": bsdf, "b": bsdf})
    ctx = mi.BSDFContext()

    def sample(n):
        rng = mi.PCG32(n, 2)
        bs, _ = blend.sample(
            ctx, interactions(n), rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        )
        np.testing.assert_allclose(
            np.array(bs.pdf), np.array(blend.pdf(ctx, interactions(n), bs.wo)), rtol=1e-3
        )
        return np.array(bs.wo).T, np.array(bs.pdf)

    def density(wo):
        return np.array(blend.pdf(ctx, interactions(len(wo)), mi.Vector3f(*map(mi.Float, wo.T.copy()))))

    right, wrong = p_values(sample, density)
    assert right > 1e-4, "samples do not follow the density"
    assert wrong < 1e-4, "there are too few samples for the test"


def check_albedo(bsdf):
    """The albedo is from 0 to 1, and is the mean of sample weights, also inside a blend, and the integral of `eval`.

    The two means of weights and the integral agree within 5 standard errors plus .005. The reported albedo may be .06
    off, which is the error of `layered`.
    """
    ctx, si = mi.BSDFContext(), interactions(SAMPLES)
    reported = np.array(bsdf.eval_diffuse_reflectance(interactions(1)))[:, 0]
    assert ((reported >= 0) & (reported <= 1)).all(), "the reported albedo is outside of 0 .. 1"
    wo = mi.warp.square_to_uniform_hemisphere(random_numbers(3)[1])
    alone = np.array(bsdf.sample(ctx, si, *random_numbers(4))[1])
    integral, error = mean_and_error(2 * np.pi * np.array(bsdf.eval(ctx, si, wo)))
    blend = mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": bsdf, "b": bsdf})
    for weights in (alone, np.array(blend.sample(ctx, si, *random_numbers(5))[1])):
        assert (np.isfinite(weights) & (weights >= 0)).all(), "a sample weight is negative or not finite"
        mean, more = mean_and_error(weights)
        assert (np.abs(mean - integral) <= 5 * np.hypot(error, more) + 0.005).all(), (
            "weights are not the integral"
        )
        assert (mean <= 1 + 5 * more).all(), "the BSDF reflects more light than it receives"
        np.testing.assert_allclose(reported, mean, atol=0.06)


def check_black(bsdf):
    """All methods return 0 for the back, inactive lanes, and contexts without glossy reflection or component 0."""
    rest, other, every = mi.BSDFContext(), mi.BSDFContext(), mi.BSDFContext()
    rest.type_mask = +mi.BSDFFlags.DiffuseReflection
    other.component = 1
    front, back = interactions(100), interactions(100)
    back.wi.z = -back.wi.z
    wo, u = mi.Vector3f(0.0, 0.6, 0.8), (mi.Float(0.3), mi.Point2f(0.4, 0.6))
    for ctx, si, active in (
        (rest, front, True),
        (other, front, True),
        (every, back, True),
        (every, front, False),
    ):
        value, pdf, drawn, weight = bsdf.eval_pdf_sample(ctx, si, wo, *u, active)
        found = [value, pdf, drawn.pdf, weight, bsdf.eval(ctx, si, wo, active), bsdf.pdf(ctx, si, wo, active)]
        drawn, weight = bsdf.sample(ctx, si, *u, active)
        found += [*bsdf.eval_pdf(ctx, si, wo, active), drawn.pdf, weight]
        assert not any(np.array(numbers).any() for numbers in found), (
            f"not black: {ctx}, {si.wi.z[0]}, {active}"
        )


CHECKS = (check_values, check_densities, check_albedo, check_black)


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("plugin", PLUGINS)
def test_a_plugin_is_a_bsdf(plugin, check):
    check(load(plugin))


def test_a_plugin_without_an_example_is_named():
    with pytest.raises(AssertionError, match="add a line for 'new' to EXAMPLES"):
        load("new")


def diffuse(value=1.0, density=1.0, weight=1.0, albedo=0.5, ignores=()):
    """A diffuse BSDF of albedo .5, whose values, densities, weights and reported albedo are multiplied by factors.

    The methods in `ignores`, "eval_pdf" or "sample", ignore the context.
    """

    class Diffuse(define_base()):
        def __init__(self, props):
            super().__init__(props)
            self._declare()

        def eval_pdf(self, ctx, si, wo, active=True):
            ctx = mi.BSDFContext() if "eval_pdf" in ignores else ctx
            shape = dr.select(self._front(ctx, si, active) & (wo.z > 0), wo.z / np.pi, 0.0)
            return mi.Color3f(0.5 * value * shape), density * shape

        def sample(self, ctx, si, sample1, sample2, active=True):
            ctx = mi.BSDFContext() if "sample" in ignores else ctx
            wo = mi.warp.square_to_cosine_hemisphere(sample2)
            found = mi.Color3f(0.5 * weight) + dr.zeros(mi.Float, dr.width(wo))
            return self._sampled(
                Vec3(*wo), self.pdf(ctx, si, wo, active), found, self._front(ctx, si, active)
            )

        def _albedo(self, si, active):
            return Color(*[mi.Float(albedo)] * 3)

    return Diffuse(mi.Properties("diffuse"))


def test_a_diffuse_bsdf_passes_all_checks():
    for check in CHECKS:
        check(diffuse())


@pytest.mark.parametrize(
    ("check", "factors"),
    [
        (check_values, {"value": -14.0}),
        (check_values, {"density": float("nan")}),
        (check_densities, {"density": 3.0}),
        (check_densities, {"density": 0.5}),
        (check_albedo, {"albedo": 50.0}),
        (check_albedo, {"albedo": -1.0}),
        (check_albedo, {"weight": 1.2}),
        (check_albedo, {"value": 2.2, "weight": 2.2, "albedo": 1.0}),
        (check_black, {"ignores": ("eval_pdf",)}),
        (check_black, {"ignores": ("sample",)}),
    ],
    ids=lambda what: getattr(what, "__name__", None) or str(what),
)
def test_a_faulty_bsdf_is_found(check, factors):
    with pytest.raises(AssertionError):
        check(diffuse(**factors))
