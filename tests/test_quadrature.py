"""Points inside the bins of a table: weighted means of known functions, and of lobes far narrower than a bin.

An estimate is repeated with independent random shifts of its lattice of points. Student's t-test compares the mean of
the estimates with the known value. A test has the false-alarm rate `FALSE_ALARM`, divided among its comparisons by
Sidak's correction. All seeds are fixed.
"""

import math

import numpy as np
import pytest
from scipy import stats

from nma import ops
from nma.jit import dr
from nma.lattice import lattice_points, lattice_steps
from nma.microfacet import ggx_d, smith_g1
from nma.ops import Vec3
from nma.table import Grid, quadrature

FALSE_ALARM = 1e-3
REPEATS = 16
LAST = 39

# Bins (theta_i, theta_o, phi) of every kind: at grazing and normal incidence, at the mirror direction, beside it, and
# far from it.
BINS = np.array(
    [
        (0, 0, 0),
        (0, 0, LAST),
        (0, LAST, 20),
        (LAST, LAST, 0),
        (LAST, LAST, LAST),
        (LAST, 0, LAST),
        (20, 20, LAST),
        (20, 21, LAST),
        (20, 19, 38),
        (20, 20, 38),
        (1, 1, LAST),
        (1, 0, LAST),
        (38, LAST, LAST),
        (5, 30, 10),
        (30, 5, 35),
    ],
    np.float64,
)


def shifted(n, shape, seed):
    """Returns lattices of n points, as an array (3, n, *shape). Each lattice has its own random shift."""
    shift = np.random.default_rng(seed).random((3, 1, *shape))
    lattice = lattice_points(n).T.reshape(3, n, *(1,) * len(shape))
    return (lattice + shift) % 1.0


def crowded(bins, n, seed, repeats=REPEATS):
    """Returns points (n, repeats, bins) from `bin_points`."""
    i, o, p = bins.T
    return quadrature.bin_points(i, o, p, tuple(shifted(n, (repeats, len(bins)), seed)))


def uniform(bins, n, seed, repeats=REPEATS):
    i, o, p = bins.T
    return quadrature.uniform_bin_points(i, o, p, tuple(shifted(n, (repeats, len(bins)), seed)))


def assert_means(estimates, expected):
    """Compares the means of `estimates` (repeats, ...) over the repetitions with `expected` (...) by t-tests."""
    mean, spread = estimates.mean(axis=0), estimates.std(axis=0, ddof=1) / math.sqrt(len(estimates))
    # The standard error has a lower limit, because rounding dominates smaller errors.
    t = np.abs(mean - expected) / np.maximum(spread, 1e-7 * np.abs(expected) + 1e-12)
    limit = stats.t.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / t.size)), len(estimates) - 1)
    worst = np.unravel_index(np.argmax(t), t.shape)
    assert t[worst] < limit, (
        f"{worst}: {mean[worst]} +- {spread[worst]}, expected {np.broadcast_to(expected, t.shape)[worst]}"
    )


def azimuth_away(points):
    """Returns the azimuth between wo and the mirror direction, in 0 .. pi."""
    return np.abs(np.arctan2(points.wo.y, -points.wo.x))


@pytest.mark.parametrize("law", (crowded, uniform))
def test_means_of_smooth_functions_are_exact(law):
    """The points' weights have mean 1, and the weighted means of functions over a bin are those of uniform points.

    The functions are products of the cosines and functions of the azimuth.
    """
    points = law(BINS, 2048, 1)
    i, o, p = BINS.T
    width, step = 1.0 / 40, math.pi / 40
    mu_i, mu_o, psi = (i + 0.5) * width, (o + 0.5) * width, (39.5 - p) * step
    cos_psi = (np.sin(psi + 0.5 * step) - np.sin(psi - 0.5 * step)) / step
    a, b, away = points.wi.z, points.wo.z, azimuth_away(points)
    for function, expected in (
        (1.0, np.ones(len(BINS))),
        (a, mu_i),
        (b, mu_o),
        (a * b, mu_i * mu_o),
        (a * a, mu_i**2 + width**2 / 12),
        ((b - a) ** 2, (mu_o - mu_i) ** 2 + width**2 / 6),
        (away, psi),
        (np.cos(away), cos_psi),
        (a * np.cos(away), mu_i * cos_psi),
    ):
        assert_means((points.weight * function).mean(axis=0), expected)


