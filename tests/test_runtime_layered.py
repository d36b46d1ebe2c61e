"""The simulated material in C++: density and samples are the package's, samples follow it, walks have its mean."""

import ctypes

import numpy as np
import pytest
from density_cases import p_values
from runtime_cases import built, pointer
from scipy.stats import norm
from target_cases import random_directions, stacked

from nma.jit import dr
from nma.ops import Vec3
from nma.params import LAYERED3
from nma.sources import layered_eval
from nma.sources.layered import Layered3

GOLD = {"eta_conductor": (0.14, 0.37, 1.44), "k_conductor": (3.98, 2.38, 1.6), "albedo": (0.9, 0.3, 0.2)}
CASES = {
    "lacquer": {"alpha_top": 0.1, "alpha_bottom": 0.3, "eta_top": 1.5, "sigma_t": 0.5},
    "strong_coat": {"alpha_top": 0.3, "alpha_bottom": 0.15, "eta_top": 1.9, "sigma_t": 0.1},
    "thick": {"alpha_top": 0.15, "alpha_bottom": 1.0, "eta_top": 1.3, "sigma_t": 3.0},
    "index_matched": {"alpha_top": 0.2, "alpha_bottom": 0.2, "eta_top": 1.0, "sigma_t": 0.3},
}
# Lobes too narrow for bins, whose means are tested all the same.
NARROW = {"alpha_top": 0.002, "alpha_bottom": 0.02, "eta_top": 1.5, "sigma_t": 0.5}
COSINES = (1.0, 0.6, 0.1)
FALSE_ALARM = 1e-3


def vector(values):
    return LAYERED3.vector(GOLD | values).astype(np.float32)


def view(mu):
    return np.array([np.sqrt(1 - mu * mu), 0, mu], np.float32)


@pytest.fixture(scope="module")
def bridge(compiler, tmp_path_factory):
    library = built(compiler, "layered_bridge.cpp", tmp_path_factory.mktemp("layered"))

    def call(name, inputs, shape):
        """Calls the function for rows of outputs; it wants their number first where there are several."""
        out = np.empty(shape, np.float32)
        count = [ctypes.c_int(shape[0])] if name != "layered_albedo" else []
        arrays = [np.ascontiguousarray(a, np.float32) for a in inputs]
        getattr(library, name)(*count, *map(pointer, (*arrays, out)))
        return out

    return call


def layers_of(values):
    return layered_eval.settle(Layered3().gather([dr.auto.Float(float(x)) for x in vector(values)]))


def vec3(rows):
    return Vec3(*(dr.auto.Float(column) for column in np.ascontiguousarray(np.transpose(rows))))


def test_density_and_samples_are_those_of_the_package(bridge):
    rng = np.random.default_rng(0)
    wo = stacked(random_directions(rng, 4000)).T.astype(np.float32)
    u = rng.random((4000, 3), np.float32)
    for values in (*CASES.values(), NARROW):
        layers = layers_of(values)
        for mu in COSINES:
            wi = view(mu)
            expected = layered_eval.pdf(layers, vec3(wi), vec3(wo)).numpy()
            found = bridge("layered_pdf", (vector(values), wi, wo), (len(wo),))
            np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-6)
            drawn = layered_eval.sample(layers, vec3(wi), *vec3(u))
            expected = np.stack([x.numpy() for x in drawn], axis=-1)
            found = bridge("layered_sample", (vector(values), wi, u), (len(u), 7))
            valid = expected[:, 2] > 0
            # Where lobes meet a rounding chooses another one, and at the horizon whether there is a direction.
            assert (valid == (found[:, 3] > 0)).mean() > 0.998
            assert (np.abs(found[:, :3] - expected).max(axis=1) < 1e-3)[valid].mean() > 0.998


@pytest.mark.slow
def test_samples_follow_the_density(bridge):
    """Chi-square tests; a correct sampler fails one of them with a chance of 1e-3."""
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
    """The directional albedo by both; Z-tests, a false alarm in a thousand."""
    n, limit = 200_000, norm.isf(0.5 * (1 - (1 - FALSE_ALARM) ** (1 / (3 * len(COSINES)))))
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
        assert (np.abs(weights.mean(axis=0) - walks.mean(axis=0)) < limit * error).all()


def test_albedos_have_no_noise_and_are_close_to_those_of_many_walks(bridge):
    """A fixed set of 256 walks, whose error is at most .5 / 16 by standard deviation."""
    for values in (*CASES.values(), NARROW):
        for mu in COSINES:
            about = vector(values), view(mu)
            found = bridge("layered_albedo", about, (3,))
            np.testing.assert_array_equal(found, bridge("layered_albedo", about, (3,)))
            many = bridge("layered_walks", about, (100_000, 3)).mean(axis=0)
            assert np.abs(found - many).max() < 0.1
    white = {"eta_conductor": 0.0, "k_conductor": 1.0, "albedo": 1.0}
    assert bridge("layered_albedo", (vector(CASES["thick"] | white), view(0.5)), (3,)).max() <= 1.0
