"""The best constant parameters of one plain Principled BRDF for a material: no network, no direction, no blend."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from nma import target
from nma.adapter import Adapter
from nma.errors import TableError
from nma.evaluate import evaluate, tabulate_adapter
from nma.evaluate.metrics import table_metrics
from nma.ops import Color
from nma.params import SPACES
from nma.table import ISOTROPIC, Tables
from nma.target import PRINCIPLED_PARAMS, Blend, Brdf, Principled, TargetParam
from nma.train import loop
from nma.train.batches import Batch, BinSampler, Pool, draw
from nma.train.loss import brdf_loss
from nma.train.recipe import Recipe
from nma.train.run import record_of

# The paper's 11 numbers and the fake subsurface. `anisotropic` stays 0: tables of isotropic materials do not know it.
CONSTANT_PARAMS = (*PRINCIPLED_PARAMS, TargetParam("flatness"))

# Many points in few bins: eq. 7 takes the noise of a bin's average for an error, and a fit avoids what is noisy. With 4
# points per bin, that of a Principled BRDF's own table ended at a log loss of .0023, with 64 at .00015, for a best of
# .00014. The log loss alone leaves out what is bright and narrow: copper under a blue medium and a smooth coat became
# 14 % too dark, with this weight of the albedo 1 %, for a log loss of .0172 instead of .0145.
CONSTANT = Recipe(
    network="none",
    instances=1,
    directional=False,
    bounded=False,
    encoding="direction",
    rows=32,
    bins_per_row=8,
    points=64,
    albedo=1.0,
    learning_rate=0.2,
    average=0.98,
    steps=800,
)

# Where the fits start, as the problem has many local minima. The table says which base colour.
_GREY = Color(0.5, 0.5, 0.5)
_STARTS = {
    "diffuse": Principled(_GREY, 0.6, 0.05, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
    "glossy": Principled(_GREY, 0.15, 0.05, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
    "coated": Principled(_GREY, 0.5, 0.5, 0.5, 0.1, 0.1, 0.5, 0.8, 0.8, flatness=0.1),
    "rough metal": Principled(_GREY, 0.5, 0.95, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
    "smooth metal": Principled(_GREY, 0.15, 0.95, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
}

# cos(theta_i) per row of the table that tell which fit is best.
_DIRECTIONS = 16


class Constant(NamedTuple):
    """Plain numbers, their log loss (eq. 7) and all other figures over the whole table, and the numbers as an adapter
    that looks at nothing. `brightness` is the light they reflect from all directions together over the material's."""

    principled: Principled
    log_loss: float
    figures: dict[str, float]
    adapter: Adapter
    brightness: float


class _Judged(NamedTuple):
    """How far a fit is from the table, quickly integrated."""

    log_loss: float
    albedo_error: float
    brightness: float

    def score(self, recipe: Recipe) -> float:
        """What fits are chosen by: the albedo weighs as much as it did in them."""
        return self.log_loss + recipe.albedo * self.albedo_error**2


def fit_constant(
    tables: Tables,
    recipe: Recipe = CONSTANT,
    record: dict[str, Any] | None = None,
    *,
    progress: Callable[[loop.Run], None] = lambda run: None,
) -> Constant:
    """Fits the isotropic table of one material from several starting points, and keeps the best by log loss and albedo.

    `record` says where the table comes from and is stored with the adapter. Equal arguments give equal results on one
    machine. Raises `TableError` for several materials and for tables of other bins.
    """
    if len(tables.values) != 1:
        raise TableError(f"constant parameters describe one material, the table has {len(tables.values)}")
    if tables.values.shape[1:] != ISOTROPIC.shape:
        raise TableError(
            f"constant parameters are fitted to isotropic tables {ISOTROPIC.shape}, "
            f"this one has {tables.values.shape[1:]}"
        )
    pool, sampler = Pool.of(tables), BinSampler(recipe.bins_law)
    run = loop.start(recipe, _starts(tables))
    loop.train(
        recipe, run, lambda step: draw(pool, sampler, recipe, step), objective=_objective, progress=progress
    )
    record = {**(record or {}), "params": tables.params[0].tolist(), **record_of(recipe, run)}
    fits = {
        start: _adapter(tables, raw, {**record, "start": start})
        for start, raw in zip(_STARTS, loop.result(run, recipe), strict=True)
    }
    judged = {start: _judge(adapter, tables) for start, adapter in fits.items()}
    best = min(judged, key=lambda start: judged[start].score(recipe))
    adapter, figures = fits[best], evaluate(fits[best], tables).mean
    adapter.training.update(
        {
            "log_loss": figures["log_loss"],
            "albedo_error": figures["albedo_error"],
            "log_loss_of_starts": {start: j.log_loss for start, j in judged.items()},
            "albedo_error_of_starts": {start: j.albedo_error for start, j in judged.items()},
        }
    )
    return Constant(_plain(adapter), figures["log_loss"], figures, adapter, judged[best].brightness)


def _judge(adapter: Adapter, tables: Tables) -> _Judged:
    own = tabulate_adapter(adapter, tables.params, directions=_DIRECTIONS)[0]
    figures = table_metrics(own, tables.values[0], np.zeros_like(own))
    light = float(tables.values[0].mean(dtype=np.float64))
    brightness = float(own.mean(dtype=np.float64)) / light if light > 0 else 1.0
    return _Judged(figures["log_loss"], figures["albedo_error"], brightness)


def _starts(tables: Tables) -> NDArray[np.float32]:
    """Raw numbers (starts, numbers of the target), whose base colour is the table's mean albedo."""
    base_color = Color(*np.clip(tables.albedo()[0].mean(axis=0), 0.02, 0.98))
    blends = [Blend((p._replace(base_color=base_color),), (1.0,)) for p in _STARTS.values()]
    return np.array([target.encode(b, CONSTANT_PARAMS) for b in blends], np.float32)


def _objective(raw: jax.Array, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """The sum over all fits, as none knows of the others, and the log loss of the best."""

    def one(numbers: jax.Array) -> tuple[jax.Array, jax.Array]:
        return brdf_loss(Brdf(target.decode(list(numbers), 1, CONSTANT_PARAMS)), batch, recipe)

    totals, log_losses = jax.vmap(one)(raw)
    return totals.sum(), log_losses.min()


def _adapter(tables: Tables, raw: NDArray[np.float32], record: dict[str, Any]) -> Adapter:
    """An adapter whose network is its output's bias alone."""
    size = tables.params.shape[1]
    space = next(s for s in SPACES.values() if s.size == size)
    layers = [(np.zeros((len(raw), 1), np.float32), np.asarray(raw, np.float32))]
    return Adapter(space, "direction", layers, 1, False, CONSTANT_PARAMS, record)


def _plain(adapter: Adapter) -> Principled:
    """The adapter's only instance, as Python's floats."""
    flat = adapter.numbers(np.zeros((1, adapter.space.size)), [0.5])[0, 0].tolist()
    (p,) = target.from_numbers(flat, CONSTANT_PARAMS).instances
    return p
