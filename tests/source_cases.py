"""Sources and directions for the tests of sources."""

import math

import numpy as np

from nma import ops
from nma.jit import dr
from nma.ops import Color, Vec3


class Formula:
    """A source whose value f cos(theta_o) is a given formula of (wi, wo)."""

    def __init__(self, formula, isotropic=True, name="formula"):
        self.formula, self.isotropic, self.name = formula, isotropic, name

    def eval(self, wi, wo):
        return ops.select((wi.z > 0) & (wo.z > 0), Color.of(1.0) * self.formula(wi, wo), Color.of(0.0))


LAMBERT = Formula(lambda wi, wo: Color(0.8, 0.4, 0.0) * (wo.z * (1.0 / math.pi)))


def lanes(*columns):
    """Converts each NumPy column to a Dr.Jit array."""
    return [dr.auto.Float(np.ascontiguousarray(c, np.float32)) for c in columns]


def direction(mu, phi):
    """Returns one unit direction per pair of a cosine `mu` and an azimuth `phi`."""
    sin = np.sqrt(1.0 - mu * mu)
    return Vec3(*lanes(sin * np.cos(phi), sin * np.sin(phi), mu + 0.0 * phi))


def pairs(n, seed=0, low=0.0):
    """Returns `n` random pairs of directions. Cosines are uniform in low .. 1, azimuths in 0 .. 2 pi."""
    rng = np.random.default_rng(seed)
    mu = rng.uniform(low, 1.0, (2, n))
    phi = rng.uniform(0.0, 2.0 * math.pi, (2, n))
    return direction(mu[0], phi[0]), direction(mu[1], phi[1])


def numbers(colour):
    """Converts a colour of Dr.Jit arrays to a NumPy array (n, 3)."""
    return np.stack([c.numpy() for c in colour], axis=-1)


def log_loss(a, b):
    """Returns the mean of |log(1 + a) - log(1 + b)|."""
    return float(np.abs(np.log1p(a) - np.log1p(b)).mean())
