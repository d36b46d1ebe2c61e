"""Fits one Principled BRDF with constant parameters to a material, for `nma principled`.

The parameters do not depend on the direction, so no network is needed. The result is a single BRDF, not a blend.
`nma.train.fit` fits an adapter, whose network and blend follow the material more closely.
"""

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
from nma.table import ISOTROPIC, Tables
from nma.target import PRINCIPLED_PARAMS, Blend, Brdf, Principled, TargetParam
from nma.train import loop
from nma.train.batches import Batch, BinSampler, Pool, draw
from nma.train.loss import brdf_loss
from nma.train.recipe import Recipe
from nma.train.run import record_of

# The paper's 11 parameters and `flatness`, the fake subsurface. `anisotropic` stays 0, because isotropic tables cannot
# determine this parameter.
CONSTANT_PARAMS = (*PRINCIPLED_PARAMS, TargetParam("flatness"))

# A step has few bins, but many points in each bin. With few points, the averages of narrow lobes are noisy, and eq. 7
# counts the noise of an average as an error, so fits would avoid narrow lobes. A Principled BRDF fitted to its own
# table ended at a log loss of .0023 with 4 points per bin, and at .00015 with 64 points; the best possible log loss is
# .00014. The log loss alone neglects bright, narrow lobes. When copper under a blue medium and a smooth coat was fitted
# without the albedo error, the fit was 14 % too dark. With `albedo` = 1 (the weight of the albedo error), the fit of
# the same material was 1 % too dark, at a log loss of .0172 instead of .0145.
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

# Starting points of the fits. There are several starting points, because the loss has many local minima. The base
# colour of each starting point is replaced by the mean albedo of the table.
_GREY = Color(0.5, 0.5, 0.5)
_STARTS = {
    "diffuse": Principled(_GREY, 0.6, 0.05, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
    "glossy": Principled(_GREY, 0.15, 0.05, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
    "coated": Principled(_GREY, 0.5, 0.5, 0.5, 0.1, 0.1, 0.5, 0.8, 0.8, flatness=0.1),
    "rough metal": Principled(_GREY, 0.5, 0.95, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
    "smooth metal": Principled(_GREY, 0.15, 0.95, 0.5, 0.1, 0.1, 0.5, 0.05, 0.5, flatness=0.1),
}

# Number of cosines cos(theta_i) per row of the table at which fits are compared.
_DIRECTIONS = 16


class Constant(NamedTuple):
    """Result of `fit_constant`.

    `principled`: the parameters as floats. `log_loss` (eq. 7) and `figures`: errors over the whole table. `adapter`: an
    adapter with the fitted parameters, whose network has no inputs. `brightness`: the light that the fitted BRDF
    reflects, summed over all directions, divided by the light that the material reflects.
    """

    principled: Principled
    log_loss: float
    figures: dict[str, float]
    adapter: Adapter
    brightness: float


class _Judged(NamedTuple):
    """Errors of a fit against the table, from a quick integration."""

    log_loss: float
    albedo_error: float
    brightness: float

    def score(self, recipe: Recipe) -> float:
        """The log loss plus the weighted albedo error, as in the loss of the fits.

        The fit with the lowest score is chosen.
        """
        return self.log_loss + recipe.albedo * self.albedo_error**2


def fit_constant(
    tables: Tables,
    recipe: Recipe = CONSTANT,
    record: dict[str, Any] | None = None,
    *,
    progress: Callable[[loop.Run], None] = lambda run: None,
) -> Constant:
    """Fits the isotropic table of one material from several starting points, and returns the fit with the lowest score.

    `record` says where the table comes from and is stored with the adapter. Equal arguments give equal results on the
    same machine. Raises `TableError` if the table has several materials or another grid, and `ParamError` for
    parameters that the class does not allow.
    """
    if len(tables.values) != 1:
        raise TableError(
            f"constant parameters describe one material, but the table has {len(tables.values)} materials"
        )
    if tables.values.shape[1:] != ISOTROPIC.shape:
        raise TableError(
            f"constant parameters are fitted to isotropic tables of shape {ISOTROPIC.shape}, "
            f"but this table has the shape {tables.values.shape[1:]}"
        )
    tables.check_params()  # the weights file records the parameters
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
    """The starting points of the fit, as encoded parameters (starts, outputs).

    The base colour of every starting point is the table's mean albedo.
    """
    base_color = Color(*np.clip(tables.albedo()[0].mean(axis=0), 0.02, 0.98))
    blends = [Blend((p._replace(base_color=base_color),), (1.0,)) for p in _STARTS.values()]
    return np.array([target.encode(b, CONSTANT_PARAMS) for b in blends], np.float32)


def _objective(raw: jax.Array, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """Returns the sum of the losses of all fits, and the log loss of the best fit.

    The fits are independent of each other, so minimising the sum minimises each loss.
    """

    def one(numbers: jax.Array) -> tuple[jax.Array, jax.Array]:
        return brdf_loss(Brdf(target.decode(list(numbers), 1, CONSTANT_PARAMS)), batch, recipe)

    totals, log_losses = jax.vmap(one)(raw)
    return totals.sum(), log_losses.min()


def _adapter(tables: Tables, raw: NDArray[np.float32], record: dict[str, Any]) -> Adapter:
    """An adapter whose network consists of the output layer's bias alone."""
    layers = [(np.zeros((len(raw), 1), np.float32), np.asarray(raw, np.float32))]
    return Adapter(tables.space, "direction", layers, 1, False, CONSTANT_PARAMS, record)


def _plain(adapter: Adapter) -> Principled:
    """The adapter's only BRDF instance, as Python floats."""
    flat = adapter.numbers(np.zeros((1, adapter.space.size)), [0.5])[0, 0].tolist()
    (p,) = target.from_numbers(flat, CONSTANT_PARAMS).instances
    return p
