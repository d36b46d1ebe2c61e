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
from nma.errors import NmaError
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
# The same for instances under an interface: a metal, and what the layers between scatter. Six fields have no meaning
# under an interface.
_UNUSED_BELOW = (0.0,) * 6
_INITIAL_BELOW = Blend(
    (
        Principled(Color(0.6, 0.6, 0.6), 0.35, 0.95, *_UNUSED_BELOW, flatness=0.2, veil=0.9),
        Principled(Color(0.4, 0.4, 0.4), 0.7, 0.3, *_UNUSED_BELOW, flatness=0.2, veil=0.9),
    ),
    (0.8, 0.2),
)


def initial_layers(recipe: Recipe, space: ParamSpace) -> Layers:
    """Random layers, determined by the recipe's seed, whose outputs are close to the blend `_INITIAL` or
    `_INITIAL_BELOW`.

    Raises `NmaError` if the target lies under an interface, but the class has none.
    """
    if recipe.target == "interface" and space.interface is None:
        raise NmaError(
            f"the class {space.name} has no interface, under which the target 'interface' lies; choose the target "
            "'stretched'"
        )
    start = _INITIAL_BELOW if recipe.target == "interface" else _INITIAL
    instances = tuple(start.instances[k % 2] for k in range(recipe.instances))
    blend = Blend(instances, (1.0 / recipe.instances,) * recipe.instances)
    params = recipe.params
    bias = np.array(target.encode(blend if recipe.instances != 2 else start, params))
    inputs = encoding.size(recipe.encoding, space, recipe.directional)
    sizes = [inputs, *network.hidden(recipe.network), target.output_size(recipe.instances, params)]
    skip = _estimates(recipe, inputs, len(bias))
    if skip is not None:
        bias[skip.any(axis=1)] = 0.0
    return network.init(np.random.default_rng((recipe.seed, 0x1417)), sizes, bias, skip)


def _estimates(recipe: Recipe, inputs: int, outputs: int) -> NDArray[np.float32] | None:
    """The weights (outputs, inputs) by which the last layer passes on estimates among the inputs to the outputs that
    they estimate. None if the recipe's encoding has no estimates."""
    estimated = encoding.ESTIMATES.get(recipe.encoding, ())
    names = [p.name for p in recipe.params for _ in range(p.size)]
    rows = [names.index(name) + k for name in estimated for k in range(names.count(name))]
    if not rows:
        return None
    skip = np.zeros((outputs, inputs), np.float32)
    skip[rows, np.arange(inputs - len(rows), inputs)] = encoding.ESTIMATE_UNIT
    return skip


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
        recipe.params,
        training,
        recipe.bounds_energy,
        space.interface if recipe.target == "interface" else None,
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
