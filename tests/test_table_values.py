"""Tables of sources that can be evaluated, compared with closed forms and quadratures, and tables used as sources."""

import math

import numpy as np
import pytest
from source_cases import LAMBERT, Formula, lanes, numbers, pairs
from test_quadrature import LOBE_BINS, assert_means, lobe, mean_of_bin

from nma import ops
from nma.errors import TableError
from nma.evaluate import metrics
from nma.lattice import lattice_points
from nma.ops import Color, Vec3
from nma.sources.merl import Merl
from nma.sources.mitsuba_bsdf import from_dict
from nma.table import ISOTROPIC, Grid, Tables, quadrature, values
from nma.table.values import TableValues, tabulate_values

import mitsuba as mi  # isort: skip

SMALL = Grid(4, 5, 6)
ANISOTROPIC = Grid(3, 4, 6, phi_i=5)


@pytest.fixture(scope="module", autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


def middles(n):
    return (np.arange(n) + 0.5) / n


def ggx(alpha):
    """Mitsuba's rough conductor without absorption."""
    return from_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha})


def lopsided(wi, wo):
    """Returns a test function f cos(theta_o) = mu_i mu_o (2 + cos phi_i) (2 + sin phi_o) / (18 pi)."""
    sin_i, sin_o = (ops.maximum(ops.safe_sqrt(1.0 - w.z * w.z), 1e-6) for w in (wi, wo))
    return Color.of(wi.z * wo.z * (2.0 + wi.x / sin_i) * (2.0 + wo.y / sin_o) * (1.0 / (18.0 * math.pi)))


@pytest.mark.parametrize("grid", (ISOTROPIC, SMALL, ANISOTROPIC), ids=("paper", "small", "anisotropic"))
def test_bins_of_a_lambertian_surface_hold_their_means(grid):
    tables = tabulate_values(LAMBERT, grid=grid)
    assert tables.values.shape == (1, *grid.shape) == tables.error.shape
    assert tables.params.shape == (1, 0)
    expected = np.broadcast_to(0.8 / math.pi * middles(grid.theta_o)[:, None], grid.shape[:-1])
    assert_close(tables, expected[..., None] * [1.0, 0.5, 0.0], grid)
    np.testing.assert_allclose(tables.values[..., 1], 0.5 * tables.values[..., 0], rtol=1e-5)
    assert (tables.values[..., 2] == 0).all() and (tables.error[..., 2] == 0).all()
    np.testing.assert_allclose(tables.albedo()[0, ..., 0], 0.8, rtol=5e-3)


def assert_close(tables, expected, grid):
    """Asserts that the bins of a table hold the means of a linear function.

    Bins near the mirror direction must be within their stated errors. Bins away from the mirror direction must be
    almost exact, because their points are evenly spread.
    """
    near = values._near_mirror(np.arange(grid.bins), grid).reshape(grid.shape[:-1])
    found, error = tables.values[0], tables.error[0]
    np.testing.assert_allclose(found[~near], expected[~near], rtol=2e-4)
    assert_as_stated(found[near], expected[near], error[near])


def assert_as_stated(found, expected, error):
    """Asserts that deviations are small and that their variance is less than twice the stated variance."""
    deviation = (found - expected).astype(np.float64)
    assert np.sum(deviation**2) < 2.0 * np.sum(error.astype(np.float64) ** 2)
    assert np.abs(deviation).sum() < 0.015 * expected.sum()


def test_bins_know_theta_i_and_azimuth():
    """phi is the folded azimuth between wi and wo.

    The first bin of phi contains retro-reflection, and the last bin contains the mirror direction.
    """

    def retro(wi, wo):
        sines = ops.maximum(ops.safe_sqrt(1.0 - wi.z * wi.z) * ops.safe_sqrt(1.0 - wo.z * wo.z), 1e-6)
        return Color.of(wi.z * (1.0 + (wi.x * wo.x + wi.y * wo.y) / sines))

    edges = np.linspace(0.0, math.pi, 7)
    azimuth = 1.0 + np.diff(np.sin(edges)) / np.diff(edges)
    expected = np.broadcast_to(middles(4)[:, None, None] * azimuth, (4, 5, 6))
    found = tabulate_values(Formula(retro), grid=SMALL, points=1024).values[0, ..., 0]
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=1e-3)


