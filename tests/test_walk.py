"""The random walk of the layered source, compared with results that are known without random walks.

Statistical tests compare the mean of walks with the known value by a Z-test. A test has the false-alarm rate
`FALSE_ALARM`, divided among its comparisons by Sidak's correction. Seeds are fixed, so that a test that passes once
always passes.
"""

import numpy as np
import pytest
from scipy.special import exp1, expn
from scipy.stats import norm

from nma.jit import dr
from nma.ops import Vec3
from nma.params import LAYERED3
from nma.sources.base import walk
from nma.sources.layered import Layered3

Float, PCG32 = dr.auto.Float, dr.auto.PCG32
FALSE_ALARM = 1e-3
WALKS = 1 << 18

# WHITE is a conductor that reflects all light, NO_COAT is a coat without effect, and BLACK is a conductor that reflects
# no light.
WHITE = {"eta_conductor": 0.0, "k_conductor": 1.0}
NO_COAT = {"eta_top": 1.0, "alpha_top": 1e-4}
BLACK = {"eta_conductor": 1.0, "k_conductor": 0.0, "alpha_bottom": 1e-4}
# With a roughness of 1e-7, surfaces are flat in single precision.
FLAT = {"alpha_top": 1e-7, "alpha_bottom": 1e-7}


def lanes(value, n):
    """Returns an array of n equal values that is opaque to the compiler, so that all materials share one kernel."""
    return dr.opaque(Float, float(value)) + dr.zeros(Float, n)


def albedo(mu, n=WALKS, seed=1, **values):
    """Returns the mean throughput (3,) of n walks from cos(theta_i) = mu, and its standard error (3,)."""
    source = Layered3()
    columns = [lanes(c, n) for c in LAYERED3.vector({"albedo": 1.0, "sigma_t": 0.0, **values})]
    wi = Vec3(lanes(np.sqrt(1.0 - mu * mu), n), dr.zeros(Float, n), lanes(mu, n))
    wo, throughput = walk(source, source.gather(columns), wi, PCG32(n, seed))
    t = np.array([c.numpy() for c in throughput], np.float64)
    assert (wo.z.numpy()[t.max(axis=0) > 0] > 0).all()
    return t.mean(axis=1), t.std(axis=1) / np.sqrt(n)


def assert_equal_means(found, error, expected):
    """Compares estimates `found`, which have the standard errors `error`, with `expected` by two-sided Z-tests."""
    found, error, expected = np.broadcast_arrays(found, error, expected)
    z = np.abs(found - expected) / np.maximum(error, 1e-6)
    limit = norm.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / z.size)))
    assert z.max() < limit, f"z {z.max():.1f} beyond {limit:.1f}: {found} +- {error}, expected {expected}"


@pytest.mark.parametrize("eta_top", (1.05, 1.5, 2.0))
@pytest.mark.parametrize("sigma_t", (0.0, 1.0, 3.0))
def test_white_furnace_loses_nothing(eta_top, sigma_t):
    """If nothing absorbs light, the albedo is 1, even if walks are long.

    Russian roulette must not end walks, except for walks that are trapped.
    """
    results = [
        albedo(mu, 1 << 16, eta_top=eta_top, sigma_t=sigma_t, **WHITE, **FLAT) for mu in (1.0, 0.3, 0.05)
    ]
    assert_equal_means(*map(np.array, zip(*results, strict=True)), 1.0)


def test_perfect_mirror_under_smooth_coat_ends():
    """Walks that enter a smooth coat over a perfect mirror at a grazing angle end, and lose no light.

    A rarely sampled microfacet of the mirror may reflect a walk at more than the coat's critical angle. The coat then
    reflects the walk back, but the walk must still leave the coat or end.
    """
    found, _ = albedo(0.001, 1 << 15, eta_top=2.0, **WHITE, **FLAT)
    np.testing.assert_allclose(found, 1.0, atol=0.01)


def test_bare_rough_conductor():
    """For single scattering on a white conductor at normal incidence, quadrature gives the albedo.

    For alpha 1, the albedo is 1 - ln 2.
    """
    known = {0.1: 0.98830, 0.3: 0.87736, 0.6: 0.59152, 1.0: 1.0 - np.log(2.0)}
    found, error = zip(*(albedo(1.0, alpha_bottom=a, **NO_COAT, **WHITE) for a in known), strict=True)
    # The known albedos have five digits, so that half of the last digit is added to the error.
    assert_equal_means(found, np.array(error) + 0.5e-5 / 3.3, np.array(list(known.values()))[:, None])


def fresnel_dielectric(cos_i, eta):
    cos_t = np.sqrt(1.0 - (1.0 - cos_i**2) / eta**2)
    r_s = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    r_p = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    return 0.5 * (r_s**2 + r_p**2), cos_t


