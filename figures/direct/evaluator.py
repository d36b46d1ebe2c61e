"""A network that evaluates f cos(theta_o) itself: a latent per material, and a decoder of about a million weights.

The latent size, and roughly the decoder size, are those of Fan et al. 2022, "Neural Layered BRDFs", as the NMA paper
states them. Their weights and data are not available, so everything else is ours. To make the comparison fair, the
network sees half-vector coordinates (Rusinkiewicz 1998), in which highlights are simple, and it learns with the
adapter's data, loss and optimiser.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nma
from nma import network, ops
from nma.network import Layers
from nma.ops import Vec3
from nma.table import quadrature
from nma.train import loop
from nma.train.batches import Batch, BinSampler, Pool, draw
from nma.train.loss import distance
from nma.train.recipe import Recipe, preset

LATENT = 32
FEATURES = 6
# The untrained network predicts about this value of log(1 + f cos).
_INITIAL = 0.05
# The network cannot tell half vectors apart whose sines are far below this value.
_SHARPEST = 1e-3


class Evaluator(NamedTuple):
    """What is trained: latents (materials, LATENT), and a decoder from latent and directions to log(1 + f cos)."""

    latents: Any
    decoder: Layers


def recipe(steps: int, network_name: str, seed: int = 0) -> Recipe:
    """The adapter's recipe as far as it applies: data, bins, loss, schedule and averaging of weights."""
    return preset(
        "class",
        network=network_name,
        rows=256,
        albedo=0.0,
        points=1,
        points_law="uniform",
        learning_rate=1e-3,
        steps=steps,
        seed=seed,
    )


def start(materials: int, how: Recipe) -> Evaluator:
    """Random latents and layers, from the recipe's seed."""
    rng = np.random.default_rng((how.seed, 0xD1EC7))
    sizes = [LATENT + FEATURES, *network.hidden(how.network), 3]
    decoder = network.init(rng, sizes, np.full(3, np.log(np.expm1(_INITIAL))))
    rng = np.random.default_rng((how.seed, 0x1A7E))
    return Evaluator(0.1 * rng.standard_normal((materials, LATENT), dtype=np.float32), decoder)


def evaluate(decoder: Layers, latent: Any, wi: Vec3, wo: Vec3) -> Any:
    """f cos(theta_o) [1/sr], (..., 3), as a JAX array; `latent` has the shape (..., LATENT)."""
    seen = jnp.stack(_features(wi, wo), axis=-1)
    latent = jnp.broadcast_to(latent, (*seen.shape[:-1], LATENT))
    return jnp.expm1(jax.nn.softplus(network.forward(decoder, jnp.concatenate([latent, seen], axis=-1))))


def _features(wi: Vec3, wo: Vec3) -> list[Any]:
    """The network's inputs, about -1 .. 1: the cosines of wi, wo, half angle and difference angle, the logarithm of the
    half angle's sine, and the cosine of the azimuth."""
    half = ops.normalize(wi + wo)
    sine = ops.safe_sqrt(half.x * half.x + half.y * half.y)
    narrow = ops.log(sine + _SHARPEST) / np.log(_SHARPEST)
    flat = ops.safe_sqrt((1.0 - wi.z * wi.z) * (1.0 - wo.z * wo.z)) + 1e-6
    azimuth = (wi.x * wo.x + wi.y * wo.y) / flat
    found = (wi.z, wo.z, half.z, ops.dot(wi, half), narrow)
    return [*(2.0 * x - 1.0 for x in found), azimuth]


def train(
    tables: nma.Tables,
    how: Recipe,
    record: dict[str, Any],
    checkpoint: Path,
    progress: Callable[[loop.Run], None],
    decoder: Layers | None = None,
) -> tuple[Evaluator, loop.Run]:
    """Trains the latents of the tables' materials, and continues from the checkpoint if there is one.

    Args:
        decoder: a decoder that stays fixed; if None, the decoder is trained with the latents.
    """
    fresh = start(len(tables.params), how)
    begin = fresh if decoder is None else fresh._replace(decoder=decoder)
    run = loop.resume(how, begin, checkpoint, record)
    pool, sampler = _numbered(tables), BinSampler(how.bins_law)
    objective = _objective if decoder is None else _latents_alone
    loop.train(
        how,
        run,
        lambda step: draw(pool, sampler, how, step),
        objective=objective,
        checkpoint=checkpoint,
        progress=progress,
    )
    return loop.result(run, how), run


def _numbered(tables: nma.Tables) -> Pool:
    """A pool of the tables. The only parameter of a material is its number, which selects its latent."""
    numbers = np.arange(len(tables.params), dtype=np.float64)[:, None]
    return Pool.of(replace(tables, params=numbers))


def _objective(evaluator: Evaluator, batch: Batch, how: Recipe) -> tuple[jax.Array, jax.Array]:
    """The adapter's loss; one random point in each bin stands for the bin's mean."""
    points = quadrature.uniform_bin_points(batch.i, batch.o, batch.p, tuple(batch.shift))
    latent = evaluator.latents[batch.columns[0].astype(jnp.int32)]
    wi = Vec3(*(jnp.broadcast_to(x, points.wo.z.shape) for x in points.wi))
    value = evaluate(evaluator.decoder, latent, wi, points.wo)
    return distance(jnp.moveaxis(value, -1, 0), batch, how)


def _latents_alone(evaluator: Evaluator, batch: Batch, how: Recipe) -> tuple[jax.Array, jax.Array]:
    """As `_objective`, but the decoder stays fixed."""
    return _objective(evaluator._replace(decoder=jax.lax.stop_gradient(evaluator.decoder)), batch, how)
