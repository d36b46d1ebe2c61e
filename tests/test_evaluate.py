"""Evaluation: figures of merit follow their formulas, and tables of adapters agree with a much finer integration."""

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm

from nma import target
from nma.adapter import Adapter
from nma.errors import ParamError, TableError
from nma.evaluate import adapters, metrics, tabulate_adapter
from nma.evaluate.metrics import counting_error, noise_floor, table_metrics
from nma.jit import dr
from nma.lattice import lattice_points
from nma.ops import Color, Vec3
from nma.params import LAYERED3
from nma.table import ISOTROPIC, Tables, quadrature
from nma.target import PRINCIPLED_PARAMS, Blend, Principled

FALSE_ALARM = 1e-3
METAL = Principled(Color(0.9, 0.7, 0.4), 0.1, 1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5)
PAINT = Principled(Color(0.6, 0.3, 0.1), 0.7, 0.0, 0.8, 0.0, 0.3, 0.5, 1.0, 1.0)
PARAMS = LAYERED3.sample(np.random.default_rng(0), 3)


def width(alpha):
    return METAL._replace(roughness=math.sqrt(alpha))


BLENDS = {
    "alpha .001": Blend((width(0.001),), (1.0,)),
    "alpha .01": Blend((width(0.01),), (1.0,)),
    "alpha .1": Blend((width(0.1),), (1.0,)),
    "coats of .001 over paint": Blend((width(0.001), PAINT), (0.3, 0.7)),
}


def constant(blend, slope=0.0):
    """Returns an adapter whose target is `blend` at every direction.

    If `slope` is not 0, the raw outputs of the network also change linearly with cos(theta_i).
    """
    raw = np.array(target.encode(blend), np.float32)
    change = slope * np.random.default_rng(1).standard_normal(len(raw)).astype(np.float32)
    return Adapter(
        LAYERED3, "direction", [(change[:, None], raw)], len(blend.instances), slope != 0.0, PRINCIPLED_PARAMS
    )


@pytest.fixture
def coarse(monkeypatch):
    """Makes evaluations integrate over few directions, for tests that do not depend on exact values."""
    monkeypatch.setattr(adapters, "_DIRECTIONS", 4)


@cache
def halves(name, slope):
    """Returns two tables of an adapter with different integration points, as an evaluation computes them."""
    adapter = constant(BLENDS[name], slope)
    return [tabulate_adapter(adapter, PARAMS[:1], shift=s)[0] for s in (0.0, 0.5)]


def fine_means(adapter, bins, points=1 << 11, repeats=6):
    """Returns the adapter's mean value in each of `bins` (n, 3), and the standard errors of the means, both (n, 3).

    Each mean is over many points, which concentrate near peaks. The adapter's BRDF is computed for the wi of every
    point.
    """
    Float = dr.auto.Float
    means = []
    for repeat in range(repeats):
        shift = np.random.default_rng(repeat).random((3, 1, len(bins)))
        u = (lattice_points(points).T[:, :, None] + shift) % 1.0
        i, o, p = (Float(np.broadcast_to(x, u[0].shape).ravel().astype(np.float32)) for x in bins.T)
        found = quadrature.bin_points(i, o, p, tuple(Float(x.ravel().astype(np.float32)) for x in u))
        brdf = adapter.prepare([Float(0.5)] * 13, found.wi)
        value = brdf.eval(found.wi, found.wo) * found.weight
        dr.eval(*value)
        means.append(np.stack([c.numpy().reshape(points, -1).mean(axis=0) for c in value], axis=-1))
    return np.mean(means, axis=0), np.std(means, axis=0, ddof=1) / math.sqrt(repeats)


def near_mirror():
    """Returns the bins (n, 3) around the mirror direction, where narrow lobes lie, in every third row."""
    return np.array(
        [
            (i, o, p)
            for i in range(0, 40, 3)
            for o in range(max(0, i - 1), min(40, i + 2))
            for p in (37, 38, 39)
        ],
        float,
    )


