"""Training data for sources whose values are known (`Values`): their values at pairs of directions.

A table has only the averages over bins, so for a table the target must be averaged, too, by default over 8 points per
bin. A source with known values is compared with the target at single pairs of directions, so each comparison needs only
one evaluation of the target.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import SourceError
from nma.jit import dr
from nma.lattice import lattice_points
from nma.microfacet import visible_normal_pdf
from nma.ops import Vec3
from nma.sources.base import Values
from nma.target.sampling import sample_spec
from nma.train.loss import albedo_loss, brdf_of, view
from nma.train.recipe import Recipe

# Number of directions wi of the pool (its rows), and number of directions wo for each direction wi.
ROWS, POINTS = 8192, 512
# One of `_CROWDED` directions wo is drawn near the mirror direction; the other directions are uniform. A quarter of the
# directions is enough to find narrow lobes. If more directions were near the mirror direction, smooth parts of the
# material would be fitted worse.
_CROWDED = 4
# Widths (alpha) of the microfacet lobes from which the directions near the mirror direction are drawn.
_WIDTHS = tuple(0.0005 * 2.0**k for k in range(11))
# Number of rows that are evaluated at once, which limits the memory.
_ROWS_PER_LAUNCH = 2048


class PointBatch(NamedTuple):
    """The points of one step. Rows are the last axis, as in `nma.train.batches.Batch`."""

    columns: NDArray[np.float32]  # (0, rows): a single material has no parameters
    mu: NDArray[np.float32]  # (rows,) cos(theta_i)
    phi: NDArray[np.float32]  # (rows,) azimuth of wi
    wo: NDArray[np.float32]  # (3, points, rows)
    weight: NDArray[np.float32]  # (points, rows) weights of mean 1 that correct for the uneven density of wo
    value: NDArray[np.float32]  # (3, points, rows)
    albedo: NDArray[np.float32]  # (3, rows) directional albedo at wi
    # (3, 2, rows) random shifts of the samples that estimate the target's albedo
    albedo_shift: NDArray[np.float32]


@dataclass
class PointPool:
    """The values of one source at ROWS x POINTS pairs of directions."""

    mu: NDArray[np.float32]  # (ROWS,)
    phi: NDArray[np.float32]  # (ROWS,)
    wo: NDArray[np.float32]  # (3, ROWS, POINTS)
    weight: NDArray[np.float32]  # (ROWS, POINTS)
    value: NDArray[np.float32]  # (3, ROWS, POINTS)
    albedo: NDArray[np.float32]  # (3, ROWS)

    @staticmethod
    def of(source: Values, *, seed: int = 0, rows: int = ROWS, points: int = POINTS) -> PointPool:
        """Evaluates a source at pairs of directions that the seed determines.

        Negative values (colours out of gamut) become 0. Raises `SourceError` for values that are not finite.
        """
        rng = np.random.default_rng((seed, 0x9017))
        # Every row has its own stratum of cos(theta_i).
        mu = (rng.permutation(rows) + rng.random(rows)) / rows
        phi = np.zeros(rows) if source.isotropic else rng.uniform(0.0, 2.0 * math.pi, rows)
        shift = rng.random((3, rows))
        launches = [slice(first, first + _ROWS_PER_LAUNCH) for first in range(0, rows, _ROWS_PER_LAUNCH)]
        parts = [_evaluated(source, mu[part], phi[part], shift[:, part], points) for part in launches]
        wo, weight, value = (np.concatenate(arrays, axis=-2) for arrays in zip(*parts, strict=True))
        if not np.isfinite(value).all():
            row = int(np.argwhere(~np.isfinite(value).all(axis=(0, 2)))[0, 0])
            raise SourceError(
                f"{source.name}: has values that are not finite, first at cos(theta_i) = {mu[row]:.4f}"
            )
        value = np.maximum(value, 0.0)
        albedo = 2.0 * math.pi * (value * weight).mean(axis=-1)
        return PointPool(*(x.astype(np.float32) for x in (mu, phi, wo, weight, value, albedo)))

    def draw(self, recipe: Recipe, step: int) -> PointBatch:
        """The points of one step: random rows, and in each row consecutive points from a random start."""
        rng = np.random.default_rng((recipe.seed, step, 0x90))
        m = rng.integers(len(self.mu), size=recipe.rows)
        # The points of a row are consecutive, so that every _CROWDED-th point is near the mirror direction.
        count = recipe.bins_per_row * recipe.points
        k = (
            rng.integers(self.weight.shape[1], size=recipe.rows) + np.arange(count)[:, None]
        ) % self.weight.shape[1]
        return PointBatch(
            np.zeros((0, recipe.rows), np.float32),
            self.mu[m],
            self.phi[m],
            self.wo[:, m, k],
            self.weight[m, k],
            self.value[:, m, k],
            self.albedo[:, m],
            rng.random((3, 2, recipe.rows), dtype=np.float32),
        )


def _evaluated(
    source: Values, mu: NDArray, phi: NDArray, shift: NDArray, points: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Evaluates the source at `points` directions wo for each view direction.

    Each view direction is a row: `mu` (rows,) holds cos(theta_i), and `phi` (rows,) the azimuths. `shift` shifts the
    lattice of each row at random. Returns the directions wo (3, rows, points), their weights (rows, points), and the
    source's values (3, rows, points).
    """
    Float = dr.auto.Float

    def lanes(x: NDArray) -> Any:
        return Float(np.ascontiguousarray(np.broadcast_to(x, (len(mu), points)), np.float32).ravel())

    u = [lanes((x + s[:, None]) % 1.0) for x, s in zip(lattice_points(points).T, shift, strict=True)]
    sin = np.sqrt(1.0 - mu * mu)
    wi = Vec3(*(lanes(c[:, None]) for c in (sin * np.cos(phi), sin * np.sin(phi), mu)))
    wo, weight = _directions(wi, u, lanes(np.arange(points)[None] % _CROWDED == 0))
    value = source.eval(wi, wo)
    arrays = [np.stack([c.numpy() for c in triple]) for triple in (wo, value)]
    shape = (len(mu), points)
    return arrays[0].reshape(3, *shape), weight.numpy().reshape(shape), arrays[1].reshape(3, *shape)


