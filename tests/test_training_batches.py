"""Training batches: unbiased draws of bins, streams of new materials, and the thread that prepares batches.

Each statistical test has the false-alarm rate `FALSE_ALARM`. Seeds are fixed.
"""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

pytest.importorskip("jax", reason="training needs JAX, the extra [train]", exc_type=ImportError)
pytest.importorskip("optax", reason="training needs optax, the extra [train]", exc_type=ImportError)

from training_cases import FALSE_ALARM, TINY, batch_of, lambertian

from nma.table import ISOTROPIC, Grid
from nma.table.dataset import Settings, simulate_block
from nma.train import loop
from nma.train.batches import Batch, BinSampler, Pool, Stream, batches
from nma.train.recipe import preset


@pytest.fixture(scope="module")
def tables():
    return lambertian(6)


@pytest.mark.parametrize("law", ("mirror", "uniform"))
@pytest.mark.parametrize("count", (1, 8))
def test_weights_undo_the_choice_of_bins(law, count):
    """Weighted means over drawn bins equal means over uniform bins, in every row (Z-tests).

    All Z-tests of a case share the false-alarm rate `FALSE_ALARM`. A failure means that training prefers some bins.
    """
    sampler, rng, n = BinSampler(law), np.random.default_rng(7), 20_000
    for row in (0, 20, 39):
        rows = np.full(n, row)
        o, p, weight = sampler.draw(rng, rows, 0 * rows, count)
        assert o.shape == p.shape == weight.shape == (count, n)
        assert o.min() >= 0
        assert o.max() <= 39
        assert p.min() >= 0
        assert p.max() <= 39
        for function, expected in (
            (1.0, 1.0),
            (o, 19.5),
            (p, 19.5),
            (o * p, 19.5**2),
            ((o == row) & (p == 39), 1 / 1600),
        ):
            estimates = (weight * function).mean(axis=0)
            error = max(estimates.std() / math.sqrt(n), 1e-9)
            limit = norm.isf(0.5 * FALSE_ALARM / 15)
            assert abs(estimates.mean() - expected) < limit * error
    near = np.mean((np.abs(o - 39) <= 2) & (p >= 37))
    assert (near > 0.1) == (law == "mirror")