def elsewhere(n):
    """Returns at most n random bins (m, 3) that are not around the mirror direction."""
    bins = np.random.default_rng(2).integers(0, 40, (n, 3))
    return bins[(np.abs(bins[:, 0] - bins[:, 1]) > 1) | (bins[:, 2] < 37)].astype(float)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "slope"), [*((name, 1.0) for name in BLENDS), ("alpha .001", 0.0)])
def test_the_stated_error_of_integration_covers_the_actual_error(name, slope):
    """The integration error of an adapter's table is at most 1.6 times the error that an evaluation states, plus 3e-5.

    The integration error is the log loss between the mean of two tables and a finer integration, around the mirror
    direction and elsewhere. A failure means that an evaluation claims more accuracy than it has.
    """
    adapter = constant(BLENDS[name], slope)
    first, second = halves(name, slope)
    table = np.log1p(0.5 * (first + second))
    stated = 0.5 * np.abs(np.log1p(first) - np.log1p(second))
    actual, claimed = 0.0, 0.0
    share = 3 * len(near_mirror()) / 40**3
    for bins, part in ((near_mirror(), share), (elsewhere(200), 1.0 - share)):
        at = tuple(bins.astype(int).T)
        truth, error = fine_means(adapter, bins)
        actual += part * np.abs(table[at] - np.log1p(truth)).mean()
        claimed += part * stated[at].mean()
        # The error of the fine integration itself is much smaller than the errors of the tables.
        assert part * np.mean(error / (1.0 + truth)) < 5e-5
    assert actual < 1.6 * claimed + 3e-5
    assert claimed < 2e-4
    assert np.mean(stated) < 2e-4


@pytest.mark.parametrize("name", ("alpha .001", "coats of .001 over paint"))
def test_albedos_are_those_of_the_target(name):
    """The albedo of a row, which is 2 pi times the row's mean, equals the mean weight of the target's samples (Z-test).

    The false-alarm rate is `FALSE_ALARM` over all rows together; seeds are fixed.
    """
    n = 1 << 14
    rows = [0, 1, 7, 20, 38, 39]
    found = 2.0 * math.pi * halves(name, 0.0)[0].mean(axis=(1, 2))[rows, 0]
    rng = np.random.default_rng(3)
    mu = ((np.repeat(rows, n) + rng.random(len(rows) * n)) / 40).astype(np.float32)
    u = [dr.auto.Float(rng.random(len(mu), np.float32)) for _ in range(3)]
    wi = Vec3(dr.auto.Float(np.sqrt(1.0 - mu * mu)), dr.auto.Float(0.0 * mu), dr.auto.Float(mu))
    _, value, pdf = target.sample(BLENDS[name], wi, *u)
    weight = (
        dr.select(pdf > 0, value.x / dr.maximum(pdf, 1e-9), 0.0).numpy().astype(np.float64).reshape(-1, n)
    )
    error = np.hypot(weight.std(axis=1) / math.sqrt(n), 5e-4)
    limit = norm.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / len(rows))))
    assert (np.abs(found - weight.mean(axis=1)) < limit * error).all()


@pytest.mark.usefixtures("coarse")
def test_a_table_does_not_depend_on_the_materials_beside_it():
    adapter = constant(BLENDS["alpha .01"], 1.0)
    together = tabulate_adapter(adapter, PARAMS)
    assert together.shape == (3, *ISOTROPIC.shape)
    assert together.dtype == np.float32
    np.testing.assert_array_equal(tabulate_adapter(adapter, PARAMS[1:2])[0], together[1])
    other = tabulate_adapter(adapter, PARAMS[:1], shift=0.25)[0]
    assert (other != together[0]).mean() > 0.5


def reference(table, error=None):
    n = len(table)
    return Tables(PARAMS[:n], table, np.full(n, 4_000_000), error)


