"""Chi-square tests of samples against a density over the hemisphere, which several test files share."""

from collections.abc import Callable

import numpy as np
from scipy.stats import chi2

# The numbers of bins in cos(theta) and in azimuth. Each bin is split into PARTS x PARTS cells, and the density is
# evaluated at the centre of each cell.
BINS, PARTS = (24, 48), 64
GRID_POINTS = BINS[0] * BINS[1] * PARTS**2


def p_values(sample: Callable, density: Callable) -> tuple[float, float]:
    """Returns two p-values: of the samples against their density, and of the samples against a wrong density.

    The error of the wrong density rises from -10 % in the first bin to +10 % in the last bin, so that a test must
    reject the wrong density.

    `sample(n)` returns directions (n, 3) and densities (n,). A density of 0 marks a direction below the horizon; all
    such directions share one extra bin. `density(wo)` returns the densities of directions (n, 3).
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
    """Returns the p-value of a chi-square test. All bins with fewer than ten expected samples are merged."""
    few = wanted < 10
    found = np.append(found[~few], found[few].sum())
    wanted = np.append(wanted[~few], max(wanted[few].sum(), 1e-3))
    keep = wanted > 5
    statistic = ((found[keep] - wanted[keep]) ** 2 / wanted[keep]).sum()
    return chi2.sf(statistic, keep.sum() - 1)


def _grid():
    """Returns the centres of the cells of all bins as directions (n, 3), ordered by z first and by azimuth second."""
    z, phi = ((np.arange(n * PARTS) + 0.5) / (n * PARTS) for n in BINS)
    z, phi = (x.ravel() for x in np.meshgrid(z, 2 * np.pi * phi, indexing="ij"))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32)
