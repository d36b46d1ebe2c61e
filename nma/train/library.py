"""Trains a library (a network and a code for each material), and finds the code of a new material."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from nma.adapter.library import Library
from nma.errors import TableError
from nma.evaluate import table_log_loss
from nma.params import CODE_BOUND, LIBRARY
from nma.progress import of_training
from nma.table import ISOTROPIC, Tables
from nma.train import loop
from nma.train.batches import Batch, BinSampler, Pool, draw
from nma.train.loss import bin_means, brdf_of, distance, loss
from nma.train.recipe import Recipe
from nma.train.run import adapter_of, initial_layers

# With this recipe, a library of a hundred materials needs 20 minutes or less on two cores, including the tabulation of
# the materials.
RECIPE = Recipe(
    network="3x32",
    encoding="raw",
    rows=256,
    bins_per_row=8,
    points=8,
    albedo=0.3,
    learning_rate=1e-2,
    average=0.999,
    steps=60_000,
)

# The recipe for finding the code of one new material. The network is fixed, so a thousand steps are enough.
ENCODING = replace(RECIPE, learning_rate=3e-2, average=0.99, steps=1_000)

# The search for a code starts at the codes of the `NEAREST` nearest materials, and at the mean of all codes.
NEAREST = 3
# Standard deviation of the codes before training.
_SPREAD = 0.5
# Number of batches on which the log losses of codes are compared.
_JUDGED = 8


def train_library(
    names: Sequence[str],
    tables: Tables,
    recipe: Recipe,
    record: dict[str, Any],
    *,
    checkpoint: Path | None = None,
    progress: Callable[[loop.Run], None] = lambda run: None,
    budget_seconds: float = float("inf"),
) -> tuple[Library, loop.Run]:
    """Trains the network of a library, and the code of each material. Returns the library and the run.

    `record` says where the tables come from and is stored with the weights. A checkpoint with another record is
    rejected.
    """
    if len(names) != len(tables.values) or tables.values.shape[1:] != ISOTROPIC.shape:
        raise TableError(
            f"a library of {len(names)} materials needs {len(names)} tables of shape {ISOTROPIC.shape}, "
            f"got {tables.values.shape}"
        )
    rng = np.random.default_rng((recipe.seed, 0xC0DE))
    free = _SPREAD * rng.standard_normal((len(names), LIBRARY.size))
    weights = free.astype(np.float32), initial_layers(recipe, LIBRARY)
    run = (
        loop.resume(recipe, weights, checkpoint, record)
        if checkpoint
        else loop.start(recipe, weights, record)
    )
    loop.train(
        recipe,
        run,
        _source(tables, recipe),
        objective=objective,
        checkpoint=checkpoint,
        progress=progress,
        budget_seconds=budget_seconds,
    )
    free, layers = loop.result(run, recipe)
    adapter = replace(adapter_of(LIBRARY, recipe, run, record), layers=layers)
    return Library(adapter, tuple(names), np.asarray(code_of(free))), run


@dataclass(frozen=True)
class Encoded:
    """The code (32,) of a new material, and its log loss over the bins of the table.

    `nearest` is the library's material whose code has the lowest log loss on the same table, and `nearest_log_loss` is
    the log loss of its code.
    """

    code: NDArray[np.float32]
    log_loss: float
    nearest: str
    nearest_log_loss: float


def encode(
    library: Library,
    tables: Tables,
    *,
    recipe: Recipe = ENCODING,
    progress: Callable[[loop.Run], None] | None = None,
) -> Encoded:
    """Finds the code of the one material in `tables`. The network does not change.

    The search starts from the mean code and from the codes of the nearest materials, all at the same time, and returns
    the best code. Without `progress`, a progress bar is shown on stderr if stderr is a terminal.
    """
    if tables.values.shape != (1, *ISOTROPIC.shape):
        raise TableError(f"encoding needs one table of shape {ISOTROPIC.shape}, got {tables.values.shape}")
    adapter = library.adapter
    recipe = replace(
        recipe, instances=adapter.instances, directional=adapter.directional, bounded=adapter.bounded
    )
    losses = _judge(library.codes, library, tables, recipe)
    near = np.argsort(losses)[:NEAREST]
    starts = np.concatenate([library.codes.mean(axis=0, keepdims=True), library.codes[near]])
    weights = free_of(starts).astype(np.float32), adapter.layers
    run = loop.start(recipe, weights)
    with of_training(progress, recipe, "encoding") as show:
        batches = _source(_repeated(tables, len(starts)), recipe)
        loop.train(recipe, run, batches, objective=_held, progress=show)
    found = np.asarray(code_of(loop.result(run, recipe)[0]))
    # The code of the nearest material is a candidate, too, because the search may end at worse codes.
    found = np.concatenate([found, library.codes[near[:1]]])
    best = found[np.argmin(_judge(found, library, tables, recipe))]
    log_losses = [table_log_loss(adapter, code, tables.values[0]) for code in (best, library.codes[near[0]])]
    return Encoded(best, log_losses[0], library.names[near[0]], log_losses[1])


def code_of(free: Any) -> Any:
    """Converts the free variables of the optimisation to codes.

    Free variables may be any real numbers. Codes lie within the range of the class. A code near 0 almost equals its
    free variable.
    """
    return CODE_BOUND * jnp.tanh(free * (1.0 / CODE_BOUND))


def free_of(code: NDArray) -> NDArray:
    """The inverse of `code_of`. Codes are first moved away from the ends of the range, where gradients vanish."""
    return CODE_BOUND * np.arctanh(np.clip(code / CODE_BOUND, -0.99, 0.99))


def objective(weights: Any, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """The loss to minimise, and the log loss.

    `weights` is (the free variables of the codes, the network's layers). The batch has one column, with the index of
    each row's material.
    """
    free, layers = weights
    codes = code_of(free)[batch.columns[0].astype(jnp.int32)]
    return loss(layers, batch._replace(columns=codes.T), recipe)


def _held(weights: Any, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """The same as `objective`, but without gradients for the network."""
    free, layers = weights
    return objective((free, jax.lax.stop_gradient(layers)), batch, recipe)


def _source(tables: Tables, recipe: Recipe) -> Callable[[int], Batch]:
    """A function that returns the batch of a step. The batch has one column: the index of each row's material."""
    pool, sampler = Pool.numbered(tables), BinSampler(recipe.bins_law)
    return lambda step: draw(pool, sampler, recipe, step)


def _repeated(tables: Tables, count: int) -> Tables:
    """The tables of one material repeated `count` times, without copying them."""
    values = np.broadcast_to(tables.values, (count, *tables.values.shape[1:]))
    return Tables(np.zeros((count, 0)), values, np.repeat(tables.walks, count))


def _judge(codes: NDArray, library: Library, tables: Tables, recipe: Recipe) -> NDArray[np.float32]:
    """The log losses (n,) of the codes, for all codes over the same few bins."""
    source = _source(tables, replace(recipe, seed=recipe.seed + 1))
    batches = Batch(*(np.stack(parts) for parts in zip(*map(source, range(_JUDGED)), strict=True)))
    layers = library.adapter.layers
    return np.array([_sampled_log_loss(jnp.asarray(code), layers, batches, recipe) for code in codes])


@partial(jax.jit, static_argnames="recipe")
def _sampled_log_loss(code: jax.Array, layers: Any, batches: Batch, recipe: Recipe) -> jax.Array:
    def of_batch(batch: Batch) -> jax.Array:
        columns: Any = jnp.broadcast_to(code[:, None], (len(code), len(batch.mu)))
        batch = batch._replace(columns=columns)
        return distance(bin_means(brdf_of(layers, batch, recipe), batch, recipe), batch, recipe)[1]

    return jax.lax.map(of_batch, batches).mean()