def test_bins_of_an_anisotropic_table():
    """The table has bins in all four angles. Azimuths cover the whole circle."""
    edges_i, edges_o = np.linspace(0.0, 2.0 * math.pi, 6), np.linspace(0.0, 2.0 * math.pi, 7)
    phi_i = 2.0 + np.diff(np.sin(edges_i)) / np.diff(edges_i)
    phi_o = 2.0 - np.diff(np.cos(edges_o)) / np.diff(edges_o)
    expected = np.einsum("i,a,o,b->iaob", middles(3), phi_i, middles(4), phi_o) / (18.0 * math.pi)
    tables = tabulate_values(Formula(lopsided, isotropic=False), grid=ANISOTROPIC, points=256)
    assert_as_stated(tables.values[0, ..., 0], expected, tables.error[0, ..., 0])


def test_a_folded_bin_is_the_mean_of_both_mirror_halves():
    """An isotropic material may have different values for a pair of directions and its mirror image."""
    handed = Formula(
        lambda wi, wo: Color.of(wo.z * (1.0 + 0.9 * ops.select(wi.x * wo.y > wi.y * wo.x, 1.0, -1.0)))
    )
    expected = np.broadcast_to(middles(5)[:, None, None], SMALL.shape)
    assert_close(tabulate_values(handed, grid=SMALL), expected, SMALL)


@pytest.mark.parametrize("alpha", (0.001, 0.1))
def test_peaks_of_a_rough_conductor_are_those_of_the_quadrature(alpha):
    """The means of Mitsuba's conductor over our points equal brute-force quadrature, for a narrow and a wide lobe.

    The narrow lobe is thirty times narrower than a bin.
    """
    tables = tabulate_values(ggx(alpha), points=64)
    expected = np.array([mean_of_bin(*bin, alpha) for bin in LOBE_BINS])
    found = np.array([tables.values[0][bin][0] for bin in LOBE_BINS])
    np.testing.assert_allclose(found, expected, rtol=0.03)
    error = np.array([tables.error[0][bin][0] for bin in LOBE_BINS])
    # The limit is 13 standard errors. Student's t with three degrees of freedom exceeds 13 once in a thousand cases.
    assert (np.abs(found - expected) < 13 * error + 2e-3 * expected).all()


def test_a_narrow_lobe_of_an_anisotropic_table_folds_to_the_isotropic_one():
    """For each pair of elevations, the anisotropic and the isotropic table have the same mean over all azimuths."""
    full = tabulate_values(ggx(0.01), grid=Grid(6, 6, 12, phi_i=12)).values[0, ..., 0]
    folded = tabulate_values(ggx(0.01), grid=Grid(6, 6, 12)).values[0, ..., 0]
    np.testing.assert_allclose(full.mean(axis=(1, 3)), folded.mean(axis=-1), rtol=0.02)
    # The anisotropic table is the same for every azimuth of wi, because the material is isotropic.
    shifted = np.array([np.roll(full[:, a], -a, axis=-1) for a in range(12)])
    assert np.mean(shifted.std(axis=0)) < 0.02 * np.mean(shifted)


def test_stated_errors_are_the_spread_of_the_means():
    """The errors of a table are about as large as the standard errors that the table states.

    The error of a bin is its difference from the same bin of a table with 16 times as many points.
    """
    source = ggx(0.2)
    tables, better = (tabulate_values(source, grid=Grid(10, 10, 10), points=n) for n in (64, 1024))
    deviation = (tables.values - better.values).astype(np.float64)[..., 0]
    stated = tables.error.astype(np.float64)[..., 0]
    assert 0.5 < np.sum(deviation**2) / np.sum(stated**2) < 2.0
    assert 0.5 < np.median(np.abs(deviation)) / np.median(stated) < 1.2
    # The field `walks` of a table from quadrature is the count of random walks that would give a similar accuracy. With
    # this count of walks, about half of the bins would have a larger error than the table states.
    counting = metrics.counting_error(
        tables.values[0], int(tables.walks[0]), Grid(10, 10, 10).solid_angle, 10
    )
    assert 0.4 < (counting[..., 0] > tables.error[0, ..., 0]).mean() < 0.6


def test_equal_arguments_give_equal_tables_however_they_are_launched(monkeypatch):
    one = tabulate_values(ggx(0.1), grid=SMALL)
    monkeypatch.setattr(values, "_BINS_PER_LAUNCH", 17)
    other = tabulate_values(ggx(0.1), grid=SMALL)
    np.testing.assert_array_equal(one.values, other.values)
    np.testing.assert_array_equal(one.error, other.error)
    assert one.walks == other.walks