def test_an_adapter_agrees_with_its_own_table():
    adapter = constant(BLENDS["coats of .001 over paint"], 0.5)
    table = tabulate_adapter(adapter, PARAMS[:1], shift=0.25)
    result = adapters.evaluate(adapter, reference(table, np.zeros_like(table)))
    assert result.mean["log_loss"] < 4e-4
    assert result.mean["albedo_error"] < 2e-3
    assert result.mean["noise_floor"] == 0.0
    assert result.mean["psnr"] > 40.0
    assert result.integration_error < 2e-4
    assert result.albedo_integration_error < 5e-4
    assert not result.estimated_error


@pytest.mark.usefixtures("coarse")
def test_an_evaluation_is_json_and_says_that_errors_are_estimated():
    adapter = constant(BLENDS["alpha .1"])
    tables = 1.1 * tabulate_adapter(adapter, PARAMS[:2])
    done = []
    result = adapters.evaluate(adapter, reference(tables), done.append)
    assert done == [1, 2]
    assert result.estimated_error
    text = json.dumps({"mean": result.mean, "materials": result.materials}, allow_nan=False)
    assert set(json.loads(text)["mean"]) == set(metrics.FIGURES)
    assert len(result.materials) == 2
    for figure in metrics.FIGURES:
        assert result.mean[figure] == pytest.approx(np.mean([m[figure] for m in result.materials]))
    assert result.mean["noise_floor"] > 0.0
    # The reference is 10 % brighter, so that the albedo error is near a tenth of the albedo, which is about .6.
    assert result.mean["albedo_error"] == pytest.approx(0.1 * 0.6, rel=0.15)


@pytest.mark.usefixtures("coarse")
def test_references_that_cannot_be_compared_are_refused():
    adapter = constant(BLENDS["alpha .1"])
    with pytest.raises(TableError, match="evaluation needs isotropic tables"):
        adapters.evaluate(adapter, reference(np.zeros((1, 4, 5, 6, 3), np.float32)))
    other = replace(reference(np.zeros((1, *ISOTROPIC.shape), np.float32)), class_name="paint")
    with pytest.raises(
        TableError, match="are of class 'paint', but the adapter is for class layered3; .*simulate"
    ):
        adapters.evaluate(adapter, other)
    with pytest.raises(TableError, match="no material"):
        adapters.evaluate(adapter, reference(np.zeros((0, *ISOTROPIC.shape), np.float32)))


@pytest.mark.usefixtures("coarse")
def test_materials_beyond_the_training_range_are_refused_or_clamped():
    """An evaluation refuses a parameter beyond the training range, or clamps it on request.

    With parameters beyond the training range, figures of merit would measure how well the network extrapolates.
    """
    layers = [
        (
            np.zeros((23, 14), np.float32),
            np.array(target.encode(BLENDS["coats of .001 over paint"]), np.float32),
        )
    ]
    adapter = Adapter(LAYERED3, "raw", layers, 2, True, PRINCIPLED_PARAMS)
    params = PARAMS[:1].copy()
    params[0, 12] = 3.0
    with pytest.raises(ParamError, match=r"sigma_t is 3, allowed is 0 .. 1.*clamp"):
        tabulate_adapter(adapter, params)
    table = tabulate_adapter(adapter, params, clamp=True)
    tables = Tables(params, table, np.array([40]))
    with pytest.raises(ParamError, match="sigma_t"):
        adapters.evaluate(adapter, tables)
    assert adapters.evaluate(adapter, tables, clamp=True).mean["log_loss"] < 2e-3


@pytest.mark.usefixtures("coarse")
def test_an_adapter_of_one_material_is_not_compared_with_another():
    fitted = constant(BLENDS["alpha .1"])
    fitted.training.update(params=PARAMS[1].tolist(), material="gold-red-lacquer")
    assert tabulate_adapter(fitted, PARAMS[1].astype(np.float32)[None]).shape[0] == 1
    with pytest.raises(ParamError, match="was trained for a single material, gold-red-lacquer"):
        tabulate_adapter(fitted, PARAMS[:1])


