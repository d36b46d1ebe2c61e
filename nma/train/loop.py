"""The optimisation loop: Adam, schedules, weight averaging, and checkpoints from which an interrupted run resumes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from nma.errors import NmaError
from nma.files import arrays, whole
from nma.train.batches import batches
from nma.train.loss import loss
from nma.train.recipe import Recipe

# The arrays to train, as a JAX tree of any structure. For an adapter, the tree is `nma.network.Layers`.
Weights = Any
# A named tuple of arrays, such as `nma.train.batches.Batch`.
Batch = Any
# A function of (weights, batch, recipe), which returns (the loss to minimise, the log loss to report).
Objective = Callable[[Weights, Batch, Recipe], tuple[jax.Array, jax.Array]]

# Number of steps per call of the compiled function (a group).
GROUP = 50
_CHECKPOINT_SECONDS = 60.0
# The schedule "plateau" compares the mean losses of two successive windows. A window has `_PATIENCE` groups.
_PATIENCE = 6
_MIN_SCALE = 1e-3


class State(NamedTuple):
    """Everything that a step changes: weights, their moving average, and Adam's state."""

    layers: Weights
    averaged: Weights
    optimiser: Any


@dataclass
class Run:
    """The progress of a training run: steps done, losses so far (one per step), and time spent.

    `scale` multiplies Adam's steps; only the schedule "plateau" changes it. `record` says where the training data come
    from.
    """

    state: State
    step: int = 0
    losses: list[float] = field(default_factory=list)
    log_losses: list[float] = field(default_factory=list)
    seconds: float = 0.0
    scale: float = 1.0
    record: dict[str, Any] = field(default_factory=dict)


def start(recipe: Recipe, layers: Weights, record: dict[str, Any] | None = None) -> Run:
    """A new run, before its first step; `record` says where the training data come from."""
    layers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layers)
    return Run(State(layers, layers, _optimiser(recipe).init(layers)), record=record or {})


def train(
    recipe: Recipe,
    run: Run,
    source: Callable[[int], Batch],
    *,
    objective: Objective = loss,
    checkpoint: Path | None = None,
    progress: Callable[[Run], None] = lambda run: None,
    budget_seconds: float = float("inf"),
) -> Run:
    """Continues `run` to the recipe's last step, or until the time budget is spent, and returns `run`.

    `source(step)` returns the batch of a step and must depend on the step alone. The first value that `objective`
    returns is minimised. With `checkpoint`, the run is saved to that file every minute and at the end.
    """
    saved = began = time.perf_counter()
    before = run.seconds
    # After an error, the thread that prepares batches would otherwise run until the interpreter exits.
    with closing(batches(source, run.step, recipe.steps, GROUP)) as groups:
        for _first, group in groups:
            run.state, values = _group(run.state, group, run.scale, recipe, objective)
            values = np.asarray(values)
            if not np.isfinite(values).all():
                raise NmaError(
                    f"the loss is not finite at step {run.step + int(np.argmin(np.isfinite(values[:, 0])))}; "
                    "lower the learning rate, or resume from the last checkpoint with another seed"
                )
            run.losses += values[:, 0].tolist()
            run.log_losses += values[:, 1].tolist()
            run.step += len(values)
            now = time.perf_counter()
            run.seconds = before + now - began
            if recipe.schedule == "plateau":
                run.scale = _plateau(run)
            if checkpoint and now - saved > _CHECKPOINT_SECONDS:
                save(run, recipe, checkpoint)
                saved = now
            progress(run)
            if run.seconds > budget_seconds or run.scale < _MIN_SCALE:
                break
    if checkpoint:
        save(run, recipe, checkpoint)
    return run


def result(run: Run, recipe: Recipe) -> Weights:
    """The trained weights as NumPy arrays, averaged over the last steps if the recipe's `average` is above 0."""
    return jax.tree.map(np.asarray, run.state.averaged if recipe.average > 0 else run.state.layers)


