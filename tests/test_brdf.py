"""Adapters of every kind prepare a BRDF whose methods agree for every azimuth of the view.

If lobes are stretched in the plane of incidence, the BRDF includes the frame of this plane.
"""

import math
from dataclasses import replace
from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from target_cases import horizon_pairs, random_directions, stacked

import nma.render
from nma import target
from nma.adapter import Adapter, encoding
from nma.errors import ParamError
from nma.ops import Color, Vec3
from nma.params import LAYERED3, MEASURED
from nma.render.curves import Curves
from nma.target import Blend, Plane, Principled

nma.render.use("llvm_ad_rgb")

# For each kind of adapter: its class, encoding and target, and whether its energy is bounded.
KINDS = {
    "isotropic": (LAYERED3, "layered3", "principled", False),
    "stretched": (LAYERED3, "layered3", "stretched", False),
    "bounded": (LAYERED3, "layered3", "stretched", True),
    "interface": (LAYERED3, "layered3_bounce", "interface", True),
    "single": (MEASURED, "direction", "measured", False),
    "anisotropic": (MEASURED, "azimuth", "anisotropic", False),
}
ISOTROPIC = tuple(kind for kind in KINDS if kind != "anisotropic")
IN_PLANE = ("stretched", "bounded", "interface", "single")
AZIMUTHS = (0.0, 2.0, 4.5)
# A blend of a bright stretched metal and a paint with sheen. The blend reflects more light than it receives.
BLEND = Blend(
    (
        Principled(Color(1.0, 0.9, 0.8), 0.5, 1.0, 0.5, 0.1, 0.1, 0.1, 0.3, 0.2, -4.0, 0.1, -0.1, 0.5),
        Principled(Color(0.9, 0.9, 1.0), 0.9, 0.1, 1.0, 0.2, 0.9, 0.5, 0.5, 0.1, -2.0, 0.1, -0.1, 0.5),
    ),
    (0.6, 0.4),
)


@cache
def adapter(kind):
    """Returns an adapter whose blend is near `BLEND` and varies with every input of the network."""
    space, name, wanted, bounded = KINDS[kind]
    raw = np.array(target.encode(BLEND, target.TARGETS[wanted]), np.float32)
    slopes = np.random.default_rng(0).standard_normal((len(raw), encoding.size(name, space, True)))
    layers = [(0.1 * slopes.astype(np.float32), raw)]
    interface = space.interface if wanted == "interface" else None
    return Adapter(space, name, layers, 2, True, target.TARGETS[wanted], bounded=bounded, interface=interface)


def columns(of, like):
    """Returns the parameters of one material as a list of arrays, each as long as `like`."""
    vector = LAYERED3.sample(np.random.default_rng(1), 1)[0] if of.space is LAYERED3 else []
    return [0.0 * like + float(x) for x in vector]


def prepared(kind, wi):
    return adapter(kind).prepare(columns(adapter(kind), wi.z), wi)


def turned(v, angle):
    """Rotates directions about the normal by an angle in radians."""
    c, s = math.cos(angle), math.sin(angle)
    return Vec3(c * v.x - s * v.y, s * v.x + c * v.y, v.z)


def pairs(n=2000):
    rng = np.random.default_rng(2)
    return random_directions(rng, n), random_directions(rng, n)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("kind", KINDS)
def test_at_the_horizon_and_below_all_is_zero_without_a_warning(kind, precision):
    """Values and densities are 0 if `wi` or `wo` lies at or below the horizon."""
    wi, wo = (Vec3(*w.astype(precision).T) for w in horizon_pairs())
    brdf = prepared(kind, wi)
    assert not np.any(stacked(brdf.eval(wi, wo))) and not np.any(brdf.pdf(wi, wo))
    value, pdf = brdf.eval_pdf(wi, wo)
    assert not np.any(stacked(value)) and not np.any(pdf)
    for u in ((0.1, 0.2, 0.3), (0.5, 0.0, 0.0), (0.999, 0.5, 0.999)):
        wo, value, pdf = brdf.sample(wi, *(x + 0.0 * wi.z for x in u))
        assert np.isfinite([*stacked(wo), *stacked(value), pdf]).all()
        assert not np.any(stacked(value)[:, wi.z <= 0]) and not np.any(pdf[wi.z <= 0])


