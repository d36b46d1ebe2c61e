"""Whether samples follow a density over the hemisphere: chi-square tests that several test files share."""

from collections.abc import Callable

import numpy as np
from scipy.stats import chi2

# Bins of cos(theta) and azimuth, and parts of each along both, at whose middles the density is taken.
BINS, PARTS = (24, 48), 64
GRID_POINTS = BINS[0] * BINS[1] * PARTS**2


def p_values(sample: Callable, density: Callable) -> tuple[float, float]:
    """Of samples against their density; and against one that is a tenth off at both ends, which must be seen.

    `sample(n)` gives directions (n, 3) and densities (n,), 0 for those below the horizon, which have a bin of their
    own; `density(wo)` gives the densities of directions (n, 3).
    """
    samples = GRID_POINTS // BINS[0]
    wo, pdf = sample(samples)
    valid = pdf > 0
    azimuth = np.arctan2(wo[:, 1], wo[:, 0]) % (2 * np.pi)
    counts, *_ = np.histogram2d(wo[valid, 2], azimuth[valid], BINS, ((0, 1), (0, 2 * np.pi)))
    found = np.append(counts.ravel(), (~valid).sum())
    shares = np.concatenate([density(part).astype(np.float64) for part in np.split(_grid(), BINS[0])])
    shares = shares.reshape(BINS[0], PARTS, BINS[1], PARTS).sum(axis=(1, 3)) * (2 * np.pi / GRID_POINTS)
    wanted = samples * np.append(shares.ravel(), 1 - shares.sum())
    return chi_square(found, wanted), chi_square(found, wanted * np.linspace(0.9, 1.1, wanted.size))


def chi_square(found, wanted):
    """The p-value; bins that expect fewer than ten are taken together."""
    few = wanted < 10
    found = np.append(found[~few], found[few].sum())
    wanted = np.append(wanted[~few], max(wanted[few].sum(), 1e-3))
    keep = wanted > 5
    statistic = ((found[keep] - wanted[keep]) ** 2 / wanted[keep]).sum()
    return chi2.sf(statistic, keep.sum() - 1)


def _grid():
    """The middles of all parts of bins, rows of z after each other."""
    z, phi = ((np.arange(n * PARTS) + 0.5) / (n * PARTS) for n in BINS)
    z, phi = (x.ravel() for x in np.meshgrid(z, 2 * np.pi * phi, indexing="ij"))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32)
