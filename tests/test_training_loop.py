"""The training loop minimises any objective over any tree of weights, and resumes from a checkpoint."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("jax", reason="training needs JAX, the extra [train]", exc_type=ImportError)
pytest.importorskip("optax", reason="training needs optax, the extra [train]", exc_type=ImportError)

import jax

from nma.train import loop
from nma.train.batches import Batch
from nma.train.recipe import CLASS

RECIPE = replace(CLASS, steps=400, learning_rate=0.1, schedule="onecycle", average=0.0)
EMPTY = Batch(*(np.zeros(1, np.float32) for _ in Batch._fields))
START = {"moved": np.array([3.0, -2.0]), "held": (np.array(5.0),)}


def distance(weights, batch, recipe):
    """Returns a loss and a log loss, which are minimal if `moved` is 1.

    `held` adds a term without gradient to the loss.
    """
    total = ((weights["moved"] - 1.0) ** 2).sum() + jax.lax.stop_gradient(weights["held"][0]) ** 2
    return total, total - 25.0


def train(checkpoint, budget=float("inf")):
    run = loop.resume(RECIPE, START, checkpoint)
    done = loop.train(
        RECIPE, run, lambda step: EMPTY, objective=distance, checkpoint=checkpoint, budget_seconds=budget
    )
    return loop.result(done, RECIPE), done


def test_a_tree_of_weights_reaches_the_minimum_of_an_objective(tmp_path):
    weights, run = train(tmp_path / "run.ckpt")
    np.testing.assert_allclose(weights["moved"], 1.0, atol=1e-3)
    assert weights["held"][0] == 5.0
    assert run.losses[0] == pytest.approx(4.0 + 9.0 + 25.0)
    assert run.log_losses[-1] == pytest.approx(0.0, abs=1e-4)


def test_the_loop_resumes_from_a_checkpoint_as_if_never_stopped(tmp_path):
    whole, _ = train(tmp_path / "whole.ckpt")
    _, stopped = train(tmp_path / "parts.ckpt", budget=0.0)
    assert stopped.step == loop.GROUP
    parts, _ = train(tmp_path / "parts.ckpt")
    np.testing.assert_array_equal(parts["moved"], whole["moved"])
