"""Fits to sources with exact values: the points at which sources are evaluated, the fits, and the figures of merit."""

import math
from dataclasses import replace

import numpy as np
import pytest
from source_cases import LAMBERT, Formula, direction

from nma import ops
from nma.adapter import Adapter
from nma.adapter.values import AdapterValues
from nma.errors import NmaError, ParamError, SourceError, TableError
from nma.evaluate.pairs import Pairs, compare
from nma.ops import Color, Vec3
from nma.sources.coating import Coating
from nma.sources.mitsuba_bsdf import from_dict
from nma.table import Grid, Tables
from nma.table.values import tabulate_values
from nma.target import Principled, eval_principled
from nma.train import recipe as recipes
from nma.train.fit import fit, recipe_for
from nma.train.points import PointPool

import mitsuba as mi  # isort: skip

SMALL = Grid(4, 5, 6)
PLASTIC = Principled(Color(0.6, 0.3, 0.1), 0.4, 0.0, 1.0, 0.0, 0.2, 0.5, 0.3, 0.8)
QUICK = replace(recipes.MEASURED, network="1x16", rows=64, bins_per_row=32, steps=400, albedo=0.0)
BRUSHED = {"type": "roughconductor", "material": "Au", "distribution": "ggx", "alpha_u": 0.1, "alpha_v": 0.4}


@pytest.fixture(scope="module", autouse=True)
def _variant():
    mi.set_variant("llvm_ad_rgb")


def pool_of(source, **sizes):
    return PointPool.of(source, **({"rows": 512, "points": 256} | sizes))


def test_weighted_points_are_uniform_over_the_hemisphere():
    """For every wi, the weighted mean of a function over the points equals the function's mean over all directions wo.

    The points near peaks are denser than elsewhere, so they have smaller weights. A failure means that fits are biased
    towards some directions.
    """
    pool = pool_of(LAMBERT)
    z, x = pool.wo[2], pool.wo[0]
    for function, expected in ((1.0, 1.0), (z, 0.5), (z * z, 1 / 3), (x, 0.0), (x * x, 1 / 3)):
        rows = (pool.weight * function).mean(axis=1)
        assert abs(rows.mean() - expected) < 0.003
        assert rows.std() < 0.05
    assert ((pool.weight >= 0) & (pool.weight <= 4 / 3 + 1e-5)).all()
    assert (np.sort(pool.mu) * 512 // 1 == np.arange(512)).all()


@pytest.mark.parametrize(("alpha", "albedo"), ((0.002, 1.0), (0.05, 0.99), (0.4, 0.76)))
def test_points_find_narrow_peaks(alpha, albedo):
    """The weighted mean over the points estimates the albedo of a lobe within .02, even if the lobe is narrow.

    The lobes reflect all light that masking does not block.
    """
    source = from_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha})
    pool = pool_of(source, points=512)
    steep = pool.mu > 0.3
    assert abs(pool.albedo[0, steep].mean() - albedo) < 0.02
    assert pool.albedo[0, steep].std() < 0.15