@pytest.mark.parametrize("dtype", (np.float32, np.float64))
@pytest.mark.parametrize(
    "law", (quadrature.bin_points, quadrature.uniform_bin_points), ids=("crowded", "uniform")
)
def test_points_lie_in_their_bins(law, dtype):
    """In all 64,000 bins, random points and the corners of the unit cube are mapped to points inside the bin."""
    i, o, p = (x.ravel().astype(dtype) for x in np.meshgrid(*[np.arange(40)] * 3, indexing="ij"))
    rng = np.random.default_rng(3)
    below_one = np.nextafter(dtype(1), dtype(0))
    corners = [np.full((3, len(i)), u, dtype) for u in (0.0, below_one)]
    # `bin_points` first draws the difference s of the cosines, and then sets cos(theta_o) = cos(theta_i) + s. If
    # `bin_points` raises cos(theta_i) to the least allowed value 1e-6, cos(theta_o) rises by as much, and may leave its
    # bin by 1e-6.
    slack = 1e-6 + 4 * np.finfo(dtype).eps
    for u in (*corners, rng.random((3, len(i)), dtype), rng.integers(0, 2, (3, len(i))) * below_one):
        points = law(i, o, p, tuple(u.astype(dtype)))
        assert_in_bins(points, i, o, p, slack)
        assert all(x.dtype == dtype for x in (*points.wi, *points.wo, points.weight))


def assert_in_bins(points, i, o, p, slack):
    for mu, k in ((points.wi.z, i), (points.wo.z, o)):
        assert np.isfinite(mu).all()
        assert (mu >= k / 40 - slack).all()
        assert (mu <= (k + 1) / 40 + slack).all()
        assert mu.min() > 0
        assert mu.max() <= 1
    # wi lies at azimuth 0. Azimuths are not compared for a vertical wo, which has no azimuth.
    assert (points.wi.y == 0).all()
    away = azimuth_away(points)
    clear = points.wo.z < 1.0 - 1e-5
    psi_slack = 10 * slack
    assert (away >= (39 - p) * math.pi / 40 - psi_slack)[clear].all()
    assert (away <= (40 - p) * math.pi / 40 + psi_slack)[clear].all()
    for w in (points.wi, points.wo):
        np.testing.assert_allclose(ops.dot(w, w), 1.0, atol=1e-6)
    assert np.isfinite(points.weight).all()
    assert (points.weight >= 0).all()


def lobe(wi, wo, alpha):
    """Returns f cos(theta_o) of a white GGX mirror, in 1/sr (Walter 2007, eq. 20)."""
    m = ops.normalize(wi + wo)
    return ggx_d(m, alpha, alpha) * smith_g1(wi, alpha, alpha) * smith_g1(wo, alpha, alpha) / (4.0 * wi.z)


@pytest.mark.parametrize("name", ("numpy", "drjit"))
def test_single_precision_is_enough_for_the_narrowest_lobe(name):
    """In all bins near the mirror direction, half vectors are precise enough to evaluate a lobe of alpha .001."""
    i, o, p = (x.ravel() for x in np.meshgrid(np.arange(40.0), [-1, 0, 1], [38.0, 39.0], indexing="ij"))
    o = np.clip(i + o, 0, 39)
    u = np.random.default_rng(5).random((3, 50, len(i)), np.float32).astype(np.float64)
    exact = quadrature.bin_points(i, o, p, tuple(u))
    expected = (exact.weight * lobe(exact.wi, exact.wo, 0.001)).ravel()
    i, o, p = (np.broadcast_to(x, u[0].shape) for x in (i, o, p))
    array = (lambda x: x) if name == "numpy" else dr.auto.Float
    bins = [array(np.ascontiguousarray(x, np.float32).ravel()) for x in (i, o, p, *u)]
    points = quadrature.bin_points(*bins[:3], tuple(bins[3:]))
    found = points.weight * lobe(points.wi, points.wo, 0.001)
    found = found if name == "numpy" else found.numpy()
    error = np.abs(found - expected) / expected
    assert np.median(error) < 1e-3
    assert error.max() < 0.1


def graded(n):
    """Nodes and weights of a quadrature on 0 .. 1 whose nodes get denser towards both ends."""
    x, w = np.polynomial.legendre.leggauss(n)
    t = 0.5 * (x + 1.0)
    # The substituted variable is the regularised incomplete beta function I_t(4, 4), which is flat at both ends.
    return t**4 * (35 - 84 * t + 70 * t**2 - 20 * t**3), 0.5 * w * 140 * t**3 * (1 - t) ** 3


def peaked(low, high, scale, n):
    """Nodes and weights of a quadrature on low .. high whose nodes get denser around 0.

    The nodes are scale sinh(t) for the nodes t of a Gauss-Legendre quadrature.
    """
    x, w = np.polynomial.legendre.leggauss(n)
    start, stop = np.arcsinh(low / scale), np.arcsinh(high / scale)
    t = start + 0.5 * (x + 1.0) * (stop - start)
    return scale * np.sinh(t), scale * np.cosh(t) * 0.5 * w * (stop - start)


