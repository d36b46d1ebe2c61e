"""The simulated material in C++ equals that of the package: its density, samples, walk, estimate and albedo."""

import ctypes
import itertools
from functools import cache

import layered_cases
import numpy as np
import pytest
from density_cases import p_values
from layered_cases import FALSE_ALARM, GRID, limit, table_of, z_scores
from runtime_cases import built, facing, pointer

from nma.jit import dr
from nma.ops import Vec3
from nma.params import LAYERED3
from nma.sources import layered_eval
from nma.sources.layered import Layered3
from nma.table import stream_keys, tabulate

GOLD = {"eta_conductor": (0.14, 0.37, 1.44), "k_conductor": (3.98, 2.38, 1.6), "albedo": (0.9, 0.3, 0.2)}
CASES = {
    "lacquer": {"alpha_top": 0.1, "alpha_bottom": 0.3, "eta_top": 1.5, "sigma_t": 0.5},
    "strong_coat": {"alpha_top": 0.3, "alpha_bottom": 0.15, "eta_top": 1.9, "sigma_t": 0.1},
    "thick": {"alpha_top": 0.15, "alpha_bottom": 1.0, "eta_top": 1.3, "sigma_t": 3.0},
    "index_matched": {"alpha_top": 0.2, "alpha_bottom": 0.2, "eta_top": 1.0, "sigma_t": 0.3},
}
# A material whose lobes are too narrow for the bins of a chi-square test, so that only its mean values are tested.
NARROW = {"alpha_top": 0.002, "alpha_bottom": 0.02, "eta_top": 1.5, "sigma_t": 0.5}
COSINES = (1.0, 0.6, 0.1)
ESTIMATORS = pytest.mark.parametrize("estimator", ["walk", "estimate"])


def vector(values):
    return LAYERED3.vector(GOLD | values).astype(np.float32)


def view(mu):
    return np.array([np.sqrt(1 - mu * mu), 0, mu], np.float32)


@pytest.fixture(scope="module")
def bridge(compiler, tmp_path_factory):
    # Dr.Jit does not fuse products and sums. With -ffp-contract=off, the compiler does not fuse products and sums
    # either, so that C++ and Dr.Jit round equally.
    library = built(compiler, "layered_bridge.cpp", tmp_path_factory.mktemp("layered"), "-ffp-contract=off")

    def call(name, inputs, shape):
        """Calls a C function and returns its outputs as an array of the given shape.

        All functions but `layered_albedo` have the count of rows as their first argument.
        """
        out = np.empty(shape, np.float32)
        count = [ctypes.c_int(shape[0])] if name != "layered_albedo" else []
        arrays = [np.ascontiguousarray(a, np.float32) for a in inputs]
        getattr(library, name)(*count, *map(pointer, (*arrays, out)))
        return out

    call.library = library
    return call


def layers_of(values):
    return layered_eval.match_index(Layered3().gather([dr.auto.Float(float(x)) for x in vector(values)]))


def vec3(rows):
    return Vec3(*(dr.auto.Float(column) for column in np.ascontiguousarray(np.transpose(rows))))


def random_materials(rng, n):
    """Returns n random materials, float32 (n, 13).

    About a third of the materials are drawn from the training ranges, a third from the valid ranges, and a third from
    the hard cases.
    """
    low, high = LAYERED3.columns("valid")
    powers = [low[:2], np.maximum(low[2:], 1e-3)], [high[:2], np.minimum(high[2:], 100.0)]
    low, high = (np.concatenate(ends) for ends in powers)
    valid = low * (high / low) ** rng.random((n, LAYERED3.size))
    hard = np.array([layered_cases.vector(values) for values in layered_cases.CASES.values()])
    choices = LAYERED3.sample(rng, n), valid, hard[rng.integers(len(hard), size=n)]
    return np.choose(rng.integers(3, size=n)[:, None], choices).astype(np.float32)


