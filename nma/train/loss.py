"""The loss of a batch: Average-vs-Average (paper eq. 6) in the log domain (eq. 7).

Functions that use only the rows of a batch also accept batches of points (`nma.train.points`).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from nma import network, target
from nma.adapter import encoding
from nma.lattice import lattice_points
from nma.network import Layers
from nma.ops import Vec3
from nma.table import quadrature
from nma.target import Brdf
from nma.train.batches import Batch
from nma.train.recipe import Recipe

# The Huber loss is quadratic for residuals of the logarithm up to `_TOLERANCE`, even in a bin with hardly any noise.
_TOLERANCE = 0.003


def network_outputs(layers: Layers, batch: Any, recipe: Recipe) -> jax.Array:
    """The raw outputs (rows, outputs) of the network. The network runs once per row, at the row's `mu`."""
    wi = view(batch)
    inputs = encoding.get(recipe.encoding)(list(batch.columns), wi if recipe.directional else None)
    return network.forward(layers, jnp.stack([jnp.broadcast_to(x, batch.mu.shape) for x in inputs], axis=-1))


def brdf_of(layers: Layers, batch: Any, recipe: Recipe) -> Brdf:
    """The target of each row; its parameters have the shape (rows,).

    In isotropic batches wi has azimuth 0, so the frame of the plane of incidence equals the local frame.
    """
    raw = network_outputs(layers, batch, recipe)
    interface = target.Interface(*batch.interface) if recipe.target == "interface" else None
    blend = target.decode(list(raw.T), recipe.instances, recipe.params, batch.mu, interface)
    return Brdf(target.bounded(blend, batch.mu) if recipe.bounds_energy else blend)


def bin_means(brdf: Brdf, batch: Batch, recipe: Recipe) -> jax.Array:
    """The target's mean over each bin, (3, bins_per_row, rows)."""
    points = _points(batch, recipe)
    value = brdf.eval(points.wi, points.wo)
    return jnp.stack([(c * points.weight).mean(axis=0) for c in value])


def view(batch: Any) -> Vec3:
    """The direction wi of each row, (rows,)."""
    sin = jnp.sqrt(1.0 - batch.mu * batch.mu)
    return Vec3(sin * jnp.cos(batch.phi), sin * jnp.sin(batch.phi), batch.mu)


def _points(batch: Batch, recipe: Recipe) -> quadrature.Points:
    """The points (points, bins_per_row, rows) of every bin."""
    if recipe.points_law == "centre":
        u: Any = (0.5 + 0.0 * batch.shift)[:, None]
    else:
        lattice = jnp.asarray(lattice_points(recipe.points, len(batch.shift)), jnp.float32)
        u = (lattice.T[:, :, None, None] + batch.shift[:, None]) % 1.0
    finest = recipe.finest if recipe.points_law == "crowded" else None
    return quadrature.points((batch.i, batch.a, batch.o, batch.p), tuple(u), recipe.grid, finest)


def albedos(brdf: Brdf, batch: Any, recipe: Recipe) -> jax.Array:
    """Two independent unbiased estimates (2, 3, rows) of the target's directional albedo, from samples of its lobes.

    Derivatives treat the sampled directions and their densities as constants, so the derivatives are unbiased, too.
    Estimates are not clipped, because clipping would bias them.
    """
    lattice = jnp.asarray(lattice_points(recipe.albedo_samples), jnp.float32).T[:, None, :, None]
    u = (lattice + batch.albedo_shift[:, :, None]) % 1.0  # (3, 2, samples, rows)
    wi = view(batch)
    wo, _, pdf = jax.lax.stop_gradient(brdf).sample(wi, *u)
    value = brdf.eval(wi, wo)
    weight = jnp.where(pdf > 0, 1.0 / jnp.maximum(pdf, 1e-9), 0.0)
    return jnp.stack([(c * weight).mean(axis=1) for c in value], axis=1)


def loss(layers: Layers, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """The loss to minimise, and the log loss of eq. 7 against the noisy tables."""
    return brdf_loss(brdf_of(layers, batch, recipe), batch, recipe)


def brdf_loss(brdf: Brdf, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """The same as `loss`, for a target whose parameters are constants, or have the shape (rows,)."""
    total, log_loss = distance(bin_means(brdf, batch, recipe), batch, recipe)
    return total + albedo_loss(brdf, batch, recipe), log_loss


def albedo_loss(brdf: Brdf, batch: Any, recipe: Recipe) -> jax.Array | float:
    """The squared error of the directional albedo, absolute or relative, times its weight in the recipe."""
    if not recipe.albedo > 0:
        return 0.0
    # The loss is the product of the errors of two independent estimates, because the expected product does not contain
    # the variance of the estimates. The squared error of a single estimate would contain the variance.
    first, second = albedos(brdf, batch, recipe) - batch.albedo
    scale = 1.0
    if recipe.albedo_floor > 0:
        scale = 1.0 / (batch.albedo + recipe.albedo_floor)
    return recipe.albedo * (first * second * scale * scale).mean()


def distance(mean: jax.Array, batch: Batch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """Compares the target's bin means (3, bins_per_row, rows) with the values of the tables.

    Returns the error measure that the recipe's `loss` names, and the log loss.
    """
    residual = jnp.log1p(mean) - jnp.log1p(batch.value)
    log_loss = (jnp.abs(residual) * batch.weight).mean()
    if recipe.loss == "log":
        return log_loss, log_loss
    # `emphasis` adds the error of the value itself, with the weight `energy`. If log(1 + value) has the error d, the
    # value has an error of about (1 + value) d.
    emphasis = 1.0 + recipe.energy * (1.0 + batch.value)
    total = (_huber(mean, batch, 1.0) * emphasis * batch.weight).mean()
    if recipe.dim > 0:
        total = total + recipe.dim * (_huber(mean, batch, recipe.dim_floor) * batch.weight).mean()
    return total, log_loss


def _huber(mean: jax.Array, batch: Batch, floor: float) -> jax.Array:
    """The Huber loss of the error of log(`floor` + value), quadratic within three standard errors of the table."""
    residual = jnp.log(floor + mean) - jnp.log(floor + batch.value)
    # sigma is the standard error of the residual, from counting statistics. Each walk that ends in a bin adds `quantum`
    # to the bin's value, so a bin of mean value `expected` has about expected / quantum walks. One walk is added, so
    # that sigma is never 0.
    expected = jax.lax.stop_gradient(mean)
    sigma = jnp.sqrt(batch.quantum * (expected + batch.quantum)) / (floor + expected)
    width = 3.0 * sigma + _TOLERANCE
    size = jnp.abs(residual)
    return jnp.where(size < width, 0.5 * residual * residual / width, size - 0.5 * width)
