"""A network that evaluates f cos(theta_o) directly: a latent code per material, and a decoder with a million weights.

The size of the latent code, and roughly the size of the decoder, are those that the NMA paper states for Fan et al.
2022, "Neural Layered BRDFs". The weights and data of Fan et al. are not available, so all other choices are our own. To
make the comparison fair, the network's inputs are half-vector coordinates (Rusinkiewicz 1998), in which highlights have
a simple shape. The network is trained with the adapter's data, loss and optimiser.
"""

from __future__ import annotations

from collections.abc import Callable
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
# The output layer's initial biases make the untrained network return values of log(1 + f cos(theta_o)) near _INITIAL.
_INITIAL = 0.05
# The network's inputs hardly change for half angles whose sine is far below _SHARPEST.
_SHARPEST = 1e-3


class Evaluator(NamedTuple):
    """Latent codes (materials, LATENT), and a decoder that computes log(1 + f cos(theta_o)) from a code and two
    directions."""

    latents: Any
    decoder: Layers


def recipe(steps: int, network_name: str, seed: int = 0) -> Recipe:
    """Returns the adapters' recipe, with a few settings changed for the direct evaluator."""
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
    """Returns latent codes and a decoder with random values, drawn with the recipe's seed."""
    rng = np.random.default_rng((how.seed, 0xD1EC7))
    sizes = [LATENT + FEATURES, *network.hidden(how.network), 3]
    decoder = network.init(rng, sizes, np.full(3, np.log(np.expm1(_INITIAL))))
    rng = np.random.default_rng((how.seed, 0x1A7E))
    return Evaluator(0.1 * rng.standard_normal((materials, LATENT), dtype=np.float32), decoder)


def evaluate(decoder: Layers, latent: Any, wi: Vec3, wo: Vec3) -> Any:
    """Returns f cos(theta_o) [1/sr] as a JAX array (..., 3) for the latent codes `latent` (..., LATENT)."""
    seen = jnp.stack(_features(wi, wo), axis=-1)
    latent = jnp.broadcast_to(latent, (*seen.shape[:-1], LATENT))
    return jnp.expm1(jax.nn.softplus(network.forward(decoder, jnp.concatenate([latent, seen], axis=-1))))


def _features(wi: Vec3, wo: Vec3) -> list[Any]:
    """Returns the network's inputs, scaled to about -1 .. 1.

    The inputs are the cosines of four angles (theta_i, theta_o, the half angle, the difference angle), the logarithm of
    the half angle's sine, and the cosine of the azimuth between wi and wo.
    """
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
    """Trains latent codes for the tables' materials, and continues from the checkpoint if the checkpoint's file exists.

    Args:
        decoder: a decoder that stays fixed; if None, a new decoder is trained together with the latent codes.
    """
    fresh = start(len(tables.params), how)
    begin = fresh if decoder is None else fresh._replace(decoder=decoder)
    run = loop.resume(how, begin, checkpoint, record)
    pool, sampler = Pool.numbered(tables), BinSampler(how.bins_law)
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


def _objective(evaluator: Evaluator, batch: Batch, how: Recipe) -> tuple[jax.Array, jax.Array]:
    """Returns the adapter's loss, with the bin's mean estimated from one random point in the bin."""
    points = quadrature.uniform_bin_points(batch.i, batch.o, batch.p, tuple(batch.shift))
    latent = evaluator.latents[batch.columns[0].astype(jnp.int32)]
    wi = Vec3(*(jnp.broadcast_to(x, points.wo.z.shape) for x in points.wi))
    value = evaluate(evaluator.decoder, latent, wi, points.wo)
    return distance(jnp.moveaxis(value, -1, 0), batch, how)


def _latents_alone(evaluator: Evaluator, batch: Batch, how: Recipe) -> tuple[jax.Array, jax.Array]:
    """Returns the same loss as `_objective`, but without gradients for the decoder, which stays fixed."""
    return _objective(evaluator._replace(decoder=jax.lax.stop_gradient(evaluator.decoder)), batch, how)