def _directions(wi: Vec3, u: list[Any], crowded: Any) -> tuple[Vec3, Any]:
    """Directions wo from uniform numbers, and their weights.

    wo is uniform over the hemisphere or, where `crowded` is 1, drawn near the mirror direction. The weight is the
    density of uniform directions divided by the density from which wo is drawn, and 0 below the horizon.
    """
    turn = (2.0 * math.pi) * u[0]
    across = ops.safe_sqrt(1.0 - u[1] * u[1])
    uniform = Vec3(across * dr.cos(turn), across * dr.sin(turn), u[1])
    width = _WIDTHS[0] * ops.exp(dr.floor(u[2] * len(_WIDTHS)) * math.log(2.0))
    wo = ops.select(crowded > 0, sample_spec(wi, width, width, u[0], u[1]), uniform)
    h = wi + wo
    h = h * (1.0 / ops.maximum(ops.sqrt(ops.dot(h, h)), 1e-9))
    facing = 4.0 * ops.maximum(ops.dot(wi, h), 1e-9)
    lobes = sum(visible_normal_pdf(wi, h, a, a) for a in _WIDTHS) / (facing * len(_WIDTHS))
    share = 1.0 / _CROWDED
    density = (1.0 - share) / (2.0 * math.pi) + share * lobes
    return wo, ops.select(wo.z > 0, 1.0 / (2.0 * math.pi * density), 0.0)


def points_loss(layers: Any, batch: PointBatch, recipe: Recipe) -> tuple[jax.Array, jax.Array]:
    """The loss to minimise, and the log loss of eq. 7 at the points.

    `nma.train.loop` takes this function as `objective`.
    """
    brdf = brdf_of(layers, batch, recipe)
    value = jnp.stack(list(brdf.eval(view(batch), Vec3(*batch.wo))))
    log_loss = (jnp.abs(jnp.log1p(value) - jnp.log1p(batch.value)) * batch.weight).mean()
    energy = (jnp.abs(value - batch.value) * batch.weight).mean()
    return log_loss + recipe.energy * energy + albedo_loss(brdf, batch, recipe), log_loss
