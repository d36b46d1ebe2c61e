"""Error figures of one material's table. Each error figure is a mean over bins and RGB.

The functions compare two tables of f cos(theta_o) [1/sr]: `a` is the adapter's table and `b` is the reference table,
both (..., theta_i, theta_o, phi, 3).
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

# EPS [1/sr] is added to the denominators of relative errors, so that relative errors stay finite in dark bins.
EPS = 1e-2


def _normal_means(n: int) -> NDArray[np.float64]:
    """Splits the positive half of the standard normal distribution into `n` intervals of equal probability.

    Returns the mean of the distribution in each interval: (n,).
    """
    normal = NormalDist()
    densities = [normal.pdf(normal.inv_cdf(0.5 + 0.5 * k / n)) for k in range(n)] + [0.0]
    return -2.0 * n * np.diff(densities)


# `noise_floor` takes the values in `_NORMAL` and their negatives as samples of a standard normal variable. The mean of
# `_NORMAL` equals the mean absolute value of a standard normal variable.
_NORMAL = _normal_means(16)

FIGURES = ("log_loss", "ae", "smape", "mape", "mrse", "psnr", "albedo_error", "noise_floor")


def table_metrics(a: NDArray, b: NDArray, error: NDArray) -> dict[str, float]:
    """All figures of one material, by their names in `FIGURES`; `error` is the standard error of each bin of `b`.

    - log_loss: the mean of |log(1 + a) - log(1 + b)| (eq. 7).
    - ae: the mean of |a - b|.
    - smape: the mean of 2 |a - b| / (|a| + |b| + EPS).
    - mape: the mean of |a - b| / (b + EPS).
    - mrse: the mean of (a - b)^2 / (b^2 + EPS).
    - psnr: 10 log10(peak^2 / mean of (a - b)^2) dB, where peak is the reference's brightest bin.
    - albedo_error: the mean absolute difference of the directional albedos, over theta_i and RGB.
    - noise_floor: the log loss that even a perfect model would have, because the reference is noisy.
    """
    a, b = a.astype(np.float64), b.astype(np.float64)
    difference = np.abs(a - b)
    mse = np.mean(difference**2)
    return {
        **value_metrics(a, b),
        "mape": float(np.mean(difference / (b + EPS))),
        "mrse": float(np.mean(difference**2 / (b**2 + EPS))),
        "psnr": float(10 * np.log10(b.max() ** 2 / mse)) if mse > 0 and b.max() > 0 else math.inf,
        "albedo_error": float(np.mean(np.abs(_albedo(a) - _albedo(b)))),
        "noise_floor": noise_floor(b, error),
    }


def value_metrics(a: NDArray, b: NDArray) -> dict[str, float]:
    """The figures that can be computed without bins, from any values of f cos(theta_o): log_loss, ae and smape."""
    difference = np.abs(a - b)
    return {
        "log_loss": float(np.mean(np.abs(np.log1p(a) - np.log1p(b)))),
        "ae": float(difference.mean()),
        "smape": float(np.mean(2 * difference / (np.abs(a) + np.abs(b) + EPS))),
    }


def noise_floor(b: NDArray, error: NDArray) -> float:
    """The mean over bins of the expected |log(1 + b + e) - log(1 + b)|, where the noise e is normally distributed.

    The standard deviation of the noise is `error`.
    """
    b, error = b.astype(np.float64), error.astype(np.float64)
    base = np.log1p(b)
    total = 0.0
    for z in (*_NORMAL, *-_NORMAL):
        total += float(np.mean(np.abs(np.log1p(np.maximum(b + z * error, -0.999)) - base)))
    return total / (2 * len(_NORMAL))


def counting_error(b: NDArray, walks: int, solid_angle: float, rows: int) -> NDArray[np.float64]:
    """An upper bound of each bin's standard error, computed from the number of walks as if every throughput were 1."""
    return np.sqrt(np.maximum(b, 0.0).astype(np.float64) * rows / (walks * solid_angle))


def mean_metrics(materials: list[dict[str, float]]) -> dict[str, float]:
    """The mean of each figure over the materials."""
    return {name: float(np.mean([m[name] for m in materials])) for name in FIGURES}


def _albedo(table: NDArray) -> NDArray:
    return 2.0 * math.pi * table.mean(axis=(-3, -2))
