"""Tables from random walks, compared with sources whose f is known, and the files of tables.

A statistical test has the false-alarm rate `FALSE_ALARM`, divided among its comparisons by Sidak's correction. All
seeds are fixed.
"""

import math
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from nma import ops, sources
from nma.errors import ParamError, TableError
from nma.jit import dr
from nma.ops import Vec3
from nma.params import LAYERED3, Param, ParamSpace
from nma.sources.base import Walk
from nma.table import ISOTROPIC, Grid, Tables, stream_keys, tabulate, walks

FALSE_ALARM = 1e-3
SMALL = Grid(4, 5, 6)
ROUGH = {
    "alpha_top": 0.3,
    "alpha_bottom": 0.5,
    "eta_top": 1.5,
    "eta_conductor": (0.2, 0.9, 1.5),
    "k_conductor": (3.0, 2.5, 2.0),
    "albedo": (0.9, 0.5, 0.1),
    "sigma_t": 0.5,
}


class Scatter:
    """A source whose walks end after one scattering event.

    The method `draw` of a subclass returns wo and the factor by which the throughput is multiplied.
    """

    space = ParamSpace("scatter", (Param("rho", "rho", "uniform", 0.0, 1.0, 0.0, 1.0, "its colour", 3),))

    def gather(self, columns):
        return tuple(columns)

    def step(self, params, walk, rng):
        u1, u2 = rng.next_float32(), rng.next_float32()
        wo, factor = self.draw(-Vec3(*walk.direction), u1, u2)
        never = walk.alive & ~walk.alive
        return Walk(tuple(wo), tuple(rho * factor for rho in params), walk.height, walk.inside, never)


class Lambert(Scatter):
    """A source with f = rho / pi. The density of wo is proportional to cos(theta_o)."""

    def draw(self, wi, u1, u2):
        phi, r = 2.0 * math.pi * u1, ops.safe_sqrt(u2)
        return Vec3(r * ops.cos(phi), r * ops.sin(phi), ops.safe_sqrt(1.0 - u2)), 1.0


class Lopsided(Scatter):
    """A source with f cos(theta_o) = rho mu_i mu_o (2 + cos phi_i) (2 + sin phi_o) / (18 pi) and uniform wo."""

    def draw(self, wi, u1, u2):
        phi, r = 2.0 * math.pi * u1, ops.safe_sqrt(1.0 - u2 * u2)
        wo = Vec3(r * ops.cos(phi), r * ops.sin(phi), u2)
        sin_i = ops.maximum(ops.safe_sqrt(1.0 - wi.z * wi.z), 1e-6)
        return wo, wi.z * u2 * (2.0 + wi.x / sin_i) * (2.0 + ops.sin(phi)) * (1.0 / 9.0)


class Retro(Scatter):
    """A retro-reflecting source with f cos(theta_o) = rho mu_i (1 + cos(phi_o - phi_i)) / (4 pi)."""

    def draw(self, wi, u1, u2):
        phi, r = 2.0 * math.pi * u1, ops.safe_sqrt(1.0 - u2 * u2)
        wo = Vec3(r * ops.cos(phi), r * ops.sin(phi), u2)
        sin_i = ops.maximum(ops.safe_sqrt(1.0 - wi.z * wi.z), 1e-6)
        return wo, 0.5 * wi.z * (1.0 + (wi.x * ops.cos(phi) + wi.y * ops.sin(phi)) / sin_i)


def middles(n):
    return (np.arange(n) + 0.5) / n


def assert_table(tables, expected):
    """Tests every bin by a Z-test with the table's own standard error, and all bins together by a chi-square test."""
    z = (tables.values[..., 0].astype(np.float64) - expected) / tables.error[..., 0]
    limit = norm.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / z.size)))
    assert np.abs(z).max() < limit
    total = float(np.sum(z * z))
    assert chi2.cdf(total, z.size) > FALSE_ALARM / 2, "the stated errors are too large"
    assert chi2.sf(total, z.size) > FALSE_ALARM / 2, "the table is biased, or its stated errors are too small"


def scatter_tables(source, grid, walks=1 << 21, rho=(0.8, 0.4, 0.0)):
    return tabulate(source, np.array([rho]), walks, stream_keys(3, [0]), grid=grid)