def _schedule(recipe: Recipe) -> optax.Schedule:
    if recipe.schedule == "onecycle":
        return optax.cosine_onecycle_schedule(
            recipe.steps, recipe.learning_rate, pct_start=0.1, div_factor=10, final_div_factor=100
        )
    return optax.constant_schedule(recipe.learning_rate)


def _optimiser(recipe: Recipe) -> optax.GradientTransformation:
    return optax.adam(_schedule(recipe))


@partial(jax.jit, static_argnames=("recipe", "objective"))
def _group(
    state: State, group: Batch, scale: float, recipe: Recipe, objective: Objective
) -> tuple[State, jax.Array]:
    """Runs the steps of one group. Returns the new state, and the loss and log loss of each step (steps, 2)."""
    optimiser = _optimiser(recipe)

    def step(state: State, batch: Batch) -> tuple[State, jax.Array]:
        (value, log_loss), gradient = jax.value_and_grad(objective, has_aux=True)(state.layers, batch, recipe)
        updates, inner = optimiser.update(gradient, state.optimiser)
        layers = optax.apply_updates(state.layers, jax.tree.map(lambda u: u * scale, updates))
        averaged = optax.incremental_update(layers, state.averaged, 1.0 - recipe.average)
        return State(layers, averaged, inner), jnp.stack([value, log_loss])

    return jax.lax.scan(step, state, group)


def _plateau(run: Run) -> float:
    """The scale of the next steps, halved if the mean loss has not fallen by 1 % from one window to the next."""
    window = _PATIENCE * GROUP
    if run.step % window or run.step < 2 * window:
        return run.scale
    recent, earlier = np.mean(run.losses[-window:]), np.mean(run.losses[-2 * window : -window])
    return run.scale * (0.5 if recent > 0.99 * earlier else 1.0)


def save(run: Run, recipe: Recipe, path: Path) -> None:
    """Writes a checkpoint to `path`, atomically."""
    leaves = jax.tree.leaves(run.state)
    arrays: dict[str, Any] = {f"leaf{k}": np.asarray(leaf) for k, leaf in enumerate(leaves)}
    notes = {
        "recipe": asdict(recipe),
        "record": run.record,
        "step": run.step,
        "seconds": run.seconds,
        "scale": run.scale,
    }
    with whole(path) as file, file.open("wb") as f:
        np.savez(f, notes=json.dumps(notes), losses=run.losses, log_losses=run.log_losses, **arrays)


def resume(recipe: Recipe, layers: Weights, path: Path, record: dict[str, Any] | None = None) -> Run:
    """The run stored in the checkpoint at `path`, or a new run if there is no such file.

    Raises `NmaError` if the checkpoint is damaged, or belongs to another recipe or to other data.
    """
    run = start(recipe, layers, record)
    if not path.exists():
        return run
    try:
        with arrays(path) as f:
            notes = json.loads(str(f["notes"]))
            leaves = [f[f"leaf{k}"] for k in range(len(jax.tree.leaves(run.state)))]
            losses, log_losses = f["losses"].tolist(), f["log_losses"].tolist()
    except Exception as e:
        raise NmaError(f"{path}: damaged checkpoint ({e}); delete the file to start again") from None
    settings = json.loads(json.dumps(asdict(recipe)))
    if notes["recipe"] != settings:
        changed = [k for k, v in settings.items() if notes["recipe"].get(k) != v]
        raise NmaError(
            f"{path} belongs to a run with other settings ({', '.join(changed)}); "
            "delete the file, or restore the settings"
        )
    if notes.get("record", {}) != run.record:
        raise NmaError(
            f"{path} belongs to a run on other data, {notes.get('record')}; delete the file, or use the same data"
        )
    state = jax.tree.unflatten(jax.tree.structure(run.state), [jnp.asarray(x) for x in leaves])
    return Run(state, notes["step"], losses, log_losses, notes["seconds"], notes["scale"], run.record)