def test_figures_are_their_formulas():
    """The figures of merit of a table of two rows and two bins equal values that are computed by hand."""
    a = np.zeros((2, 1, 2, 3))
    b = np.zeros((2, 1, 2, 3))
    a[0, 0, :, :] = [[0.2] * 3, [0.4] * 3]
    b[0, 0, :, :] = [[0.1] * 3, [0.5] * 3]
    b[1, 0, 1, :] = 1.0
    found = table_metrics(a, b, np.zeros_like(b))
    eps = metrics.EPS
    assert found["ae"] == pytest.approx((0.1 + 0.1 + 1.0) / 4)
    logs = abs(math.log(1.2 / 1.1)) + abs(math.log(1.4 / 1.5)) + math.log(2.0)
    assert found["log_loss"] == pytest.approx(logs / 4)
    assert found["smape"] == pytest.approx((0.2 / (0.3 + eps) + 0.2 / (0.9 + eps) + 2.0 / (1.0 + eps)) / 4)
    assert found["mape"] == pytest.approx((0.1 / (0.1 + eps) + 0.1 / (0.5 + eps) + 1.0 / (1.0 + eps)) / 4)
    assert found["mrse"] == pytest.approx((0.01 / (0.01 + eps) + 0.01 / (0.25 + eps) + 1.0 / (1.0 + eps)) / 4)
    assert found["psnr"] == pytest.approx(10 * math.log10(1.0 / ((0.01 + 0.01 + 1.0) / 4)))
    # The albedos of the two rows differ by 2 pi (.3 - .3) and 2 pi (0 - .5).
    assert found["albedo_error"] == pytest.approx(math.pi * 0.5)
    assert found["noise_floor"] == 0.0
    assert set(found) == set(metrics.FIGURES)
    assert table_metrics(b, b, np.zeros_like(b))["psnr"] == math.inf


@pytest.mark.parametrize("scale", (1e-4, 0.01, 0.3, 2.0))
def test_the_noise_floor_is_the_expected_loss_of_a_perfect_model(scale):
    """The noise floor equals a Monte Carlo estimate of the loss of a perfect model, for small and for large noise."""
    rng = np.random.default_rng(4)
    b = rng.exponential(0.3, (500,))
    error = scale * rng.uniform(0.0, 1.0, 500)
    noise = np.maximum(b + error * rng.standard_normal((20_000, 500)), -0.999)
    expected = np.abs(np.log1p(noise) - np.log1p(b)).mean()
    # The noise floor is a sum over 16 positive and 16 negative noise values. For small noise the noise floor is almost
    # exact, because the logarithm is almost linear. For large noise the noise floor is less precise.
    assert noise_floor(b, error) == pytest.approx(expected, rel=0.004 if scale < 1.0 else 0.03)


def test_counting_errors_are_exact_for_walks_of_throughput_1():
    """If all walks have throughput 1, the standard deviation of a bin is the value of `counting_error`, within 5 %.

    The count of walks in a bin is binomial, and eq. 9 of the paper converts the count to the value of the bin.
    The standard deviation of the binomial distribution has the factor sqrt(1 - p), where p is the probability of the
    bin. `counting_error` leaves out this factor.
    """
    rows, walks, omega = 4, 4_000_000, 2.0 * math.pi / 100
    chance = np.array([0.001, 0.01, 0.05])
    per_row = walks // rows
    counts = np.random.default_rng(5).binomial(per_row, chance, (4000, 3))
    values = counts / (per_row * omega)
    stated = counting_error(chance / omega, walks, omega, rows)
    np.testing.assert_allclose(values.std(axis=0), stated * np.sqrt(1.0 - chance), rtol=0.05)
    assert counting_error(np.array([-0.1, 0.0]), walks, omega, rows).tolist() == [0.0, 0.0]
