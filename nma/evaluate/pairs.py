"""Compares two sources at random pairs of directions.

cos(theta_i) and cos(theta_o) are independent and uniform in the range `cosines`; azimuths are uniform. The comparison
needs no bins, so the sources may be anisotropic, and it does not matter on which data a model was trained. The error
figures of adapters for single materials are computed at random pairs of directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nma.evaluate import metrics
from nma.sources.base import Values, direction

PAIRS = 20_000
COSINES = (0.02, 1.0)


@dataclass(frozen=True)
class Pairs:
    """Cosines and azimuths of wi and wo, (n,) each."""

    mu_i: NDArray[np.float64]
    phi_i: NDArray[np.float64]
    mu_o: NDArray[np.float64]
    phi_o: NDArray[np.float64]

    @staticmethod
    def draw(count: int = PAIRS, *, seed: int = 0, cosines: tuple[float, float] = COSINES) -> Pairs:
        """Draws `count` random pairs. The same seed gives the same pairs."""
        rng = np.random.default_rng((seed, 0x9A12))
        mu_i, mu_o = rng.uniform(*cosines, (2, count))
        phi_i, phi_o = rng.uniform(0.0, 2.0 * np.pi, (2, count))
        return Pairs(mu_i, phi_i, mu_o, phi_o)

    def values(self, source: Values) -> NDArray[np.float64]:
        """f cos(theta_o) [1/sr] of a source at the pairs of directions, (n, 3)."""
        value = source.eval(direction(self.mu_i, self.phi_i), direction(self.mu_o, self.phi_o))
        return np.stack([np.broadcast_to(c.numpy(), len(self.mu_i)) for c in value], axis=-1).astype(
            np.float64
        )


def compare(model: Values, reference: Values, pairs: Pairs | None = None) -> dict[str, float]:
    """The figures log_loss, ae and smape (`nma.evaluate.metrics`) of f cos(theta_o), as means over pairs and RGB."""
    pairs = pairs or Pairs.draw()
    return metrics.value_metrics(pairs.values(model), pairs.values(reference))
