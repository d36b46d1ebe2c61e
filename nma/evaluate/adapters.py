"""Makes tables of adapters, and compares them with reference tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.adapter import Adapter
from nma.errors import TableError
from nma.evaluate import metrics
from nma.evaluate.brightness import Brightness, Energy, energy, signed_errors
from nma.evaluate.reciprocity import non_reciprocity
from nma.jit import dr
from nma.lattice import lattice_points
from nma.table import ISOTROPIC, Grid, Tables, quadrature
from nma.table.grid import check_class
from nma.table.walks import bin_index

# A row of the table is a bin of cos(theta_i). In each row, the network runs at _DIRECTIONS cosines. At each cosine, the
# target is evaluated for _POINTS directions wo in each bin of wo, and for _SAMPLES directions wo drawn from the
# target's own lobes.
_DIRECTIONS = 32
_POINTS = 4
_SAMPLES = 512
# The target's sampling density of wo [1/sr] at which half of f cos(theta_o) counts as sharp. Where the density is far
# higher than `_SHARP`, a lobe is too narrow for a few points per bin, so samples of the lobe are used.
_SHARP = 10.0


@dataclass(frozen=True)
class Evaluation:
    """The error figures of each material, and the mean of each figure over the materials.

    `signed` has the signed errors of brightness of each material, and `signed_of_all` those of all materials' added
    energies. `non_reciprocity` has a value for each material (`nma.evaluate.reciprocity`).
    `integration_error` (in log loss) and `albedo_integration_error` estimate the errors of the numerical integration
    over bins, from two integrations with different points. `estimated_error` is true if the reference tables have no
    standard errors, so that standard errors were estimated from the number of walks.
    """

    materials: list[dict[str, float]]
    mean: dict[str, float]
    integration_error: float
    albedo_integration_error: float
    estimated_error: bool
    signed: list[Brightness]
    signed_of_all: Brightness
    non_reciprocity: list[float]

    @property
    def mean_non_reciprocity(self) -> float:
        return float(np.mean(self.non_reciprocity))


def tabulate_adapter(
    adapter: Adapter,
    params: NDArray,
    *,
    shift: float = 0.0,
    clamp: bool = False,
    grid: Grid = ISOTROPIC,
    directions: int | None = None,
) -> NDArray[np.float32]:
    """The means of the adapter's f cos(theta_o) over the bins of a table: (n, theta_i, theta_o, phi, 3).

    Each `shift` in [0, 1) gives a different set of integration points. `directions` is the number of cosines
    cos(theta_i) per row of the table (32 by default): more cosines take more time and make the means more precise. With
    `clamp`, parameters outside the training range are moved to the end of the range; without `clamp`, such parameters
    raise `ParamError`.
    """
    if adapter.anisotropic:
        raise TableError(
            "an anisotropic adapter has no isotropic table; compare it at pairs of directions (nma.evaluate.pairs)"
        )
    params = adapter.check(params, clamp)
    strata = np.arange(grid.theta_i * (directions or _DIRECTIONS))
    jitter = (strata * 0.6180339887 + 0.31 + shift) % 1.0
    mu = ((strata + jitter) / len(strata)).astype(np.float32)
    return np.stack([_tabulate(adapter.numbers(p[None], mu)[0], mu, shift, adapter, grid) for p in params])


def table_log_loss(adapter: Adapter, params: NDArray, table: NDArray, directions: int | None = None) -> float:
    """The log loss (eq. 7) of the adapter against `table`, for one material with the parameters `params` (columns,).

    The adapter is integrated only once, so this function is faster than `evaluate`.
    """
    own = tabulate_adapter(adapter, params[None], directions=directions)[0]
    return metrics.table_metrics(own, table, np.zeros_like(own))["log_loss"]


def _tabulate(
    numbers: NDArray, mu: NDArray, shift: float, adapter: Adapter, grid: Grid
) -> NDArray[np.float32]:
    """The table of one material.

    `numbers` (theta_i * directions, size) are the target's parameters at the cosines `mu`. `_sharpness`, a function of
    the target's sampling density, splits f cos(theta_o) into a sharp and a smooth part. The sharp part is integrated
    with samples of the target's lobes, so the lobes may be arbitrarily narrow. The smooth part is integrated with
    points in every bin.
    """
    curves = [dr.auto.Float(np.ascontiguousarray(c)) for c in numbers.T]
    cosines, seed = dr.auto.Float(mu), dr.opaque(dr.auto.UInt32, int(shift * 2**24))
    table = _by_points(curves, cosines, seed, adapter, grid) + _by_samples(
        curves, cosines, seed, adapter, grid
    )
    return table.reshape(grid.shape).astype(np.float32)


def _by_points(
    curves: list[Any], cosines: Any, seed: Any, adapter: Adapter, grid: Grid
) -> NDArray[np.float64]:
    """The smooth part of f cos(theta_o), averaged over points in every bin: (bins, 3)."""
    Float, UInt32 = dr.auto.Float, dr.auto.UInt32
    directions = len(cosines) // grid.theta_i
    bins = dr.arange(UInt32, grid.bins)
    row = bins // (grid.theta_o * grid.phi_o)
    o = Float((bins // grid.phi_o) % grid.theta_o)
    p = Float(bins % grid.phi_o)
    shifts = [quadrature.hashed(bins * 2 + k, seed) for k in range(2)]
    lattice = [Float(x.astype(np.float32)) for x in lattice_points(directions * _POINTS).T[:2]]

    def body(k: Any, red: Any, green: Any, blue: Any) -> tuple[Any, Any, Any, Any]:
        at = row * directions + k // _POINTS
        mu = dr.gather(Float, cosines, at)
        brdf = adapter.from_numbers([dr.gather(Float, c, at) for c in curves], ops.at_azimuth_0(mu))
        u, v = (quadrature.shifted(dr.gather(Float, x, k), s) for x, s in zip(lattice, shifts, strict=True))
        across = mu * grid.theta_i - Float(row)
        points = quadrature.uniform_bin_points(Float(row), o, p, (across, u, v), grid)
        value, pdf = brdf.eval_pdf(points.wi, points.wo)
        value = value * (1.0 - _sharpness(pdf))
        return k + 1, red + value.x, green + value.y, blue + value.z

    zero = dr.zeros(Float, grid.bins)
    state = (dr.zeros(UInt32, grid.bins), zero, zero, zero)
    sums = dr.while_loop(
        state, lambda k, *_: k < directions * _POINTS, body, mode="symbolic", label="bin averages"
    )[1:]
    return np.stack([s.numpy() for s in sums], axis=-1) / float(directions * _POINTS)


def _by_samples(
    curves: list[Any], cosines: Any, seed: Any, adapter: Adapter, grid: Grid
) -> NDArray[np.float64]:
    """The sharp part of f cos(theta_o), averaged over each bin with samples of the target's lobes: (bins, 3)."""
    Float, UInt32 = dr.auto.Float, dr.auto.UInt32
    lane = dr.arange(UInt32, len(cosines) * _SAMPLES)
    at, k = lane // _SAMPLES, lane % _SAMPLES
    mu = dr.gather(Float, cosines, at)
    wi = ops.at_azimuth_0(mu)
    brdf = adapter.from_numbers([dr.gather(Float, c, at) for c in curves], wi)
    lattice = [Float(x.astype(np.float32)) for x in lattice_points(_SAMPLES).T]
    shifts = [quadrature.hashed(at * 3 + n, ~seed) for n in range(len(lattice))]
    u = [quadrature.shifted(dr.gather(Float, x, k), s) for x, s in zip(lattice, shifts, strict=True)]
    wo, value, pdf = brdf.sample(wi, *u)
    value = value * dr.select(pdf > 0, _sharpness(pdf) / dr.maximum(pdf, 1e-9), 0.0)
    directions = len(cosines) // grid.theta_i
    index = bin_index(at // directions, UInt32(0), wo, grid)
    dr.eval(index, *value)
    # The samples are summed with NumPy, which has a fixed order of addition, so that results are reproducible.
    sums = [np.bincount(index.numpy(), c.numpy(), grid.bins) for c in value]
    return np.stack(sums, axis=-1) / (directions * _SAMPLES * grid.solid_angle)


def _sharpness(pdf: Any) -> Any:
    """The fraction (0 to 1) of f cos(theta_o) in the sharp part, where the target's sampling density is `pdf`."""
    x = pdf * (1.0 / _SHARP)
    return 1.0 - 1.0 / (1.0 + x * x)


def evaluate(
    adapter: Adapter,
    reference: Tables,
    progress: Callable[[int], None] = lambda done: None,
    *,
    clamp: bool = False,
) -> Evaluation:
    """Compares the adapter with reference tables on the paper's grid of bins.

    `progress` is called with the number of materials evaluated so far. Raises `TableError` if the tables have another
    class or another grid, and `ParamError` for materials outside the adapter's training range. With `clamp`, parameters
    outside the training range are moved to the end of the range, and no `ParamError` is raised.
    """
    check_class(reference.class_name, adapter.space.name, "the adapter")
    if reference.values.shape[1:] != ISOTROPIC.shape:
        raise TableError(
            f"evaluation needs isotropic tables of shape {ISOTROPIC.shape}, but the reference has tables of shape "
            f"{reference.values.shape[1:]}"
        )
    if not len(reference.params):
        raise TableError("the reference holds no material")
    params = adapter.check(reference.params, clamp)
    materials, spreads, energies = [], [], []
    for n in range(len(params)):
        halves = [tabulate_adapter(adapter, params[n : n + 1], shift=s)[0] for s in (0.0, 0.5)]
        mean = 0.5 * (halves[0] + halves[1])
        materials.append(metrics.table_metrics(mean, reference.values[n], _error(reference, n)))
        energies.append((energy(mean), energy(reference.values[n])))
        spread = metrics.table_metrics(halves[0], halves[1], np.zeros_like(mean))
        # On average, the error of the mean of two independent estimates is half of the difference between the
        # estimates.
        spreads.append((0.5 * spread["log_loss"], 0.5 * spread["albedo_error"]))
        progress(n + 1)
    log_loss, albedo = np.mean(spreads, axis=0)
    ours, theirs = (Energy(*map(np.stack, zip(*side, strict=True))) for side in zip(*energies, strict=True))
    return Evaluation(
        materials,
        metrics.mean_metrics(materials),
        float(log_loss),
        float(albedo),
        reference.error is None,
        [signed_errors(a, b) for a, b in energies],
        signed_errors(ours, theirs),
        [non_reciprocity(adapter, p) for p in params],
    )


def _error(reference: Tables, n: int) -> NDArray:
    """The standard error of each bin of the reference table of material `n`.

    If the reference has no standard errors, they are estimated from the number of walks.
    """
    if reference.error is not None:
        return reference.error[n]
    walks = int(reference.walks[n])
    return metrics.counting_error(reference.values[n], walks, ISOTROPIC.solid_angle, ISOTROPIC.rows)