@pytest.mark.parametrize("eta", [1.05, 4 / 3, 1.5, 2.0])
def test_the_coats_reflectance_divides_by_zero_at_no_direction(eta):
    """Below the horizon, at cos(theta_i) = -1 / sqrt(1 + eta^2), the Fresnel equations would divide by zero."""
    z = np.array([-0.6, -1 / np.sqrt(1 + eta * eta), -1 / np.sqrt(1 + 1 / (eta * eta)), -1.0, 0.0])
    columns = LAYERED3.sample(np.random.default_rng(0), 1)[0]
    columns[2] = eta
    wi = Vec3(np.sqrt(1 - z * z), 0 * z, z)
    adapter = Adapter.load("layered3-3x32")
    with np.errstate(divide="raise", invalid="raise"):
        made = adapter.prepare([np.full(len(z), x) for x in columns], wi)
    assert np.isfinite(target.numbers(made.blend, adapter.target)).all()


@pytest.mark.parametrize("azimuth", AZIMUTHS)
@pytest.mark.parametrize("kind", KINDS)
def test_samples_follow_the_density_in_the_local_frame(kind, azimuth):
    """Samples follow the density of `pdf`, for every kind of adapter and every azimuth of the view (chi-square test).

    The false-alarm rate is .01 over all cases together (Sidak's correction). A failure means biased renderings.
    """

    def view(like):
        wi = turned(Vec3(0.8, 0.0, 0.6), azimuth)
        return Vec3(*(0.0 * like + x for x in wi))

    def draw(u):
        wi = view(u.x)
        wo, _, pdf = prepared(kind, wi).sample(wi, u.x, u.y, u.z)
        return mi.Vector3f(*wo), mi.Float(pdf > 0)

    def density(wo):
        wi = view(wo.x)
        return prepared(kind, wi).pdf(wi, Vec3(wo.x, wo.y, wo.z))

    sphere = mi.chi2.SphericalDomain()
    test = mi.chi2.ChiSquareTest(sphere, draw, density, 3, sample_count=1 << 17, res=51, ires=16)
    assert test.run(0.01, len(KINDS) * len(AZIMUTHS)), test.messages