def test_pools_with_one_seed_are_equal_and_hold_the_values_of_the_source():
    one, same, other = (pool_of(LAMBERT, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.wo, same.wo)
    assert (one.mu != other.mu).any()
    np.testing.assert_allclose(one.value[0], np.maximum(0.8 / math.pi * one.wo[2], 0.0), rtol=1e-5)
    batch = one.draw(QUICK, 5)
    np.testing.assert_allclose(batch.value[0], np.maximum(0.8 / math.pi * batch.wo[2], 0.0), rtol=1e-5)
    np.testing.assert_array_equal(batch.value, one.draw(QUICK, 5).value)
    assert batch.wo.shape == (3, 32, 64)


def test_negative_values_are_clamped_to_0_and_infinite_ones_refused():
    negative = Formula(lambda wi, wo: Color(-0.1, 0.2, 0.3) * wo.z)
    assert pool_of(negative).value.min() == 0.0
    broken = Formula(lambda wi, wo: Color.of(ops.sqrt(wi.z - 0.5)), name="broken")
    with pytest.raises(SourceError, match="broken: has values that are not finite, first at cos"):
        pool_of(broken)


@pytest.mark.slow
def test_a_fit_finds_a_principled_brdf():
    """A small network learns a source that its target can represent exactly.

    The fit reaches a log loss below .005 in 400 steps.
    """
    source = Formula(lambda wi, wo: eval_principled(PLASTIC, wi, wo), name="plastic")
    adapter, run = fit(source, QUICK, {"data": "test"})
    found = compare(AdapterValues(adapter), source, Pairs.draw(4000))
    assert found["log_loss"] < 0.005
    assert found["log_loss"] < 0.2 * compare(LAMBERT, source, Pairs.draw(4000))["log_loss"]
    assert adapter.space.name == "measured" and run.step == 400


@pytest.mark.slow
def test_an_anisotropic_fit_learns_azimuths(tmp_path):
    source = from_dict(BRUSHED)
    assert not source.isotropic
    recipe = replace(recipes.ANISOTROPIC, network="1x32", rows=128, bins_per_row=32, steps=600, albedo=0.0)
    adapter, _ = fit(source, recipe, {})
    adapter.save(tmp_path / "brushed.safetensors")
    loaded = AdapterValues(Adapter.load(tmp_path / "brushed.safetensors"))
    assert not loaded.isotropic
    turned = Formula(lambda wi, wo: source.eval(_quarter(wi), _quarter(wo)), isotropic=False)
    pairs = Pairs.draw(4000)
    found = compare(loaded, source, pairs)["log_loss"]
    assert found < 0.02
    assert found < 0.2 * compare(loaded, turned, pairs)["log_loss"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "grid",
    [
        pytest.param(Grid(10, 10, 10), id="isotropic"),
        pytest.param(Grid(8, 8, 16, phi_i=8), id="anisotropic", marks=pytest.mark.slow),
    ],
)
def test_tables_are_fitted_bin_by_bin(grid):
    """A fit to a table of any resolution has less than 30 % of the log loss of a Lambertian BRDF."""
    source = from_dict({**BRUSHED, "alpha_u": 0.4} if not grid.phi_i else BRUSHED)
    tables = tabulate_values(source, grid=grid)
    changes = {"network": "1x32", "rows": 64, "points": 4, "steps": 300, "albedo": 0.0, "finest": 0.01}
    adapter, _ = fit(tables, recipe_for(tables, **changes))
    found = compare(AdapterValues(adapter), source, Pairs.draw(4000))["log_loss"]
    assert found < 0.3 * compare(LAMBERT, source, Pairs.draw(4000))["log_loss"]


def test_a_fit_refuses_a_table_of_several_materials():
    tables = tabulate_values(LAMBERT, grid=SMALL)
    with pytest.raises(TableError, match="a fit is for one material, but the table has 2 materials"):
        fit(Tables.concatenate([tables, tables]))


def _quarter(w):
    """Rotates a direction by 90 degrees about the normal."""
    return Vec3(-w.y, w.x, w.z)


def test_recipes_and_sources_must_agree_on_isotropy():
    with pytest.raises(NmaError, match="BSDF 'roughconductor' is anisotropic; choose a recipe whose target"):
        fit(from_dict(BRUSHED), QUICK, {})
    with pytest.raises(NmaError, match="the table is isotropic; choose a recipe whose target"):
        fit(tabulate_values(LAMBERT, grid=SMALL), recipes.ANISOTROPIC)
    with pytest.raises(
        NmaError, match="formula has values without noise, so the recipe's loss must be 'log'"
    ):
        fit(LAMBERT, replace(QUICK, loss="huber"))
    with pytest.raises(NmaError, match="needs a grid with azimuths of wi"):
        replace(recipes.MEASURED, target="anisotropic")


def test_pairs_are_uniform_and_depend_on_the_seed_alone():
    pairs = Pairs.draw(20_000, seed=1)
    for mu in (pairs.mu_i, pairs.mu_o):
        assert mu.min() >= 0.02 and mu.max() <= 1.0
        assert abs(mu.mean() - 0.51) < 4 * 0.283 / math.sqrt(20_000)
    assert abs(np.corrcoef(pairs.mu_i, pairs.mu_o)[0, 1]) < 0.03
    np.testing.assert_array_equal(pairs.phi_o, Pairs.draw(20_000, seed=1).phi_o)


def test_figures_of_comparisons_equal_closed_forms():
    grey = Formula(lambda wi, wo: Color.of(0.5 * wo.z))
    brighter = Formula(lambda wi, wo: Color.of(0.6 * wo.z))
    pairs = Pairs.draw(20_000)
    found = compare(brighter, grey, pairs)
    mean = np.mean(np.log1p(0.6 * pairs.mu_o) - np.log1p(0.5 * pairs.mu_o))
    assert found["log_loss"] == pytest.approx(mean, rel=1e-4)
    assert found["ae"] == pytest.approx(0.1 * pairs.mu_o.mean(), rel=1e-4)
    assert compare(grey, grey, pairs) == {"log_loss": 0.0, "ae": 0.0, "smape": 0.0}


def test_a_coat_reflects_above_its_metal():
    """The source `Coating` is reciprocal, and absorption makes it darker.

    A coat with a refractive index of 1 is invisible.
    """
    rng = np.random.default_rng(2)
    mu, phi = rng.uniform(0.1, 1.0, (2, 500)), rng.uniform(0.0, 6.28, (2, 500))
    wi, wo = (direction(m, p) for m, p in zip(mu, phi, strict=True))
    clear, dark = Coating(), Coating(absorption=(9.0, 0.0, 0.0))
    there, back = clear.eval(wi, wo).x / wo.z, clear.eval(wo, wi).x / wi.z
    np.testing.assert_allclose(there.numpy(), back.numpy(), rtol=1e-3)
    assert (dark.eval(wi, wo).x.numpy() <= clear.eval(wi, wo).x.numpy() + 1e-6).all()
    np.testing.assert_allclose(dark.eval(wi, wo).y.numpy(), clear.eval(wi, wo).y.numpy(), rtol=1e-6)
    metal = from_dict({"type": "roughconductor", "material": "Au", "distribution": "ggx", "alpha": 0.3})
    thin = Coating(eta=1.0001)
    np.testing.assert_allclose(
        thin.eval(wi, wo).y.numpy(), metal.eval(wi, wo).y.numpy(), rtol=0.01, atol=1e-4
    )


@pytest.mark.parametrize(
    ("wrong", "text"),
    (
        ({"conductor": "Xx"}, "no conductor 'Xx'"),
        ({"alpha": 0.0}, "alpha is 0, allowed is 0.0001 .. 1"),
        ({"eta": 1.0}, "eta must be above 1"),
        ({"absorption": (-1.0, 0.0, 0.0)}, "absorption at least 0"),
    ),
)
def test_coats_out_of_range_are_refused(wrong, text):
    with pytest.raises(ParamError, match=text):
        Coating(**wrong)
