"""The loss of training: means over bins, the minima of the log loss and of the Huber loss, and estimates of albedos.

Each statistical test has the false-alarm rate `FALSE_ALARM`; seeds are fixed. The tests share few recipes, because JAX
compiles each recipe anew.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

pytest.importorskip("jax", reason="training needs JAX, the extra [train]", exc_type=ImportError)
pytest.importorskip("optax", reason="training needs optax, the extra [train]", exc_type=ImportError)

import jax
import jax.numpy as jnp
from target_cases import FAST_COMPILE
from training_cases import (
    BRASS,
    FALSE_ALARM,
    TINY,
    batch_of,
    constant_adapter,
    constant_layers,
    lambertian,
    means_of,
)

from nma import target
from nma.evaluate import tabulate_adapter
from nma.ops import Color, Vec3
from nma.target import Blend, Principled
from nma.target.decode import logit
from nma.train.batches import Batch
from nma.train.loss import albedos, brdf_of, loss


@pytest.fixture(scope="module")
def tables():
    return lambertian(6)


@pytest.mark.parametrize(
    ("law", "kind"), [("crowded", "principled"), ("uniform", "principled"), ("crowded", "stretched")], ids=str
)
def test_bin_means_in_jax_equal_the_tables_of_the_evaluation(tables, law, kind):
    """Training in JAX and evaluation in Dr.Jit compute the same means over bins from the same target.

    Training and evaluation use different code and different points. A failure means that training and evaluation
    compute different values from the same target.
    """
    params, stretched = target.TARGETS[kind], kind == "stretched"
    across = BRASS.instances[0]._replace(anisotropic=-3.0 if stretched else 0.0)
    blend = BRASS._replace(instances=(across, BRASS.instances[1]))
    table = tabulate_adapter(constant_adapter(blend, params), tables.params[:1])[0]
    recipe = replace(TINY, encoding="direction", points=256, points_law=law, rows=32, bins_law="uniform")
    recipe = replace(recipe, target=kind, directional=stretched)
    batch = batch_of(tables, recipe)
    found = means_of(constant_layers(blend, params=params), batch, recipe)
    i, o, p = (np.broadcast_to(x, batch.o.shape).astype(int) for x in (batch.i, batch.o, batch.p))
    expected = np.moveaxis(table[i, o, p], -1, 0)
    assert np.abs(np.log1p(found) - np.log1p(expected)).mean() < 1e-3
    np.testing.assert_allclose(np.log1p(found), np.log1p(expected), atol=0.02)


def test_the_points_law_centre_evaluates_the_middle_of_the_bin(tables):
    recipe = replace(TINY, encoding="direction", directional=False, points_law="centre")
    white = Principled(Color(0.8, 0.4, 0.2), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    layers = constant_layers(Blend((white, white), (0.5, 0.5)))
    batch = batch_of(tables, recipe)
    (_, raw), mu_o = layers[0], (batch.o + 0.5) / 40
    blend = target.decode([float(x) for x in raw], 2)
    mu_i = np.broadcast_to((batch.i + 0.5) / 40, mu_o.shape)
    away = (39.5 - batch.p) * math.pi / 40
    wi = Vec3(np.sqrt(1 - mu_i**2), 0 * mu_i, mu_i)
    sin_o = np.sqrt(1 - mu_o**2)
    wo = Vec3(-sin_o * np.cos(away), sin_o * np.sin(away), mu_o)
    expected = np.stack(target.eval(blend, wi, wo))
    np.testing.assert_allclose(means_of(layers, batch, recipe), expected, rtol=2e-3, atol=1e-6)


def compound_poisson(rng, mean, quantum, shape):
    """Draws random values of bins with few walks. The expected value of each bin is `mean`.

    The count of walks in a bin has a Poisson distribution, and each walk has a throughput from 0 to 1. `quantum` is the
    value of one walk of throughput 1.
    """
    counts = rng.poisson(2.0 * mean / quantum, shape)
    total = np.zeros(shape)
    for k in range(1, counts.max() + 1):
        total += np.where(counts >= k, rng.random(shape), 0.0)
    return total * quantum


@pytest.mark.slow
def test_the_huber_loss_is_least_near_the_mean_of_noisy_bins_and_the_log_loss_at_their_median():
    """If bins have few walks, the log loss is minimal at their median brightness, which is below their mean brightness.

    The bias of the Huber loss is less than 30 % of the bias of the log loss. In this test, the target is matte and only
    its brightness is fitted.
    """
    rng, quantum = np.random.default_rng(6), 0.2
    base = replace(
        TINY,
        encoding="direction",
        directional=False,
        points=1,
        rows=4000,
        bins_per_row=1,
        energy=0.0,
        albedo=0.0,
    )
    base = replace(base, instances=1, points_law="centre")
    matte = Principled(Color(0.5, 0.5, 0.5), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    (matrix, raw), *_ = constant_layers(Blend((matte,), (1.0,)))
    rows = np.zeros(4000, np.float32)
    batch = Batch(
        columns=np.zeros((13, 4000), np.float32),
        mu=rows + 0.5,
        phi=rows,
        i=rows + 20,
        a=rows,
        o=rows[None] + 20,
        p=rows[None] + 10,
        shift=np.zeros((3, 1, 4000), np.float32),
        weight=np.ones((1, 4000), np.float32),
        value=np.zeros((3, 1, 4000), np.float32),
        albedo=np.zeros((3, 4000), np.float32),
        albedo_shift=np.zeros((3, 2, 4000), np.float32),
        quantum=rows + np.float32(quantum),
        interface=np.zeros((0, 4000), np.float32),
    )
    exact = float(means_of([(matrix, raw)], batch, base)[0, 0, 0])
    values = compound_poisson(rng, exact, quantum, (1, 4000))
    batch = batch._replace(value=np.broadcast_to(values, (3, 1, 4000)).astype(np.float32))

    def best(kind):
        """Returns the brightness that minimises the loss, relative to the exact brightness."""
        recipe, scales = replace(base, loss=kind), np.linspace(0.05, 1.5, 59)
        lit = [raw.copy() for _ in scales]
        for row, scale in zip(lit, scales, strict=True):
            row[:3] = logit(0.5 * scale)
        losses = jax.jit(jax.vmap(lambda bias: loss([(matrix, bias)], batch, recipe)[0]))(jnp.stack(lit))
        return scales[int(np.argmin(losses))]

    median = np.median(values) / exact
    assert best("log") == pytest.approx(median, abs=0.06)
    assert median < 0.8
    assert abs(best("huber") - 1.0) < 0.3 * abs(best("log") - 1.0)


def exact_albedo(raw, mu):
    """Decodes `raw` to a blend and returns its directional albedo (3,), by quadrature in double precision."""
    cosines, weights = np.polynomial.legendre.leggauss(160)
    z, phi = 0.5 * (cosines + 1.0)[:, None], (np.arange(160) + 0.5)[None] * (math.pi / 160)
    r = np.sqrt(1.0 - z * z)
    wi = Vec3(math.sqrt(1.0 - mu * mu), 0.0, mu)
    value = target.eval(
        target.decode(list(raw), 2), wi, Vec3(r * np.cos(phi), r * np.sin(phi), z + 0.0 * phi)
    )
    return np.array([(c.mean(axis=1) * weights).sum() * math.pi for c in value])


@pytest.mark.slow
def test_albedos_and_their_derivatives_are_unbiased(tables):
    """Estimates of albedos and their derivatives have the means that quadrature gives (t-tests).

    Each estimate consists of two independent estimates, the halves, so the mean of the product of the two halves is the
    squared albedo. The false-alarm rate is `FALSE_ALARM` over all comparisons. A failure means that training makes
    albedos differ from the albedos of the tables.
    """
    blocks, rows = 40, 32
    recipe = replace(TINY, encoding="direction", directional=False, rows=rows, albedo_samples=8)
    (matrix, raw), *_ = constant_layers(BRASS)
    batch, rng = batch_of(tables, recipe), np.random.default_rng(8)

    def estimate(raw, mu, shift):
        block = batch._replace(mu=jnp.full(rows, mu), albedo_shift=shift)
        halves = albedos(brdf_of([(matrix, raw)], block, recipe), block, recipe)
        return halves.mean(axis=(0, 2)), (halves[0] * halves[1]).mean(axis=1)

    def each(function):
        return jax.jit(jax.vmap(function, in_axes=(None, None, 0)), **FAST_COMPILE)

    estimates, derivatives = each(estimate), each(jax.jacrev(lambda *x: estimate(*x)[0]))
    angles, step = (0.1, 0.5, 0.98), 1e-4
    comparisons = len(angles) * 3 * (2 + len(raw))
    for mu in angles:
        shifts = rng.random((blocks, 3, 2, rows), dtype=np.float32)
        found, product = map(np.asarray, estimates(raw, mu, shifts))
        slopes = np.asarray(derivatives(raw, mu, shifts))  # (blocks, 3, 23)
        exact = raw.astype(np.float64)
        expected = exact_albedo(exact, mu)
        for channel in range(3):
            assert_mean(found[:, channel], expected[channel], comparisons)
            assert_mean(product[:, channel], expected[channel] ** 2, comparisons)
        for k, change in enumerate(step * np.eye(len(raw))):
            slope = (exact_albedo(exact + change, mu) - exact_albedo(exact - change, mu)) / (2 * step)
            for channel in range(3):
                assert_mean(slopes[:, channel, k], slope[channel], comparisons)


def assert_mean(values, expected, comparisons):
    """Asserts by a t-test that independent values have the mean `expected`.

    All comparisons of a test share the false-alarm rate `FALSE_ALARM`.
    """
    spread = values.std(ddof=1) / math.sqrt(len(values))
    # The summand 1e-5 allows for rounding in single precision.
    limit = student.isf(0.5 * FALSE_ALARM / comparisons, len(values) - 1)
    assert abs(values.mean() - expected) < limit * spread + 1e-5