@pytest.mark.parametrize("kind", KINDS)
def test_the_methods_of_a_brdf_agree(kind):
    wi, wo = pairs()
    brdf = prepared(kind, wi)
    value, pdf = brdf.eval_pdf(wi, wo)
    np.testing.assert_array_equal(stacked(brdf.eval(wi, wo)), stacked(value))
    np.testing.assert_array_equal(brdf.pdf(wi, wo), pdf)
    drawn, value, pdf = brdf.sample(wi, *np.random.default_rng(3).random((3, 2000)))
    again, density = brdf.eval_pdf(wi, drawn)
    assert (pdf > 0).mean() > 0.7
    np.testing.assert_allclose(stacked(again), stacked(value), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(density, pdf, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("kind", ISOTROPIC)
def test_an_isotropic_material_looks_the_same_when_both_directions_turn(kind):
    wi, wo = pairs()
    expected = stacked(prepared(kind, wi).eval(wi, wo))
    for azimuth in AZIMUTHS:
        i, o = turned(wi, azimuth), turned(wo, azimuth)
        np.testing.assert_allclose(stacked(prepared(kind, i).eval(i, o)), expected, rtol=1e-4, atol=1e-9)


def off(found, expected):
    """Returns the mean absolute difference between `found` and `expected`, relative to the mean of `expected`."""
    return np.abs(stacked(found) - stacked(expected)).mean() / stacked(expected).mean()


@pytest.mark.parametrize("kind", IN_PLANE)
def test_evaluating_a_blend_without_its_frame_is_wrong(kind):
    """The values of a blend that is evaluated without its frame are more than 40 % off, or 25 % under an interface,
    whose own reflection has no axes.

    The large error shows that the other tests in this file would detect a BRDF that ignores its frame.
    """
    wi, wo = pairs()
    brdf = prepared(kind, wi)
    assert off(target.eval(brdf.blend, wi, wo), brdf.eval(wi, wo)) > (0.25 if kind == "interface" else 0.4)


def test_an_anisotropic_material_shows_its_azimuth():
    wi, wo = pairs()
    i, o = turned(wi, 1.0), turned(wo, 1.0)
    assert off(prepared("anisotropic", i).eval(i, o), prepared("anisotropic", wi).eval(wi, wo)) > 0.2


def test_bounded_adapters_are_dimmed():
    wi, wo = pairs()
    bright = replace(adapter("bounded"), bounded=False).prepare(columns(adapter("bounded"), wi.z), wi)
    dim = prepared("bounded", wi)
    assert np.min(dim.blend.scale) < 0.95
    np.testing.assert_allclose(
        stacked(dim.eval(wi, wo)), stacked(bright.eval(wi, wo) * dim.blend.scale), rtol=1e-9
    )


@pytest.mark.parametrize("kind", KINDS)
def test_only_targets_that_stretch_in_the_plane_of_incidence_have_a_frame(kind):
    """The BRDF of a target that does not stretch lobes has no `Plane`, so Dr.Jit records no rotations into a plane."""
    assert isinstance(prepared(kind, pairs()[0]).plane, Plane if kind in IN_PLANE else type(None))


@pytest.mark.parametrize("kind", ISOTROPIC)
def test_curves_and_numbers_describe_the_same_brdf(kind):
    """`from_numbers` gives the same BRDF as `prepare` within 1e-5, and `Curves.at` within 1e-3.

    The difference of `from_numbers` is due to rounding in the network. The larger difference of `Curves.at` is due to
    interpolation between the nodes of the curves.
    """
    wi, wo = pairs()
    own, expected = adapter(kind), prepared(kind, wi).eval(wi, wo)
    flat = own.numbers(np.reshape([c[0] for c in columns(own, wi.z)], (1, -1)), wi.z)[0]
    assert off(own.from_numbers(list(flat.T.astype(np.float64)), wi).eval(wi, wo), expected) < 1e-5
    curves = Curves(own, columns(own, mi.Float(0.0)))
    wi, wo = (Vec3(*(mi.Float(x.astype(np.float32)) for x in v)) for v in (wi, wo))
    assert off(curves.at(wi, []).eval(wi, wo), expected) < 1e-3


def test_an_anisotropic_adapter_has_no_curves():
    own = adapter("anisotropic")
    for call in (lambda: own.numbers(np.zeros((1, 0)), [0.5]), lambda: Curves(own, [])):
        with pytest.raises(ParamError, match="no curves over cos.*call `prepare` instead"):
            call()


def test_a_cosine_in_place_of_the_direction_is_refused():
    """If `prepare` gets a cosine, the error message says how to make a direction.

    In older versions, `prepare` took cosines.
    """
    adapter = Adapter.load("layered3-3x32")
    columns = list(LAYERED3.sample(np.random.default_rng(0), 2).T)
    for cosine in (0.5, np.array([0.5, 0.6]), mi.Float(0.5)):
        with pytest.raises(ParamError, match="not a cosine; nma.ops.at_azimuth_0"):
            adapter.prepare(columns, cosine)


def test_arguments_that_do_not_fit_are_refused():
    """`prepare` refuses a wrong number of columns in every array package, and NumPy arrays of other shapes."""
    adapter = Adapter.load("layered3-3x32")
    columns = list(LAYERED3.sample(np.random.default_rng(0), 4).T)
    up = Vec3(*np.repeat([[0.0], [0.0], [1.0]], 4, axis=1))
    for wrong in ([*columns, columns[0]], columns[:5], []):
        for convert in (np.asarray, mi.Float):
            with pytest.raises(ParamError, match=f"layered3 has 13 columns of parameters, got {len(wrong)}"):
                adapter.prepare([convert(c) for c in wrong], Vec3(*map(convert, up)))
    square = Vec3(*(x.reshape(2, 2) for x in up))
    for wrong, wi in (
        ([c.reshape(2, 2) for c in columns], square),
        (columns, square),
        ([c[:3] for c in columns], up),
    ):
        with pytest.raises(ParamError, match=r"have the shapes .*; give arrays \(n,\) of one length n"):
            adapter.prepare(wrong, wi)
    for params, cosines in ((columns, 0.5), (np.ones((2, 2, 13)), [0.5]), (np.ones(13), [[0.5]])):
        with pytest.raises(ParamError, match=r"needs parameters \(m, 13\) and cosines \(n,\)"):
            adapter.numbers(params, cosines)
    alone = adapter.prepare([float(c[0]) for c in columns], Vec3(0.0, 0.0, 1.0))
    assert np.isfinite(alone.eval(Vec3(0.0, 0.0, 1.0), Vec3(0.0, 0.6, 0.8)).x)
