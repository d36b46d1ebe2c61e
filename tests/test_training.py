"""Training starts at a plausible blend, repeats bit for bit, resumes after a kill, and recovers a known target.

The tests share few recipes, because JAX compiles each recipe anew.
"""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("jax", reason="training needs JAX, the extra [train]", exc_type=ImportError)
pytest.importorskip("optax", reason="training needs optax, the extra [train]", exc_type=ImportError)

import jax
from training_cases import BRASS, TINY, batch_of, constant_adapter, lambertian, means_of

from nma import network, target
from nma.errors import NmaError, ParamError
from nma.evaluate import tabulate_adapter
from nma.params import LAYERED3
from nma.table import Tables
from nma.train import loop, plot
from nma.train import run as training
from nma.train.batches import BinSampler, Pool, draw
from nma.train.recipe import CLASS, PAPER, SINGLE, Recipe, preset

pytestmark = pytest.mark.usefixtures("fast_steps")

QUICK = replace(SINGLE, network="1x16", rows=32, bins_per_row=8, points=32, steps=300, learning_rate=2e-2)


@pytest.fixture(scope="module")
def tables():
    return lambertian(6)


@pytest.mark.slow
def test_a_run_repeats_bit_for_bit(tables):
    """Two runs with the same seed have the same losses and weights. Another seed draws other batches and weights."""
    first, run = training.train_class(LAYERED3, TINY, tables, {})
    second, again = training.train_class(LAYERED3, TINY, tables, {})
    assert len(run.losses) == len(run.log_losses) == run.step == TINY.steps
    assert run.losses == again.losses
    assert run.log_losses == again.log_losses
    for a, b in zip(first.layers, second.layers, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_array_equal(a[1], b[1])
    batches_differ = draw(Pool.of(tables), BinSampler("mirror"), replace(TINY, seed=1), 0)
    assert (batches_differ.mu != batch_of(tables, TINY).mu).all()
    layers = training.initial_layers(replace(TINY, seed=1), LAYERED3)
    assert (layers[0][0] != training.initial_layers(TINY, LAYERED3)[0][0]).all()
    assert np.isfinite(run.losses).all()


class Killed(Exception):
    """The exception that simulates the kill of a training process."""


@pytest.mark.parametrize("moment", (150, pytest.param(50, marks=pytest.mark.slow)))
def test_a_killed_run_resumes_as_if_nothing_had_happened(tables, tmp_path, monkeypatch, moment):
    whole, expected = training.train_class(LAYERED3, TINY, tables, {})
    monkeypatch.setattr(loop, "_CHECKPOINT_SECONDS", 0.0)
    checkpoint = tmp_path / "run.ckpt"

    def kill(run):
        if run.step == moment:
            raise Killed

    with pytest.raises(Killed):
        training.train_class(LAYERED3, TINY, tables, {}, checkpoint=checkpoint, progress=kill)
    steps = []
    resumed, run = training.train_class(
        LAYERED3, TINY, tables, {}, checkpoint=checkpoint, progress=lambda run: steps.append(run.step)
    )
    assert steps[0] == moment + loop.GROUP
    assert run.losses == expected.losses
    assert run.log_losses == expected.log_losses
    for a, b in zip(jax.tree.leaves(run.state), jax.tree.leaves(expected.state), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    for a, b in zip(whole.layers, resumed.layers, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    assert [p.name for p in tmp_path.iterdir()] == ["run.ckpt"]
    # If a finished run is resumed, it does no more steps.
    _, done = training.train_class(LAYERED3, TINY, tables, {}, checkpoint=checkpoint)
    assert done.losses == expected.losses


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    layers, path = training.initial_layers(TINY, LAYERED3), tmp_path / "run.ckpt"
    loop.save(loop.start(TINY, layers), TINY, path)
    assert loop.resume(TINY, layers, path).step == 0
    for change in ({"seed": 1}, {"learning_rate": 0.02}, {"loss": "log", "steps": 300}):
        with pytest.raises(NmaError, match=rf"run.ckpt.*other settings \({', '.join(change)}\)"):
            loop.resume(replace(TINY, **change), layers, path)
    with pytest.raises(NmaError, match="other data.*delete the file"):
        loop.resume(TINY, layers, path, {"data": "another dataset"})
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"no archive"):
        path.write_bytes(content)
        with pytest.raises(NmaError, match="damaged checkpoint.*delete the file") as caught:
            loop.resume(TINY, layers, path)
        assert "\n" not in str(caught.value)


def test_a_time_budget_ends_a_run(tables):
    _, run = training.train_class(LAYERED3, TINY, tables, {}, budget_seconds=0.0)
    assert run.step == loop.GROUP


@pytest.mark.slow
def test_a_fit_approaches_its_table():
    """A fit reaches a log loss below .003 in 300 steps if the network can represent the target of the table exactly."""
    params = LAYERED3.sample(np.random.default_rng(0), 1)
    truth = tabulate_adapter(constant_adapter(BRASS), params)
    adapter, run = training.fit_material(
        LAYERED3, QUICK, params[0], Tables(params, truth, np.array([10**9])), {"data": "a test"}
    )
    assert run.log_losses[0] > 0.01
    assert np.mean(run.log_losses[-50:]) < 0.003
    assert np.abs(np.log1p(tabulate_adapter(adapter, params)) - np.log1p(truth)).mean() < 0.003
    record = adapter.training
    assert record["data"] == "a test"
    assert record["params"] == params[0].tolist()
    assert record["recipe"]["network"] == "1x16"
    assert record["bins_seen"] == run.step * 32 * 8
    for key in ("steps", "seconds", "version", "jax", "device", "machine", "date"):
        assert record[key], key
    assert adapter.variant == "blended + omega_i"


def test_parameters_that_no_file_may_record_are_refused_before_the_training(tables):
    params = LAYERED3.sample(np.random.default_rng(0), 1)[0]
    params[0] = 7.0
    with pytest.raises(ParamError, match="alpha_top is 7, allowed is"):
        training.fit_material(LAYERED3, QUICK, params, tables[:1], {})


@pytest.mark.slow
def test_the_paper_s_preset_runs(tables):
    """The preset `paper` has the settings of the paper, and a training with it runs.

    The paper trains with batches of 1000 bins, 20 uniform points per bin, raw inputs, and Adam with a learning rate of
    1e-5.
    """
    assert (PAPER.rows, PAPER.bins_per_row, PAPER.points) == (1000, 1, 20)
    assert (PAPER.points_law, PAPER.bins_law, PAPER.loss) == ("uniform", "uniform", "log")
    assert (PAPER.encoding, PAPER.learning_rate, PAPER.average) == ("raw", 1e-5, 0.0)
    recipe = preset("paper", steps=4, network="3x32")
    adapter, run = training.train_class(LAYERED3, recipe, tables, {})
    assert run.step == 4
    assert np.isfinite(run.losses).all()
    assert run.losses == run.log_losses
    # The adapter's network has 14 inputs, three hidden layers of 32 neurons, and 23 outputs. The paper's network has
    # 33 inputs. The 7159 parameters of the paper's library include 100 codes of 32 numbers.
    assert network.parameters(adapter.layers) == 7159 - 3200 - 19 * 32


@pytest.mark.slow
@pytest.mark.parametrize(
    ("instances", "directional"), [(1, False), (2, False), (1, True), (2, True), (5, True)], ids=str
)
def test_every_variant_starts_at_a_plausible_blend(tables, instances, directional):
    """The target of an untrained network has finite values of at least 0, for every count of instances."""
    recipe = replace(TINY, instances=instances, directional=directional)
    layers = training.initial_layers(recipe, LAYERED3)
    assert layers[-1][1].shape == (target.output_size(instances),)
    means = means_of(layers, batch_of(tables, recipe), recipe)
    assert means.shape == (3, recipe.bins_per_row, recipe.rows)
    assert np.isfinite(means).all()
    assert (means >= 0).all()


def test_a_loss_that_is_not_finite_stops_the_run(tables):
    layers = training.initial_layers(TINY, LAYERED3)
    layers[0][0][0, 0] = np.nan
    pool, sampler = Pool.of(tables), BinSampler("mirror")
    with pytest.raises(NmaError, match="not finite at step 0; lower the learning rate"):
        loop.train(TINY, loop.start(TINY, layers), lambda step: draw(pool, sampler, TINY, step))


def test_the_plateau_schedule_halves_a_stalled_step():
    window = loop._PATIENCE * loop.GROUP
    run = loop.Run(loop.State([], [], None), step=2 * window, losses=[1.0] * 2 * window)
    assert loop._plateau(run) == 0.5
    run.losses = [1.0] * window + [0.9] * window
    assert loop._plateau(run) == 1.0
    run.step = window
    assert loop._plateau(run) == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": 0}, "rows must be positive"),
        ({"learning_rate": -1.0}, "learning_rate must be positive"),
        ({"average": 1.0}, "average must be at least 0 and below 1"),
        ({"loss": "l2"}, "loss is one of huber, log; got 'l2'"),
        ({"points_law": "random"}, "points_law is one of crowded, uniform, centre"),
        ({"target": "stretched", "directional": False}, "stretched .* depends on the direction"),
        ({"target": "interface", "directional": False}, "stretched .* depends on the direction"),
        ({"bins_law": "lobes"}, "bins_law is one of mirror, uniform"),
        ({"schedule": "cosine"}, "schedule is one of onecycle, plateau, constant"),
    ],
)
def test_invalid_recipes_are_refused(change, message):
    with pytest.raises(NmaError, match=message):
        replace(CLASS, **change)


