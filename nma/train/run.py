"""Trains an adapter from tables: for a whole class (`train_class`), or for one material of a class (`fit_material`)."""

from __future__ import annotations

import importlib.metadata
import platform
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from nma import network, target
from nma.adapter import Adapter, encoding
from nma.network import Layers
from nma.ops import Color
from nma.params import ParamSpace
from nma.table import Tables
from nma.table.dataset import Settings
from nma.table.grid import check_class
from nma.target import Blend, Principled
from nma.train import loop
from nma.train.batches import BinSampler, Pool, Stream, draw
from nma.train.recipe import Recipe

# The blend at which training starts: two grey, half metallic instances, of which the first is rough and the second
# smooth.
_INITIAL = Blend(
    (
        Principled(Color(0.5, 0.5, 0.5), 0.5, 0.5, 0.5, 0.1, 0.1, 0.1, 0.1, 0.5, 0.0, 0.1, 0.0, 0.12),
        Principled(Color(0.5, 0.5, 0.5), 0.15, 0.5, 0.5, 0.1, 0.1, 0.1, 0.1, 0.5, 0.0, 0.1, 0.0, 0.12),
    ),
    (0.6, 0.4),
)


def initial_layers(recipe: Recipe, space: ParamSpace) -> Layers:
    """Random layers, determined by the recipe's seed, whose outputs are close to the blend `_INITIAL`."""
    instances = tuple(_INITIAL.instances[k % 2] for k in range(recipe.instances))
    blend = Blend(instances, (1.0 / recipe.instances,) * recipe.instances)
    params = target.TARGETS[recipe.target]
    bias = np.array(target.encode(blend if recipe.instances != 2 else _INITIAL, params))
    inputs = encoding.size(recipe.encoding, space, recipe.directional)
    sizes = [inputs, *network.hidden(recipe.network), target.output_size(recipe.instances, params)]
    return network.init(np.random.default_rng((recipe.seed, 0x1417)), sizes, bias)


def train_class(
    space: ParamSpace,
    recipe: Recipe,
    data: Tables | Settings,
    record: dict[str, Any],
    *,
    checkpoint: Path | None = None,
    refresh: int = 400,
    progress: Callable[[loop.Run], None] = lambda run: None,
    budget_seconds: float = float("inf"),
) -> tuple[Adapter, loop.Run]:
    """Trains an adapter on tables of many materials. Returns the adapter and the run.

    `record` says where the tables come from and is stored with the weights. If `data` is `Settings` instead of tables,
    materials are simulated during training. In this case `data.materials` materials are in memory, and every `refresh`
    steps a block of new materials replaces the oldest block. Raises `TableError` if the data is of another class than
    `space`.
    """
    check_class(data.class_name, space.name, "the adapter")
    sampler = BinSampler(recipe.bins_law, recipe.grid)
    layers = initial_layers(recipe, space)
    run = (
        loop.resume(recipe, layers, checkpoint, record) if checkpoint else loop.start(recipe, layers, record)
    )
    pool = Stream(data, refresh, run.step) if isinstance(data, Settings) else _constant(Pool.of(data))
    loop.train(
        recipe,
        run,
        lambda step: draw(pool(step), sampler, recipe, step),
        checkpoint=checkpoint,
        progress=progress,
        budget_seconds=budget_seconds,
    )
    return adapter_of(space, recipe, run, record), run


def _constant(pool: Pool) -> Callable[[int], Pool]:
    return lambda step: pool


def fit_material(
    space: ParamSpace,
    recipe: Recipe,
    params: NDArray[np.float64],
    tables: Tables,
    record: dict[str, Any],
    *,
    progress: Callable[[loop.Run], None] = lambda run: None,
    budget_seconds: float = float("inf"),
) -> tuple[Adapter, loop.Run]:
    """Trains an adapter on the table of one material only (paper Fig. 4, left).

    Raises `ParamError` for parameters that the class does not allow, because the weights file records them.
    """
    space.check(params)
    record = {**record, "params": np.asarray(params).ravel().tolist()}
    return train_class(space, recipe, tables, record, progress=progress, budget_seconds=budget_seconds)


def adapter_of(space: ParamSpace, recipe: Recipe, run: loop.Run, record: dict[str, Any]) -> Adapter:
    """The adapter of a training run, with the record of the run."""
    tail = run.log_losses[-1000:]
    training = {
        **record,
        **record_of(recipe, run),
        "bins_seen": run.step * recipe.bins_per_step,
        "log_loss_of_last_1000_steps": float(np.mean(tail)) if tail else None,
        "device": jax.devices()[0].device_kind,
        "machine": platform.machine(),
    }
    return Adapter(
        space,
        recipe.encoding,
        loop.result(run, recipe),
        recipe.instances,
        recipe.directional,
        target.TARGETS[recipe.target],
        training,
        recipe.bounds_energy,
    )


def record_of(recipe: Recipe, run: loop.Run) -> dict[str, Any]:
    """The entries of the training record that all runs have."""
    return {
        "recipe": asdict(recipe),
        "steps": run.step,
        "seconds": round(run.seconds, 1),
        "version": importlib.metadata.version("neural-material-adapter"),
        "jax": jax.__version__,
        "date": time.strftime("%Y-%m-%d"),
    }
