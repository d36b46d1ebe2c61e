"""The adapter's own tables, and how they compare with references."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ava, metrics, target
from nma.adapter import Adapter
from nma.errors import TableError
from nma.jit import dr
from nma.ops import Color
from nma.table import ISOTROPIC, Grid, Tables

# The network runs at this many cos(theta_i) in each row of the table ...
_DIRECTIONS = 32
# ... and the target at this many wo in each bin for each of them.
_POINTS = 4


@dataclass(frozen=True)
class Evaluation:
    """Figures per material and their means; `integration_error` is the log loss between two estimates of the adapter's
    own bin averages, `estimated_error` whether the references came without standard errors."""

    materials: list[dict[str, float]]
    mean: dict[str, float]
    integration_error: float
    estimated_error: bool


def tabulate_adapter(adapter: Adapter, params: NDArray, *, shift: float = 0.0, grid: Grid = ISOTROPIC) -> NDArray[np.float32]:
    """The adapter's bin averages (n, theta_i, theta_o, phi, 3). `shift` in [0, 1) selects another set of points."""
    params = adapter.space.check(params, "training", clamp=True) if adapter.encoding != "direction" else params
    strata = np.arange(grid.theta_i * _DIRECTIONS)
    jitter = (strata * 0.6180339887 + 0.31 + shift) % 1.0
    mu = ((strata + jitter) / len(strata)).astype(np.float32)
    return np.stack([_tabulate(adapter.numbers(p[None], mu)[0], mu, shift, adapter, grid) for p in params])


def _tabulate(numbers: NDArray, mu: NDArray, shift: float, adapter: Adapter, grid: Grid) -> NDArray[np.float32]:
    """One material's table from its target parameters (theta_i * directions, size) at the cosines `mu`."""
    Float, UInt32 = dr.auto.Float, dr.auto.UInt32
    bins = dr.arange(UInt32, grid.bins)
    row = bins // (grid.theta_o * grid.phi_o)
    o = Float((bins // grid.phi_o) % grid.theta_o)
    p = Float(bins % grid.phi_o)
    curves = [Float(np.ascontiguousarray(c)) for c in numbers.T]
    cosines = Float(mu)
    lattice = ava.lattice(_DIRECTIONS * _POINTS) + shift * np.array([0.31, 0.57, 0.83])
    lattice_u = Float((lattice[:, 0] % 1.0).astype(np.float32))
    lattice_v = Float((lattice[:, 1] % 1.0).astype(np.float32))

    def body(k: Any, red: Any, green: Any, blue: Any) -> tuple[Any, Any, Any, Any]:
        at = row * _DIRECTIONS + k // _POINTS
        blend = target.from_numbers([dr.gather(Float, c, at) for c in curves], adapter.target)
        u = dr.gather(Float, lattice_u, k), dr.gather(Float, lattice_v, k)
        points = ava.bin_points_at(dr.gather(Float, cosines, at), o, p, u, grid)
        value = target.eval(blend, points.wi, points.wo) * points.weight
        return k + 1, red + value.x, green + value.y, blue + value.z

    zero = dr.zeros(Float, grid.bins)
    state = (dr.zeros(UInt32, grid.bins), zero, zero, zero)
    sums = dr.while_loop(state, lambda k, *_: k < _DIRECTIONS * _POINTS, body, mode="symbolic", label="bin averages")[1:]
    table = np.stack([s.numpy() for s in Color(*sums)], axis=-1) / (_DIRECTIONS * _POINTS)
    return table.reshape(grid.shape)


def evaluate(adapter: Adapter, reference: Tables, progress: Callable[[int], None] = lambda done: None) -> Evaluation:
    """Compares the adapter with reference tables over the paper's bins."""
    if reference.values.shape[1:] != ISOTROPIC.shape:
        raise TableError(f"evaluation wants isotropic tables {ISOTROPIC.shape}, the reference has {reference.values.shape[1:]}")
    materials, integration = [], []
    for n, params in enumerate(reference.params):
        halves = [tabulate_adapter(adapter, params[None], shift=s)[0] for s in (0.0, 0.5)]
        b = reference.values[n]
        error = _error(reference, n)
        materials.append(metrics.table_metrics(0.5 * (halves[0] + halves[1]), b, error))
        # Each half has twice the variance of their mean.
        integration.append(np.mean(np.abs(np.log1p(halves[0]) - np.log1p(halves[1]))) / 2.0)
        progress(n + 1)
    return Evaluation(materials, metrics.mean_metrics(materials), float(np.mean(integration)), reference.error is None)


def _error(reference: Tables, n: int) -> NDArray:
    if reference.error is not None:
        return reference.error[n]
    return metrics.counting_error(
        reference.values[n], int(reference.walks[n]), 2.0 * math.pi / (ISOTROPIC.theta_o * ISOTROPIC.phi_o), ISOTROPIC.theta_i
    )