def test_bins_of_a_lambertian_surface_are_normalised():
    """The value of every bin is the mean of rho / pi cos(theta_o) over the bin (eq. 9 of the paper)."""
    tables = scatter_tables(Lambert(), SMALL)
    expected = np.broadcast_to((0.8 / math.pi * middles(5))[:, None], (1, 4, 5, 6))
    assert_table(tables, expected)
    np.testing.assert_allclose(tables.values[..., 1], 0.5 * tables.values[..., 0], rtol=1e-4)
    assert (tables.values[..., 2] == 0).all()
    assert (tables.error[..., 2] == 0).all()


def test_bins_know_theta_i_and_azimuth():
    """phi is the folded azimuth between wi and wo.

    The first bin of phi contains retro-reflection, and the last bin contains the mirror direction.
    """
    edges = np.linspace(0.0, math.pi, 7)
    azimuth = 1.0 + np.diff(np.sin(edges)) / np.diff(edges)
    expected = 0.8 / (4.0 * math.pi) * middles(4)[:, None, None] * azimuth
    assert_table(scatter_tables(Retro(), SMALL), np.broadcast_to(expected[None], (1, 4, 5, 6)))


def test_bins_of_an_anisotropic_table():
    """The table has bins in all four angles. Azimuths cover the whole circle."""
    grid = Grid(3, 4, 6, phi_i=5)
    edges_i, edges_o = np.linspace(0.0, 2.0 * math.pi, 6), np.linspace(0.0, 2.0 * math.pi, 7)
    phi_i = 2.0 + np.diff(np.sin(edges_i)) / np.diff(edges_i)
    phi_o = 2.0 - np.diff(np.cos(edges_o)) / np.diff(edges_o)
    mu_i, mu_o = middles(3), middles(4)
    expected = 0.8 / (18.0 * math.pi) * np.einsum("i,a,o,b->iaob", mu_i, phi_i, mu_o, phi_o)
    tables = scatter_tables(Lopsided(), grid, 1 << 22)
    assert tables.values.shape == (1, 3, 5, 4, 6, 3)
    assert_table(tables, expected[None])


def test_albedo_is_what_all_bins_reflect():
    tables = scatter_tables(Lambert(), SMALL, 1 << 16, (1.0, 0.25, 0.0))
    np.testing.assert_allclose(tables.albedo(), np.broadcast_to([1.0, 0.25, 0.0], (1, 4, 3)), rtol=1e-6)
    anisotropic = scatter_tables(Lambert(), Grid(3, 4, 6, phi_i=5), 1 << 16, (1.0, 0.25, 0.0))
    np.testing.assert_allclose(
        anisotropic.albedo(), np.broadcast_to([1.0, 0.25, 0.0], (1, 3, 5, 3)), rtol=1e-6
    )


def test_standard_errors_are_the_spread_of_independent_tables():
    """The variance of a bin over 60 seeds equals, on average over the bins, the variance that the tables state."""
    grid, seeds = Grid(5, 5, 5), 60
    params = np.tile(LAYERED3.vector(ROUGH), (seeds, 1))
    tables = tabulate(sources.get("layered3"), params, 50_000, stream_keys(11, range(seeds)), grid=grid)
    values, errors = tables.values.astype(np.float64), tables.error.astype(np.float64)
    assert (values > 0).all()
    ratio = values.var(axis=0, ddof=1) / np.mean(errors**2, axis=0)
    # The channels of a walk are correlated, so test one channel at a time.
    for channel in range(3):
        statistic = (seeds - 1) * ratio[..., channel].sum()
        freedom = (seeds - 1) * ratio[..., channel].size
        assert FALSE_ALARM / 6 < chi2.cdf(statistic, freedom) < 1.0 - FALSE_ALARM / 6