def fresnel_conductor(cos_i, index):
    """The reflectance of a conductor, in complex arithmetic; the package uses real arithmetic."""
    cos_t = np.sqrt(1.0 - (1.0 - cos_i**2) / index**2 + 0j)
    r_s = (cos_i - index * cos_t) / (cos_i + index * cos_t)
    r_p = (index * cos_i - cos_t) / (index * cos_i + cos_t)
    return 0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2)


@pytest.mark.parametrize("eta_top", (1.05, 1.5, 2.0))
def test_smooth_interfaces_without_medium(eta_top):
    """Reflections between coat and conductor form a geometric series.

    The conductor's index of refraction is relative to the coat's.
    """
    eta, k = np.array([0.2, 1.4, 7.5]), np.array([3.9, 0.0, 2.3])
    results = []
    for mu in (1.0, 0.7, 0.2, 0.02):
        coat, cos_t = fresnel_dielectric(mu, eta_top)
        metal = fresnel_conductor(cos_t, (eta + 1j * k) / eta_top)
        expected = coat + (1.0 - coat) ** 2 * metal / (1.0 - metal * coat)
        results.append((*albedo(mu, eta_top=eta_top, eta_conductor=eta, k_conductor=k, **FLAT), expected))
    assert_equal_means(*map(np.array, zip(*results, strict=True)))


def slab_albedo(mu, depth, rho, n=300):
    """Returns the reflectance (mus, rhos) of an isotropically scattering slab over a black surface.

    The density C of collisions solves C(x) = exp(-x / mu) / mu + rho/2 int E1(|x - y|) C(y) dy. The reflectance is
    rho/2 int E2(x) C(x) dx (Chandrasekhar 1960, sections 11 and 58). E1 and E2 are exponential integrals. The integrals
    over x and y use the midpoint rule, and the singularity of E1 is integrated in closed form.
    """
    x = (np.arange(n) + 0.5) * depth / n
    kernel = (
        exp1(np.maximum(np.arange(n), 1) * depth / n)[np.abs(np.subtract.outer(range(n), range(n)))]
        * depth
        / n
    )
    np.fill_diagonal(kernel, 0.0)
    kernel += np.diag(2.0 - expn(2, x) - expn(2, depth - x) - kernel.sum(axis=1))
    first = np.exp(-x[:, None] / mu) / mu
    return np.transpose(
        [
            0.5 * r * (expn(2, x) @ np.linalg.solve(np.eye(n) - 0.5 * r * kernel, first)) * depth / n
            for r in rho
        ]
    )


def test_slab_albedo_itself():
    assert slab_albedo(np.array([1.0]), 1.0, [1.0])[0, 0] == pytest.approx(0.34133, abs=1e-5)


def test_isotropic_slab_over_black():
    """Walks in the medium alone, without a coat and a reflecting conductor, have the albedo of `slab_albedo`.

    The three colour channels of the medium have different single-scattering albedos.
    """
    rho, mus = np.array([1.0, 0.9, 0.3]), np.array([1.0, 0.4, 0.1])
    for depth in (0.1, 1.0, 3.0):
        slab = {"sigma_t": depth, "albedo": rho, **NO_COAT, **BLACK}
        found, error = zip(*(albedo(mu, **slab) for mu in mus), strict=True)
        assert_equal_means(np.array(found), np.array(error), slab_albedo(mus, depth, rho))


def test_rough_coat_over_white_conductor():
    """The albedo of a rough coat over a white conductor at cos(theta_i) = .9 is .556, to three digits.

    This rough coat over a conductor is a hard case. In pbrt-v4 (its function `f`) and in the code published with Guo,
    Hasan and Zhao 2018 (its bidirectional evaluation), evaluation and random walks give different albedos.
    """
    found, error = albedo(0.9, 1 << 20, eta_top=1.5, alpha_top=0.2, alpha_bottom=0.4, **WHITE)
    assert_equal_means(found, error + 0.5e-3 / 3.3, 0.556)


def test_inactive_lanes_do_not_walk():
    source = Layered3()
    values = {"eta_top": 1.5, "albedo": 1.0, "sigma_t": 3.0, **WHITE, **FLAT}
    columns = [dr.full(Float, c, 4) for c in LAYERED3.vector(values)]
    wi = Vec3(dr.full(Float, 0.6, 4), dr.zeros(Float, 4), dr.full(Float, 0.8, 4))
    active = dr.arange(dr.auto.UInt32, 4) < 2
    _, throughput = walk(source, source.gather(columns), wi, PCG32(4, 1), active)
    np.testing.assert_allclose(throughput.x.numpy(), [1.0, 1.0, 0.0, 0.0], atol=0.1)