def test_tables_of_sources_are_reference_files(tmp_path):
    tables = tabulate_values(LAMBERT, grid=SMALL)
    tables.save(tmp_path / "lambert.npz")
    back = Tables.load(tmp_path / "lambert.npz")
    for name in ("params", "values", "walks", "error"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tables, name))
    assert metrics.noise_floor(back.values, back.error) < 1e-3


def test_a_black_source_has_no_noise():
    tables = tabulate_values(Formula(lambda wi, wo: Color.of(0.0 * wo.z)), grid=SMALL)
    assert (tables.values == 0).all() and (tables.error == 0).all()
    assert tables.walks == 1 << 40


def test_what_cannot_be_tabulated_is_refused():
    brushed = Formula(lopsided, isotropic=False, name="brushed")
    with pytest.raises(TableError, match="brushed is anisotropic, but the grid is isotropic"):
        tabulate_values(brushed)
    for points in (0, 2, 20):
        with pytest.raises(TableError, match=f"{points} point.* multiple of 16"):
            tabulate_values(LAMBERT, points=points)
    broken = Formula(lambda wi, wo: Color.of(wo.z / ops.select(wo.z > 0.5, 0.0 * wo.z, 1.0)), name="broken")
    with pytest.raises(TableError, match=r"broken: has values that are not finite, first in bin \(0, 2, 0\)"):
        tabulate_values(broken, grid=SMALL)


def random_tables(grid, seed=0):
    values = np.random.default_rng(seed).random((2, *grid.shape)).astype(np.float32)
    return Tables(np.zeros((2, 0)), values, np.array([1, 1]))


@pytest.mark.parametrize("grid", (SMALL, ANISOTROPIC, ISOTROPIC), ids=("small", "anisotropic", "paper"))
def test_a_table_as_a_source_gives_the_table_again(grid):
    tables = random_tables(grid)
    source = TableValues(tables, 1)
    assert source.isotropic == (grid.phi_i == 0)
    np.testing.assert_allclose(tabulate_values(source, grid=grid).values[0], tables.values[1], rtol=5e-4)


def test_a_table_as_a_source_knows_its_bins():
    """A pair of directions gets the value of its bin.

    The value depends neither on the azimuth of wi nor on the sign of the azimuth difference.
    """
    tables = random_tables(SMALL)
    wi, wo = pairs(2000)
    found = numbers(TableValues(tables).eval(wi, wo))
    w = [np.stack([c.numpy() for c in v]).astype(np.float64) for v in (wi, wo)]
    phi = np.abs(np.angle(np.exp(1j * (np.arctan2(w[1][1], w[1][0]) - np.arctan2(w[0][1], w[0][0])))))
    clear = np.abs(phi * 6 / math.pi - np.round(phi * 6 / math.pi)) > 1e-3
    bins = (w[0][2] * 4).astype(int), (w[1][2] * 5).astype(int), np.minimum(phi * 6 / math.pi, 5).astype(int)
    np.testing.assert_array_equal(found[clear], tables.values[0][bins][clear])
    for pair in ((wi, -wo), (-wi, wo)):
        assert (numbers(TableValues(tables).eval(*pair)) == 0).all()
    up = Vec3(*lanes(np.zeros(1), np.zeros(1), np.ones(1)))
    assert numbers(TableValues(tables).eval(up, up))[0, 0] in tables.values[0, -1, -1, :, 0]


@pytest.mark.parametrize(
    "grid", (Grid(20, 20, 20), Grid(12, 12, 24, phi_i=24)), ids=("isotropic", "anisotropic")
)
def test_a_smooth_table_has_no_steps(grid):
    """A smooth table reproduces a linear function of the cosines, except in the outer halves of the outermost bins."""
    tables = tabulate_values(Formula(lambda wi, wo: Color.of(wi.z * 0.5 + wo.z)), grid=grid)
    rough, smooth = TableValues(tables), TableValues(tables, smooth=True)
    wi, wo = pairs(5000)
    expected = 0.5 * wi.z.numpy() + wo.z.numpy()
    inner = np.all([(w.z.numpy() > 0.05) & (w.z.numpy() < 0.95) for w in (wi, wo)], axis=0)
    errors = [np.abs(numbers(s.eval(wi, wo))[:, 0] - expected)[inner].mean() for s in (rough, smooth)]
    assert errors[1] < 2e-3 < 8e-3 < errors[0]