def test_the_folded_table_equals_the_folded_anisotropic_one():
    """The full table, with the azimuths of wi and wo, agrees with the folded table of their difference.

    For a pair of azimuth bins of the full table, the density of azimuth differences is triangular. So the mean of the
    folded table with triangular weights must equal the value of the full table.
    """
    steps, fine = 8, 8
    params, source = LAYERED3.vector(ROUGH)[None], sources.get("layered3")
    full = tabulate(source, params, 1 << 20, stream_keys(1, [0]), grid=Grid(3, 3, steps, phi_i=steps))
    folded = tabulate(source, params, 1 << 21, stream_keys(2, [0]), grid=Grid(3, 3, steps * fine // 2))

    # The mean of the full table over the azimuth of wi, as an array (theta_i, theta_o, d). The index d is the
    # difference between the azimuth bins of wi and wo.
    shifted = [np.roll(full.values[0][:, a], -a, axis=2) for a in range(steps)]
    by_difference = np.mean(shifted, axis=0)[..., 0].astype(np.float64)
    variance = (
        np.sum([np.roll(full.error[0][:, a], -a, axis=2) ** 2 for a in range(steps)], axis=0)[..., 0]
        / steps**2
    )

    # Unfold the folded table to the whole circle. Then average the unfolded table with triangular weights around each
    # difference d.
    circle = np.concatenate([folded.values[0, ..., 0], folded.values[0, ..., ::-1, 0]], axis=2)
    noise = np.concatenate([folded.error[0, ..., 0], folded.error[0, ..., ::-1, 0]], axis=2)
    expected, expected_variance = np.empty_like(by_difference), np.empty_like(by_difference)
    for d in range(steps):
        away = (np.arange(steps * fine) + 0.5) / fine - d
        away = np.abs((away + steps / 2) % steps - steps / 2)
        weights = np.maximum(1.0 - away, 0.0)
        weights /= weights.sum()
        expected[..., d] = circle @ weights
        # The weights of the two halves of the circle are added before they are squared, because the halves contain the
        # same bins with the same errors.
        halves = weights[: steps * fine // 2] + weights[steps * fine // 2 :][::-1]
        expected_variance[..., d] = noise[..., : steps * fine // 2] ** 2 @ halves**2
    z = np.abs(by_difference - expected) / np.sqrt(variance + expected_variance)
    assert z.max() < norm.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / z.size)))


def test_a_table_depends_on_its_own_key_alone(monkeypatch):
    """Other materials in the call, their order, and the division into launches do not change a table."""
    source, count = sources.get("layered3"), 40 * 1000
    params = LAYERED3.sample(np.random.default_rng(4), 5)
    keys = stream_keys(9, range(5))
    together = tabulate(source, params, count, keys)
    alone = [tabulate(source, params[n : n + 1], count, keys[n : n + 1]) for n in range(5)]
    monkeypatch.setattr(walks, "_BINS_PER_LAUNCH", 2 * ISOTROPIC.bins)
    monkeypatch.setattr(walks, "_WALKS_PER_ROW", 317)
    split = tabulate(source, params[::-1], count, keys[::-1])
    for name in ("values", "error"):
        whole = getattr(together, name)
        np.testing.assert_array_equal(whole, np.concatenate([getattr(t, name) for t in alone]))
        np.testing.assert_array_equal(whole, getattr(split, name)[::-1])
    without = tabulate(source, params, count, keys, error=False)
    assert without.error is None
    np.testing.assert_array_equal(without.values, together.values)
    other = tabulate(source, params, count, stream_keys(10, range(5)))
    assert (other.values != together.values).any(axis=(1, 2, 3, 4)).all()


def test_launches_of_an_anisotropic_table_continue_each_other(monkeypatch):
    grid = Grid(3, 4, 4, phi_i=3)
    whole = scatter_tables(Lopsided(), grid, 9 * 500)
    monkeypatch.setattr(walks, "_WALKS_PER_ROW", 61)
    np.testing.assert_array_equal(scatter_tables(Lopsided(), grid, 9 * 500).values, whole.values)


def test_no_bin_overflows():
    """The counts of a table do not overflow if all walks of a row end in the same bin with throughput 1.

    The row has more walks than one launch may count.
    """

    class Up(Scatter):
        def draw(self, wi, u1, u2):
            return Vec3(0.0 * u1, 0.0 * u1, 0.0 * u1 + 1.0), 1.0

    grid = Grid(1, 2, 1)
    tables = scatter_tables(Up(), grid, 3 * 65_535 + 7, (1.0, 1.0, 1.0))
    np.testing.assert_allclose(tables.values[0, 0, :, 0, 0], [0.0, 1.0 / grid.solid_angle], rtol=1e-6)


def test_walks_are_rounded_up_to_equal_rows():
    tables = scatter_tables(Lambert(), SMALL, 101)
    assert tables.walks.tolist() == [104]
    assert ISOTROPIC.walks(819_200) == 819_200


def test_what_cannot_be_tabulated_is_refused():
    params = np.array([[0.5, 0.5, 0.5]])
    with pytest.raises(TableError, match="0 walks"):
        tabulate(Lambert(), params, 0, stream_keys(0, [0]))
    with pytest.raises(TableError, match="2 key"):
        tabulate(Lambert(), params, 40, stream_keys(0, range(2)))
    with pytest.raises(ParamError, match=r"rho is 1\.5, allowed is 0 \.\. 1"):
        tabulate(Lambert(), params + 1.0, 40, stream_keys(0, [0]))


def test_stream_keys_depend_on_seed_and_index():
    keys = stream_keys(5, range(100))
    np.testing.assert_array_equal(keys[[7, 3]], stream_keys(5, [7, 3]))
    assert len(np.unique(np.concatenate([keys, stream_keys(6, range(100))]))) == 200


def test_no_more_memory_than_stated():
    """A call with many materials is divided into launches with a limited number of bins."""
    assert walks._BINS_PER_LAUNCH * 3 * 2 * (4 + 8) <= 2**28


@pytest.fixture
def tables():
    rng = np.random.default_rng(0)
    values = rng.random((2, *SMALL.shape)).astype(np.float32)
    return Tables(LAYERED3.sample(rng, 2), values, np.array([400, 800]), 0.1 * values)


def test_saved_tables_come_back(tables, tmp_path):
    path = tmp_path / "new" / "folder" / "reference.npz"
    tables.save(path)
    back = Tables.load(path)
    assert back.class_name == tables.class_name == "layered3"
    for name in ("params", "values", "walks", "error"):
        np.testing.assert_array_equal(getattr(back, name), getattr(tables, name))
        assert getattr(back, name).dtype == getattr(tables, name).dtype
    assert [p.name for p in path.parent.iterdir()] == ["reference.npz"]
    tables.error = None
    tables.save(path)
    assert Tables.load(path).error is None


def test_one_number_of_walks_and_half_precision_are_enough(tables, tmp_path):
    """A reference file may have one count of walks for all materials, and values in half precision (CONVENTIONS.md).

    Other programs may write reference files in this form.
    """
    path = tmp_path / "theirs.npz"
    np.savez(path, params=tables.params, table=tables.values.astype(np.float16), walks=819_200)
    back = Tables.load(path)
    assert back.walks.tolist() == [819_200, 819_200]
    assert back.values.dtype == np.float16


def _arrays(tables, **changes):
    arrays = {"params": tables.params, "table": tables.values, "walks": tables.walks, "error": tables.error}
    return {k: v for k, v in (arrays | changes).items() if v is not None}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"table": None}, "not a reference file"),
        ({"walks": None}, "not a reference file"),
        ({"params": np.zeros(13)}, r"are not \(n, columns\) and"),
        ({"params": np.zeros((3, 13))}, r"are not \(n, columns\) and"),
        ({"table": np.zeros((2, 4, 5, 6))}, r"are not \(n, columns\) and"),
        ({"table": np.zeros((2, 4, 3))}, r"are not \(n, columns\) and"),
        ({"error": np.zeros((2, 4, 5, 7, 3))}, "error has shape"),
        ({"walks": np.array([1, 2, 3])}, "walks must be"),
        ({"walks": np.array([100, 0])}, "walks must be"),
        ({"walks": np.array(["many", "few"])}, "not numbers"),
        ({"params": np.full((2, 13), np.nan)}, "params of material 0 has values that are not finite"),
        ({"error": np.full((2, 4, 5, 6, 3), np.inf)}, "error of material 0 has values that are not finite"),
        ({"params": np.array([None, {}], object)}, "not a reference file"),
        ({"class": np.array(["layered3"])}, "the entry `class` has type <U8 and shape"),
        ({"class": 3}, "the entry `class` has type int64"),
        (
            {"class": "measured"},
            "params have 13 columns, but class measured has 0 columns; simulate the tables again",
        ),
        ({"params": np.zeros((2, 5))}, "the class is not named, and no classes have 5 columns .*layered3 13"),
    ],
)
def test_a_malformed_reference_file_is_refused(tables, tmp_path, change, message):
    path = tmp_path / "bad.npz"
    np.savez(path, **_arrays(tables, **change))
    with pytest.raises(TableError, match=message) as caught:
        Tables.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_with_nan_names_the_material(tables, tmp_path):
    tables.values[1, 0, 0, 0, 0] = np.nan
    tables.save(tmp_path / "nan.npz")
    with pytest.raises(TableError, match="table of material 1 has values that are not finite"):
        Tables.load(tmp_path / "nan.npz")


