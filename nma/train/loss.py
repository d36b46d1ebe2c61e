"""The loss of a batch: Average-vs-Average (paper eq. 6) in the log domain (eq. 7)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from nma import ava, encoding, network, target
from nma.network import Layers
from nma.train.data import Batch
from nma.train.recipe import Recipe

# Residuals of the log domain that the Huber loss treats as noise even where a bin has hardly any.
_TOLERANCE = 0.003


def bin_means(layers: Layers, batch: Batch, recipe: Recipe) -> jax.Array:
    """The target's mean over each bin, (3, bins_per_row, rows), for one pass of the network per row."""
    inputs = encoding.get(recipe.encoding)(list(batch.columns), batch.mu if recipe.directional else None)
    stacked = jnp.stack([jnp.broadcast_to(x, batch.mu.shape) for x in inputs], axis=-1)
    raw = network.forward(layers, stacked)
    points = _points(batch, recipe)
    value = target.eval(target.decode(list(raw.T), recipe.instances), points.wi, points.wo)
    return jnp.stack([(c * points.weight).mean(axis=0) for c in value])


def _points(batch: Batch, recipe: Recipe) -> ava.Points:
    """Points (points, bins_per_row, rows) of every bin."""
    if recipe.points_law == "centre":
        middle = (0.5 + 0.0 * batch.shift)[:, None]
        return ava.uniform_bin_points(batch.i, batch.o, batch.p, tuple(middle))
    lattice = jnp.asarray(ava.lattice(recipe.points), jnp.float32).T[:, :, None, None]
    u = (lattice + batch.shift[:, None]) % 1.0
    if recipe.points_law == "uniform":
        return ava.uniform_bin_points(batch.i, batch.o, batch.p, tuple(u))
    return ava.bin_points(batch.i, batch.o, batch.p, tuple(u), finest=recipe.finest)


def loss(layers: Layers, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """(what is minimised, the log loss of eq. 7 against the noisy tables)."""
    mean = bin_means(layers, batch, recipe)
    residual = jnp.log1p(mean) - jnp.log1p(batch.value)
    log_loss = (jnp.abs(residual) * batch.weight).mean()
    if recipe.loss == "log":
        return log_loss, log_loss
    # Counting noise of the bin under the model: about mean / quantum walks, at least the noise of a single one.
    expected = jax.lax.stop_gradient(mean)
    sigma = jnp.sqrt(batch.quantum * (expected + batch.quantum)) / (1.0 + expected)
    width = 3.0 * sigma + _TOLERANCE
    size = jnp.abs(residual)
    huber = jnp.where(size < width, 0.5 * residual * residual / width, size - 0.5 * width)
    # An error d of the logarithm is an error (1 + value) d of the value itself.
    emphasis = 1.0 + recipe.energy * (1.0 + batch.value)
    return (huber * emphasis * batch.weight).mean(), log_loss