def random_views(rng, n):
    """Returns random directions (n, 3).

    In a quarter of the directions, the cosine is log-uniform from 1e-4 to 1.
    """
    z = np.where(rng.random(n) < 0.25, 10.0 ** rng.uniform(-4, 0, n), rng.random(n))
    phi, r = 2.0 * np.pi * rng.random(n), np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def beside_the_mirror(rng, wi, params):
    """Returns directions (n, 3) within the lobe of the coat or of the conductor."""
    n = len(wi)
    alpha = np.where(rng.random(n) < 0.5, params[:, 0], params[:, 1])
    tilt, turn = alpha * np.tan(0.45 * np.pi * rng.random(n)), 2.0 * np.pi * rng.random(n)
    h = np.stack([tilt * np.cos(turn), tilt * np.sin(turn), np.ones(n)], axis=-1)
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    return 2.0 * (wi * h).sum(axis=-1, keepdims=True) * h - wi


def test_density_is_that_of_the_package_case_by_case(bridge):
    """C++ and the package compute the same density within 1e-4, for 4,000 materials and pairs of directions.

    C++ and the package compute in single precision and round in the same way, so that their densities agree better with
    each other than with the exact density. For example, an index-matched coat reflects light only because of rounding.
    """
    rng, n = np.random.default_rng(0), 4000
    params, wi, wo = random_materials(rng, n), random_views(rng, n), random_views(rng, n)
    beside = beside_the_mirror(rng, wi, params)
    near = (np.arange(n) % 2 == 0) & (beside[:, 2] > 1e-4)
    wo = np.where(near[:, None], beside, wo)
    assert near.mean() > 0.3
    wi, wo = wi.astype(np.float32), wo.astype(np.float32)
    layers = layered_eval.match_index(
        Layered3().gather([dr.auto.Float(c) for c in np.ascontiguousarray(params.T)])
    )
    expected = layered_eval.pdf(layers, vec3(wi), vec3(wo)).numpy()
    found = bridge("layered_pdf_each", (params, wi, wo), (n,))
    assert (expected > 0).all()
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_a_coat_is_matched_if_its_index_is_below_1_001(bridge):
    """A matched coat does not reflect light, so that its index does not change the density."""
    wi, wo = (random_views(np.random.default_rng(seed), 50).astype(np.float32) for seed in (1, 2))

    def density(eta):
        return bridge("layered_pdf", (vector(CASES["index_matched"] | {"eta_top": eta}), wi[0], wo), (50,))

    np.testing.assert_array_equal(density(1.00099), density(1.0))
    assert (density(1.00101) != density(1.0)).any()


def test_samples_are_those_of_the_package(bridge):
    u = np.random.default_rng(0).random((4000, 3), np.float32)
    for values in (*CASES.values(), NARROW):
        layers = layers_of(values)
        for mu in COSINES:
            wi = view(mu)
            drawn = layered_eval.sample(layers, vec3(wi), *vec3(u))
            expected = np.stack([x.numpy() for x in drawn], axis=-1)
            found = bridge("layered_sample", (vector(values), wi, u), (len(u), 7))
            valid = expected[:, 2] > 0
            # Near the border between two lobes, rounding may choose the other lobe. Near the horizon, rounding may
            # change whether a sample is valid.
            assert (valid == (found[:, 3] > 0)).mean() > 0.998
            assert (np.abs(found[:, :3] - expected).max(axis=1) < 1e-3)[valid].mean() > 0.998


def hard(case):
    return layered_cases.vector(layered_cases.CASES[case])


@cache
def reference(case, walks=1 << 20):
    """Returns the table of a hard case, simulated by the package."""
    return tabulate(Layered3(), hard(case)[None], walks, stream_keys(3, range(1)), grid=GRID)


def scores(bridge, estimator, params, tables, per_row=1 << 18, seed=5):
    """Returns |z| of the difference between a table in C++ and a table of the package's walks.

    `estimator` says whether C++ fills its table from walks ("walk") or estimates ("estimate"). Estimates are compared
    only in bins with a relative error below 3 %. The reason is that a few bright samples may dominate the other bins if
    the coat is rough and the conductor is smooth. If no bright sample is drawn, the stated error of such a bin is too
    small.
    """
    sums, squares = np.zeros((2, *GRID.shape))
    about = np.ascontiguousarray(params, np.float32)
    sizes = GRID.theta_i, GRID.theta_o, GRID.phi_o, per_row, seed
    bridge.library.layered_table(estimator == "walk", *sizes, *map(pointer, (about, sums, squares)))
    known = np.inf if estimator == "walk" else 0.03
    return np.abs(z_scores(*table_of(sums, squares, per_row), tables, known=known))