def test_a_missing_or_damaged_file_is_refused(tables, tmp_path):
    path = tmp_path / "reference.npz"
    with pytest.raises(TableError, match="no such file; `nma simulate`"):
        Tables.load(path)
    tables.save(path)
    whole = path.read_bytes()
    damaged = {
        "truncated": whole[: len(whole) // 2],
        "flipped": whole[: len(whole) // 2]
        + bytes([whole[len(whole) // 2] ^ 0xFF])
        + whole[len(whole) // 2 + 1 :],
        "empty": b"",
        "text": b"alpha_top = .2\n",
    }
    for what, content in damaged.items():
        path.write_bytes(content)
        with pytest.raises(TableError) as caught:
            Tables.load(path)
        assert str(path) in str(caught.value), what
        assert "\n" not in str(caught.value), what
    with pytest.raises(TableError):
        Tables.load(tmp_path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(TableError):
        Tables.load(tmp_path / "array.npy")


def test_tables_are_joined_with_their_errors(tables):
    joined = Tables.concatenate([tables, tables])
    assert joined.params.shape == (4, 13)
    np.testing.assert_array_equal(joined.error[2:], tables.error)
    with pytest.raises(TableError, match="standard errors"):
        Tables.concatenate([tables, Tables(tables.params, tables.values, tables.walks)])


def test_tables_of_several_classes_are_not_joined(tables):
    with pytest.raises(TableError, match="tables of the classes 'layered3', 'paint' cannot be joined"):
        Tables.concatenate([tables, replace(tables, class_name="paint")])


@pytest.mark.parametrize(("columns", "name"), [(13, "layered3"), (0, "measured"), (32, "library")])
def test_a_file_without_a_class_is_of_the_only_class_with_as_many_columns(tables, tmp_path, columns, name):
    """Earlier versions of the package wrote tables without the name of their class."""
    np.savez(tmp_path / "old.npz", **_arrays(tables, params=np.full((2, columns), 0.3)))
    found = Tables.load(tmp_path / "old.npz")
    assert (found.class_name, found.space) == (name, sources.space(name))


def test_a_class_is_named_where_several_have_as_many_columns(tables, tmp_path, monkeypatch):
    twin = type("Twin", (), {"space": ParamSpace("twin", LAYERED3.params)})
    monkeypatch.setitem(sys.modules, "nma.sources.twin", types.SimpleNamespace(Twin=twin))
    monkeypatch.setitem(sources.CLASSES, "twin", "twin:Twin")
    np.savez(tmp_path / "old.npz", **_arrays(tables))
    with pytest.raises(TableError, match="old.npz: the class is not named, and 2 classes have 13 columns"):
        Tables.load(tmp_path / "old.npz")
    for name in ("layered3", "twin"):
        np.savez(tmp_path / "new.npz", **_arrays(tables), **{"class": name})
        assert Tables.load(tmp_path / "new.npz").space.name == name


def test_tables_of_a_class_that_this_version_lacks_can_be_read(tables, tmp_path):
    replace(tables, class_name="paint").save(tmp_path / "paint.npz")
    found = Tables.load(tmp_path / "paint.npz")
    assert found.class_name == "paint"
    with pytest.raises(TableError, match="there is no class 'paint'"):
        found.space  # noqa: B018


def test_walks_are_counted_on_the_device_that_dr_jit_chose():
    assert dr.backend_v(dr.auto.Float) in (dr.JitBackend.LLVM, dr.JitBackend.CUDA)


def test_some_materials_of_tables_keep_what_belongs_to_them():
    params, values = np.arange(3.0)[:, None], np.arange(6.0).reshape(3, 1, 1, 1, 2)
    whole = Tables(params, values, np.array([5, 6, 7]), values + 1.0, "paint")
    for part in (whole[1:], whole[np.array([1, 2])]):
        assert (part.class_name, part.params.tolist()) == ("paint", [[1.0], [2.0]])
        assert part.walks.tolist() == [6, 7]
        np.testing.assert_array_equal(part.values, values[1:])
        np.testing.assert_array_equal(part.error, values[1:] + 1.0)
    assert Tables(params, values, np.array([5, 6, 7]), class_name="paint")[:1].error is None