def test_a_batch_holds_the_values_of_the_tables(tables):
    batch = batch_of(tables, TINY, 3)
    pool = Pool.of(tables)
    m = [int(np.argmax((pool.params == c).all(axis=1))) for c in batch.columns.T]
    i, o, p = batch.i.astype(int), batch.o.astype(int), batch.p.astype(int)
    np.testing.assert_array_equal(
        batch.value, np.moveaxis(tables.values[m, i, o, p], -1, 0).astype(np.float32)
    )
    assert ((batch.mu * 40 >= batch.i - 1e-5) & (batch.mu * 40 <= batch.i + 1 + 1e-5)).all()
    assert ((batch.shift >= 0) & (batch.shift < 1)).all()
    # The quantum is the contribution of one walk of throughput 1 to a bin. By eq. 9 of the paper, the quantum is
    # 1 / (walks per row x solid angle of a bin).
    np.testing.assert_allclose(batch.quantum, 1.0 / (819_200 / 40 * ISOTROPIC.solid_angle), rtol=1e-6)
    assert all(x.dtype == np.float32 for x in batch)
    again = batch_of(tables, TINY, 3)
    for a, b in zip(batch, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (batch_of(tables, TINY, 4).mu != batch.mu).all()


def test_weights_undo_the_choice_of_anisotropic_bins():
    """Weighted means over drawn bins equal means over uniform bins also for anisotropic tables (Z-tests).

    A row of an anisotropic table belongs to a cosine and an azimuth of `wi`. Half of the bins are drawn around the
    mirror direction.
    """
    grid, rng, n = Grid(theta_i=10, theta_o=20, phi_o=40, phi_i=20), np.random.default_rng(8), 20_000
    sampler = BinSampler("mirror", grid)
    for row, turn in ((0, 0), (4, 13), (9, 19)):
        o, p, weight = sampler.draw(rng, np.full(n, row), np.full(n, turn), 8)
        mirror = (2 * turn + 1 + 20) % 40
        there = (o == 2 * row + 1) & (p == mirror)
        for function, expected in ((1.0, 1.0), (o, 9.5), (p, 19.5), (there, 1 / 800)):
            estimates = (weight * function).mean(axis=0)
            error = max(estimates.std() / math.sqrt(n), 1e-9)
            assert abs(estimates.mean() - expected) < norm.isf(0.5 * FALSE_ALARM / 12) * error
        assert there.mean() > 10 / 800


def test_albedos_within_a_row_are_interpolated(tables):
    """`albedo_at` is exact for albedos that are linear in the cosine.

    For any albedos, the mean of `albedo_at` over a row is the albedo of the row.
    """
    pool = Pool.of(tables)
    rows, offsets = np.arange(40), (np.arange(8) + 0.5) / 8
    linear = replace(pool, albedo=np.tile((0.1 + (rows + 0.5) / 50)[None, :, None], (6, 1, 3)))
    any_albedo = replace(pool, albedo=np.random.default_rng(9).random((6, 40, 3)))
    i, t = (x.ravel() for x in np.meshgrid(rows, offsets, indexing="ij"))
    m, mu = i % 6, (i + t) / 40
    np.testing.assert_allclose(
        linear.albedo_at(m, i, 0 * i, mu), np.tile(0.1 + 0.8 * mu[:, None], 3), rtol=1e-12
    )
    found = any_albedo.albedo_at(m, i, 0 * i, mu).reshape(40, 8, 3).mean(axis=1)
    np.testing.assert_allclose(found, any_albedo.albedo[rows % 6, rows], rtol=1e-12)


def test_batches_come_in_order_and_in_groups():
    groups = list(batches(lambda step: Batch(*[np.full(2, step)] * len(Batch._fields)), 3, 10, 3))
    assert [first for first, _ in groups] == [3, 6, 9]
    assert [group.mu[:, 0].tolist() for _, group in groups] == [[3, 4, 5], [6, 7, 8], [9]]


def test_a_consumer_that_leaves_early_leaves_no_thread():
    before = threading.active_count()
    stream = batches(lambda step: Batch(*[np.full(2, step)] * len(Batch._fields)), 0, 10**9, 5)
    next(stream)
    stream.close()
    assert threading.active_count() == before


def test_a_training_that_fails_leaves_no_thread(monkeypatch):
    """The traceback of an error keeps the generator alive, so the training itself must close the generator."""
    monkeypatch.setattr(
        loop, "_group", lambda state, group, scale, recipe, objective: (state, np.ones((5, 2)))
    )
    recipe = preset("single", steps=10**9)
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError) as error:
        loop.train(
            recipe,
            loop.Run(None),
            lambda step: Batch(*[np.ones(2)] * len(Batch._fields)),
            progress=lambda run: 1 / 0,
        )
    assert error.value.__traceback__ and threading.active_count() == before


def test_errors_of_the_preparing_thread_reach_the_caller():
    def broken(step):
        raise ZeroDivisionError("step")

    with pytest.raises(ZeroDivisionError, match="step"):
        list(batches(broken, 0, 10, 5))


def test_streams_hold_the_newest_materials_and_depend_on_the_step_alone():
    settings = Settings("layered3", 5, 400, 3)
    stream = Stream(settings, refresh=10)
    first = stream(0)
    np.testing.assert_array_equal(first.params, simulate_block(settings, range(5)).params.astype(np.float32))
    assert first.values.dtype == np.float16
    seen = {}
    for step in (0, 9, 10, 25, 40):
        pool = stream(step)
        seen[step] = pool.params.copy(), pool.values.copy()
    np.testing.assert_array_equal(seen[0][0], seen[9][0])
    assert (seen[0][0] != seen[10][0]).any(axis=1).all()
    for step in (10, 25, 40):
        resumed = Stream(settings, refresh=10, first_step=step)(step)
        np.testing.assert_array_equal(resumed.params, seen[step][0])
        np.testing.assert_array_equal(resumed.values, seen[step][1])


def test_streams_replace_the_oldest_first(monkeypatch):
    monkeypatch.setattr("nma.train.batches.STREAM_BLOCK", 2)
    settings = Settings("layered3", 5, 40, 3)
    stream = Stream(settings, refresh=1)
    everything = simulate_block(settings, range(12)).params.astype(np.float32)
    for step in range(4):
        pool = stream(step)
        held = {tuple(row) for row in pool.params}
        albedo = 2.0 * math.pi * pool.values.astype(np.float64).mean(axis=(2, 3))
        np.testing.assert_allclose(pool.albedo, albedo, rtol=1e-3, atol=1e-6)
        assert held == {tuple(row) for row in everything[2 * step : 2 * step + 5]}
