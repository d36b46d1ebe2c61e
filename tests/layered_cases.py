"""Hard cases of the layered material and Z-tests of tables, shared by the tests of the Python and the C++ code.

Each statistical test has the false-alarm rate `FALSE_ALARM` over all of its comparisons (Sidak's correction).
"""

import numpy as np
import pytest
from scipy.stats import norm

from nma.params import LAYERED3
from nma.table import Grid

FALSE_ALARM = 1e-3
GRID = Grid(theta_i=5, theta_o=10, phi_o=10)
WHITE = {"eta_conductor": 0.0, "k_conductor": 1.0}
COPPER = {"eta_conductor": (0.24, 0.96, 1.18), "k_conductor": (3.9, 2.6, 2.4)}

# The hard cases have narrow or wide lobes of coat and conductor, thin or thick media, and coats with a high, a low or
# a matched index of refraction.
CASES = {
    "white_coated": {"alpha_top": 0.2, "alpha_bottom": 0.4, "eta_top": 1.5, "sigma_t": 0.0, **WHITE},
    "white_with_medium": {
        "alpha_top": 0.2,
        "alpha_bottom": 0.4,
        "eta_top": 1.5,
        "sigma_t": 1.0,
        "albedo": 0.9,
        **WHITE,
    },
    "narrow_narrow": {"alpha_top": 1e-3, "alpha_bottom": 2e-3, "eta_top": 1.5, "sigma_t": 0.3, "albedo": 0.8},
    "narrow_wide": {"alpha_top": 1e-3, "alpha_bottom": 0.5, "eta_top": 1.7, "sigma_t": 0.3},
    "wide_narrow": {"alpha_top": 0.3, "alpha_bottom": 1e-3, "eta_top": 1.5, "sigma_t": 0.0},
    "wide_narrow_weak": {"alpha_top": 0.3, "alpha_bottom": 2e-3, "eta_top": 1.05, "sigma_t": 0.5},
    "thick": {
        "alpha_top": 0.1,
        "alpha_bottom": 1.0,
        "eta_top": 2.0,
        "sigma_t": 4.0,
        "albedo": (0.3, 0.9, 1.0),
    },
    "index_matched": {"alpha_top": 1e-4, "alpha_bottom": 0.2, "eta_top": 1.0, "sigma_t": 1.0, "albedo": 0.7},
}
# Tests with many walks always run three of the cases. The slow tests run all cases.
SLOW_CASES = [
    name if name in ("narrow_wide", "thick", "white_coated") else pytest.param(name, marks=pytest.mark.slow)
    for name in CASES
]


def vector(values):
    return LAYERED3.vector({"albedo": (0.9, 0.5, 0.1), **COPPER, **values})


def limit(comparisons):
    """Returns the |z| above which one of `comparisons` two-sided Z-tests rejects."""
    return norm.isf(0.5 * (1.0 - (1.0 - FALSE_ALARM) ** (1.0 / comparisons)))


def table_of(sums, squares, per_row):
    """Returns the means of bins (theta_i, theta_o, phi, 3) and their standard errors.

    `sums` and `squares` are sums of weights and of squared weights in each bin, from `per_row` weights per row.
    """
    scale = 1.0 / (per_row * GRID.solid_angle)
    return sums * scale, np.sqrt(squares - sums**2 / per_row) * scale


def z_scores(found, error, walks, factor=1.0, known=np.inf):
    """Returns the z-scores of the differences (factor found - w), where w is the table `walks`.

    There is a score for each row, and for each bin with over 100 walks and with a relative standard error below
    `known`.
    """
    enough = found * GRID.solid_angle * walks.walks[0] / GRID.theta_i > 100
    enough &= error < known * found
    difference, variance = factor * found - walks.values[0], error**2 + walks.error[0].astype(np.float64) ** 2
    # A walk ends in one bin only, so the values of two bins are negatively correlated. The sum of the variances of the
    # bins is therefore an upper bound of the variance of the row.
    rows = difference.sum(axis=(1, 2)) / np.sqrt(variance.sum(axis=(1, 2)))
    return np.concatenate([difference[enough] / np.sqrt(variance[enough]), rows.ravel()])