@pytest.mark.parametrize("smooth", (False, True))
def test_lanes_with_derivatives_look_up_the_same_numbers(smooth):
    """A table can be evaluated with Mitsuba's own array types, as inside a BSDF."""
    source = TableValues(random_tables(SMALL), smooth=smooth)
    wi, wo = pairs(100)
    there = source.eval(Vec3(*map(mi.Float, wi)), Vec3(*map(mi.Float, wo)))
    assert [type(c) for c in there] == [mi.Float] * 3
    np.testing.assert_array_equal(numbers(there), numbers(source.eval(wi, wo)))


def test_a_material_that_a_table_does_not_have_is_refused():
    with pytest.raises(TableError, match="mine: no material 2 among its 2"):
        TableValues(random_tables(SMALL), 2, name="mine")


@pytest.mark.slow
def test_a_material_survives_a_merl_file():
    """A BSDF that is stored as a MERL file, with the format's limited resolution, has almost the same table."""
    direct, through = (tabulate_values(source, points=64) for source in (ggx(0.1), Merl.of(ggx(0.1))))
    figures = metrics.table_metrics(through.values[0], direct.values[0], direct.error[0])
    assert figures["log_loss"] < 3e-4
    assert figures["albedo_error"] < 5e-3


# Bins (theta_i, phi_i, theta_o, phi_o) of an anisotropic grid: at the mirror direction, beside it, far from it, and
# where the azimuth wraps around.
FOUR = np.array(
    [(3, 2, 3, 8), (3, 2, 3, 7), (0, 11, 1, 5), (5, 0, 5, 6), (5, 0, 0, 0), (2, 11, 4, 0)], np.float64
)


@pytest.mark.parametrize("crowded", (True, False))
def test_points_of_anisotropic_bins_have_no_preference(crowded):
    """The points' weights have mean 1, and the weighted means of functions over a bin are those of uniform points.

    The functions depend on the cosines and azimuths of wi and wo.
    """
    grid = Grid(6, 8, 12, phi_i=10)
    bins = np.minimum(FOUR, [5, 9, 7, 11])
    i, a, o, b = bins.T
    shift = np.random.default_rng(8).random((4, 1, 16, len(bins)))
    u = (lattice_points(2048, 4).T.reshape(4, 2048, 1, 1) + shift) % 1.0
    points = quadrature.points((i, a, o, b), u, grid, quadrature.FINEST if crowded else None)
    mu_i, mu_o, phi_i, phi_o = (i + 0.5) / 6, (o + 0.5) / 8, (a + 0.5) * math.pi / 5, (b + 0.5) * math.pi / 6
    at_i, at_o = ((np.arctan2(w.y, w.x) % (2 * math.pi)) for w in (points.wi, points.wo))
    for k, (found, middle, half) in enumerate(((at_i, phi_i, math.pi / 10), (at_o, phi_o, math.pi / 12))):
        away = np.angle(np.exp(1j * (found - middle)))
        assert (np.abs(away) < half + 1e-6).all(), k
    for function, expected in (
        (1.0, np.ones(len(bins))),
        (points.wi.z, mu_i),
        (points.wo.z, mu_o),
        (points.wi.z * points.wo.z, mu_i * mu_o),
        (np.cos(at_i), np.cos(phi_i) * math.sin(math.pi / 10) / (math.pi / 10)),
        (np.sin(at_o), np.sin(phi_o) * math.sin(math.pi / 12) / (math.pi / 12)),
    ):
        assert_means((points.weight * function).mean(axis=0), expected)


def test_crowded_points_of_anisotropic_bins_have_the_mean_of_even_ones():
    """Over two mirror bins, points near the mirror direction give the same mean of a lobe as more uniform points."""
    grid, bins = Grid(6, 6, 12, phi_i=12), FOUR[[0, 3]]
    i, a, o, b = bins.T
    means = []
    for law, n in (
        (quadrature.anisotropic_bin_points, 1 << 15),
        (quadrature.uniform_anisotropic_bin_points, 1 << 19),
    ):
        points = law(i, a, o, b, tuple(lattice_points(n, 4).T[..., None]), grid)
        means.append((points.weight * lobe(points.wi, points.wo, 0.05)).mean(axis=0))
    np.testing.assert_allclose(means[0], means[1], rtol=0.03)