def bent_more(params):
    """Returns the parameters of the material with a 2 % higher index of refraction of the coat."""
    return np.where(np.arange(len(params)) == 2, 1.02 * params, params)


def test_the_coat_s_reflection_is_that_of_the_package_and_reciprocal(bridge):
    """f cos(theta_i) cos(theta_o) is the same if wi and wo are exchanged, also near the horizon."""
    rng, n, about = np.random.default_rng(7), 1000, vector(CASES["strong_coat"])
    wi, wo = random_views(rng, n), random_views(rng, n)
    wi[: n // 2] = facing(10.0 ** rng.uniform(-6, -3, n // 2))
    wi, wo = wi.astype(np.float32), wo.astype(np.float32)
    found, back = (bridge("layered_coat_reflection", (about, *pair), (n,)) for pair in ((wi, wo), (wo, wi)))
    expected = layered_eval.coat_reflection(layers_of(CASES["strong_coat"]), vec3(wi), vec3(wo))
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-4)
    np.testing.assert_allclose(found * wi[:, 2], back * wo[:, 2], rtol=1e-3)


@pytest.mark.parametrize("case", ["index_matched", "strong_coat"])
def test_light_that_grazes_the_coat_from_inside_leaves_as_in_the_package(bridge, case):
    """C++ and the package compute the same light that leaves the coat, also if the light inside is almost horizontal.

    An index-matched coat deflects no light, so t is the coat's shadowing (`smith_g1`) times cos(theta_o) / cos(theta).
    As theta inside the coat approaches 90 degrees, t approaches 2 cos(theta_o) / alpha.
    """
    rng, n = np.random.default_rng(6), 1000
    up, wo = random_views(rng, n), random_views(rng, n)
    up[: n // 2] = facing(10.0 ** rng.uniform(-6, -3, n // 2))
    if (
        case != "index_matched"
    ):  # a coat with an index refracts light along a horizontal `up` close to the horizon only
        wo[: n // 2] = facing(up[: n // 2, 2] * rng.random(n // 2))
    up, wo = up.astype(np.float32), wo.astype(np.float32)
    expected = layered_eval._out_through_coat(layers_of(CASES[case]), vec3(wo), vec3(up))
    found = bridge("layered_out_through_coat", (vector(CASES[case]), wo, up), (n, 2))
    np.testing.assert_allclose(found, np.stack([x.numpy() for x in expected], axis=-1), rtol=1e-3)
    assert (found[: n // 2, 1] > 0).mean() > 0.3
    if case == "index_matched":
        limit_of_t = 2.0 * wo[: n // 2, 2] / CASES[case]["alpha_top"]
        np.testing.assert_allclose(found[: n // 2, 1], limit_of_t, rtol=0.02)


@ESTIMATORS
@pytest.mark.parametrize("case", layered_cases.SLOW_CASES)
def test_every_bin_is_that_of_the_package(bridge, case, estimator):
    """Walks and estimates in C++ have the same means as walks of the package, in every bin and every row of bins.

    The Z-tests have the false-alarm rate `FALSE_ALARM` per case; seeds are fixed.
    """
    z = scores(bridge, estimator, hard(case), reference(case))
    assert z.size > 0.1 * GRID.bins
    assert z.max() < limit(z.size), f"z {z.max():.1f} beyond {limit(z.size):.1f}"


@ESTIMATORS
def test_the_comparison_of_bins_detects_an_index_that_is_two_percent_off(bridge, estimator):
    z = scores(bridge, estimator, bent_more(hard("wide_narrow")), reference("wide_narrow"))
    assert z.max() > limit(z.size)


@pytest.mark.slow
@ESTIMATORS
@pytest.mark.parametrize("case", ["narrow_wide", "thick", "white_coated"])
def test_eight_times_as_many_walks_agree_and_detect_the_wrong_index(bridge, case, estimator):
    about = reference(case, 1 << 23), 1 << 20
    right, wrong = (scores(bridge, estimator, p, *about) for p in (hard(case), bent_more(hard(case))))
    assert right.size > 0.5 * GRID.bins
    assert right.max() < limit(right.size), f"z {right.max():.1f} beyond {limit(right.size):.1f}"
    assert wrong.max() > limit(wrong.size)


@pytest.mark.slow
@ESTIMATORS
def test_every_bin_of_random_materials_is_that_of_the_package(bridge, estimator):
    params = LAYERED3.sample(np.random.default_rng(12), 4)
    tables = tabulate(Layered3(), params, 1 << 22, stream_keys(4, range(len(params))), grid=GRID)
    each = [scores(bridge, estimator, p, tables[k : k + 1], 1 << 19, k) for k, p in enumerate(params)]
    z = np.concatenate(each)
    assert z.max() < limit(z.size), f"z {z.max():.1f} beyond {limit(z.size):.1f}"


@pytest.mark.slow
def test_samples_follow_the_density(bridge):
    """Samples in C++ follow their density (chi-square tests, false-alarm rate 1e-3 in all; seeds are fixed)."""
    rng, tests = np.random.default_rng(1), len(CASES) * 2
    for name, values in CASES.items():
        for mu in COSINES[:2]:
            about = vector(values), view(mu)

            def sample(n, about=about):
                rows = bridge("layered_sample", (*about, rng.random((n, 3))), (n, 7))
                return rows[:, :3], rows[:, 3]

            def density(wo, about=about):
                return bridge("layered_pdf", (*about, wo), (len(wo),))

            right, wrong = p_values(sample, density)
            assert right > 1 - (1 - FALSE_ALARM) ** (1 / tests), (name, mu)
            assert wrong < 1e-6


@pytest.mark.parametrize("case", [*CASES, "narrow"])
def test_weights_of_samples_have_the_mean_of_walks(bridge, case):
    """Mean sample weights and mean throughputs of walks give the same directional albedo.

    The Z-tests have a false-alarm rate of 1e-3 in all.
    """
    n, most = 200_000, limit(3 * len(COSINES))
    about = vector(CASES.get(case, NARROW))
    for mu in COSINES:
        rows = bridge("layered_sample", (about, view(mu), np.random.default_rng(2).random((n, 3))), (n, 7))
        valid, unit = rows[:, 3] > 0, np.linalg.norm(rows[:, :3], axis=1)
        assert np.abs(unit[valid] - 1).max() < 1e-4
        weights = np.where(valid[:, None], rows[:, 4:] / np.maximum(rows[:, 3:4], 1e-30), 0).astype(
            np.float64
        )
        walks = bridge("layered_walks", (about, view(mu)), (n, 3)).astype(np.float64)
        error = np.sqrt((weights.var(axis=0) + walks.var(axis=0)) / n)
        assert (np.abs(weights.mean(axis=0) - walks.mean(axis=0)) < most * error).all()


def test_albedos_have_no_noise_and_are_close_to_those_of_many_walks(bridge):
    """An albedo is the mean of a fixed set of 256 walks, so that repeated calls return the same albedo.

    The albedo is within .1 of the mean of many walks, because the mean of 256 walks has a standard deviation of at most
    .5 / 16.
    """
    for values in (*CASES.values(), NARROW):
        for mu in COSINES:
            about = vector(values), view(mu)
            found = bridge("layered_albedo", about, (3,))
            np.testing.assert_array_equal(found, bridge("layered_albedo", about, (3,)))
            many = bridge("layered_walks", about, (100_000, 3)).mean(axis=0)
            assert np.abs(found - many).max() < 0.1


def test_albedos_are_at_most_one(bridge):
    """The mean throughput of the 256 walks of a white material may be above 1 by chance, but the albedo is then 1.

    The test fails if no mean is above 1, because an albedo of exactly 1 is otherwise very unlikely.
    """
    white = {"eta_conductor": 0.0, "k_conductor": 1.0, "albedo": 1.0}
    smooth = {"alpha_top": 0.001, "alpha_bottom": 0.0015}
    found = []
    for eta_top, sigma_t, mu in itertools.product((3.0, 3.3), (0.4, 1.8, 3.0), (0.4, 0.7, 0.9)):
        about = vector(white | smooth | {"eta_top": eta_top, "sigma_t": sigma_t}), view(mu)
        found.append(bridge("layered_albedo", about, (3,)))
    assert np.max(found) == 1.0