def test_presets_are_found_by_name():
    assert preset("single", steps=None, seed=3) == replace(SINGLE, seed=3)
    with pytest.raises(NmaError, match="unknown preset 'fast'; known presets are class, paper, single"):
        preset("fast")
    with pytest.raises(NmaError, match="DEPTHxWIDTH"):
        training.initial_layers(Recipe(network="big"), LAYERED3)


def test_losses_are_plotted(tmp_path):
    path = plot.plot_losses(np.geomspace(0.1, 0.001, 500), tmp_path / "loss.png", "a test")
    assert path.read_bytes().startswith(b"\x89PNG")


BLOCKED = """
import sys

class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "{missing}":
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Block())
"""


@pytest.mark.parametrize("missing", ("jax", pytest.param("optax", marks=pytest.mark.slow)))
def test_without_jax_or_optax_the_error_says_what_to_install(missing, tmp_path):
    code = BLOCKED.format(missing=missing) + "from nma.cli import main; main()"
    options = ("fit", "gold-red-lacquer", "-o", str(tmp_path / "gold.safetensors"), "--walks", "40")
    result = subprocess.run(
        [sys.executable, "-c", code, *options], capture_output=True, text=True, timeout=60, env=os.environ
    )
    assert result.returncode == 1
    assert result.stderr.startswith(f"nma: training needs JAX and optax ({missing} is missing)")
    assert result.stderr.rstrip().endswith("in a checkout of this project run: pip install '.[train]'")
    assert result.stderr.count("\n") == 1