def mean_at(mu_i, o, p, alpha, n):
    """The mean of the lobe over the bin (o, p) of wo, for one wi, by quadrature."""
    sin_i = math.sqrt(1.0 - mu_i * mu_i)
    s, ws = peaked(o / 40 - mu_i, (o + 1) / 40 - mu_i, 2 * alpha * sin_i, n)
    psi, wp = peaked((39 - p) * math.pi / 40, (40 - p) * math.pi / 40, 2 * alpha * mu_i / sin_i, n)
    mu_o, psi = np.meshgrid(mu_i + s, psi, indexing="ij")
    sin_o = np.sqrt(1.0 - mu_o * mu_o)
    wi = Vec3(np.full_like(mu_o, sin_i), 0.0 * mu_o, np.full_like(mu_o, mu_i))
    value = lobe(wi, Vec3(-sin_o * np.cos(psi), sin_o * np.sin(psi), mu_o), alpha)
    return ws @ value @ wp * 40 * 40 / math.pi


def mean_of_bin(i, o, p, alpha, nodes=80, n=48):
    """The mean of the lobe over the bin (i, o, p), by brute-force quadrature."""
    t, w = graded(nodes)
    return sum(wk * mean_at((i + tk) / 40, o, p, alpha, n) for tk, wk in zip(t, w, strict=True))


LOBE_BINS = ((20, 20, 39), (20, 21, 39), (20, 20, 38), (4, 4, 39), (35, 34, 39))


@pytest.fixture(scope="module")
def lobe_means():
    """The means of a lobe of alpha .001 over the bins `LOBE_BINS`, from 184,320 nodes each."""
    return np.array([mean_of_bin(*bin, 0.001) for bin in LOBE_BINS])


def test_the_quadrature_has_converged(lobe_means):
    """With 1.5 times as many nodes in every dimension, the quadrature gives the same mean to one part in a thousand."""
    assert mean_of_bin(*LOBE_BINS[0], 0.001, 120, 72) == pytest.approx(lobe_means[0], rel=1e-3)


def test_means_of_a_lobe_of_alpha_001_are_exact(lobe_means):
    points = crowded(np.array(LOBE_BINS, np.float64), 1 << 13, 6)
    estimates = (points.weight * lobe(points.wi, points.wo, 0.001)).mean(axis=0)
    assert_means(estimates / lobe_means, 1.0)
    # The estimates must also be precise, because a comparison of imprecise means would not detect errors.
    assert (estimates.std(axis=0, ddof=1) / math.sqrt(REPEATS) < 0.01 * lobe_means).all()


def test_a_few_crowded_points_see_what_uniform_points_miss(lobe_means):
    """With 20 points, estimates of the mirror bin's mean vary far more for uniform points than for `bin_points`."""
    mirror = np.array(LOBE_BINS[:1], np.float64)
    spread = []
    for law in (crowded, uniform):
        points = law(mirror, 20, 7, 500)
        spread.append(
            np.std((points.weight * lobe(points.wi, points.wo, 0.001)).mean(axis=0)) / lobe_means[0]
        )
    assert spread[0] < 1.0
    assert spread[1] > 3 * spread[0]


def test_other_grids_work_too():
    grid = Grid(8, 8, 5)
    bins = np.array([(0, 0, 4), (7, 7, 4), (3, 5, 0)], np.float64)
    i, o, p = bins.T
    for law in (quadrature.bin_points, quadrature.uniform_bin_points):
        points = law(i, o, p, tuple(shifted(2048, (REPEATS, 3), 9)), grid)
        for function, expected in (
            (1.0, np.ones(3)),
            (points.wi.z, (i + 0.5) / 8),
            (points.wo.z, (o + 0.5) / 8),
            (azimuth_away(points), (4.5 - p) * math.pi / 5),
        ):
            assert_means((points.weight * function).mean(axis=0), expected)


@pytest.mark.parametrize("dimensions", [2, 3, 4])
def test_the_steps_of_a_lattice_are_powers_of_the_inverse_of_its_root(dimensions):
    """The root x satisfies x^(d+1) = x + 1 (Roberts 2018)."""
    steps = lattice_steps(dimensions)
    root = 1.0 / steps[0]
    assert root ** (dimensions + 1) == pytest.approx(root + 1.0, rel=1e-14)
    assert steps == pytest.approx([root**-k for k in range(1, dimensions + 1)], rel=1e-14)


def test_lattice_points_are_well_spread():
    """Each of 512 cells of the unit cube has about an equal share of 4096 points."""
    points = lattice_points(4096)
    assert points.shape == (4096, 3)
    cells = np.bincount((points * 8).astype(int) @ [64, 8, 1], minlength=512)
    assert cells.min() >= 4
    assert cells.max() <= 12
