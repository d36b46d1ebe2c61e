"""The largest directional albedo of the shipped adapters at 64 angles, for 100,000 random materials (eq. 5: at most 1).

    python -m figures.energy.run [--quick]

The albedo is estimated as the mean of value / pdf over samples that the adapter draws. The first round estimates the
albedo of all pairs of material and angle with few samples. Each further round estimates the brightest pairs again, with
more samples. Every round makes two independent estimates, whose difference gives the statistical error. All rounds are
repeated without the bound on the albedo.

Writes energy.json and energy.png beside this file. With --quick, takes 500 materials and writes to out/figures/energy.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import nma
from figures import common
from nma import ops, target
from nma.jit import dr
from nma.lattice import lattice_points

ANGLES = 64
CHUNK = 1_000_000
# Each round: the number of pairs of material and angle (None for all pairs), and the number of samples per pair.
ROUNDS = ((None, 64), (50_000, 1024), (2_000, 16_384), (100, 2**20))
QUICK_ROUNDS = ((None, 64), (1_000, 1024), (100, 2**16))


def main() -> None:
    arguments = common.parser(__doc__).parse_args()
    materials, rounds = (500, QUICK_ROUNDS) if arguments.quick else (100_000, ROUNDS)
    folder = common.results(__file__, arguments.quick)
    params = nma.LAYERED3.sample(np.random.default_rng(5), materials, "mixed")
    results, curves = {}, {}
    for name in nma.shipped():
        adapter = nma.Adapter.load(name)
        for label, variant in ((name, adapter), (f"{name}, not bounded", replace(adapter, bounded=False))):
            results[label], curves[label] = measure(variant, params, rounds)
            print(f"{label}: {results[label]}", flush=True)
    common.write_json(folder / "energy.json", results)
    plot(curves, folder / "energy.png")


def measure(adapter: nma.Adapter, params: np.ndarray, rounds: tuple) -> tuple[dict, np.ndarray]:
    """Returns the largest albedo with its error, material and angle, and the first round's largest albedo per angle."""
    mu = (np.arange(ANGLES) + 0.5) / ANGLES
    pairs = np.arange(len(params) * ANGLES)
    coarse, result = np.empty(0), {}
    for count, samples in rounds:
        if count is not None:
            pairs = pairs[np.argsort(-coarse)[:count]]
        estimates = [albedos(adapter, params, mu, pairs, samples, shift) for shift in (0.0, 0.5)]
        coarse = np.mean(estimates, axis=0)
        best = int(np.argmax(coarse))
        if count is None:
            envelope = coarse.reshape(len(params), ANGLES).max(axis=0)
        result = {
            "largest_albedo": round(float(coarse[best]), 5),
            # The error of the mean of two estimates is about half of the difference between the estimates.
            "error": round(float(np.abs(estimates[0] - estimates[1]).mean() / 2), 6),
            "pairs_above_1": int((coarse > 1.0005).sum()),
            "cos_theta_i": float(mu[pairs[best] % ANGLES]),
            "material": [round(float(x), 4) for x in params[pairs[best] // ANGLES]],
        }
    return result, envelope


def albedos(
    adapter: nma.Adapter, params: np.ndarray, mu: np.ndarray, pairs: np.ndarray, samples: int, shift: float
) -> np.ndarray:
    """Estimates the albedo of the brightest channel, from `samples` samples for each pair of material and angle.

    Args:
        params: materials (n, 13).
        mu: cosines of the angles (ANGLES,).
        pairs: for each pair, the index material * ANGLES + angle.
        shift: offset that is added to the sample points, modulo 1. Estimates of two offsets differ by about
            their error.
    """
    chunk = max(1, min(CHUNK, 2**28 // samples))
    parts = np.array_split(pairs, -(-len(pairs) // chunk))
    return np.concatenate(
        [_albedos(adapter, params[p // ANGLES], mu[p % ANGLES], samples, shift) for p in parts]
    )


def _albedos(
    adapter: nma.Adapter, params: np.ndarray, mu: np.ndarray, samples: int, shift: float
) -> np.ndarray:
    Float, UInt32, Sum = dr.auto.Float, dr.auto.UInt32, dr.auto.Float64
    flat = target.numbers(adapter.prepare(list(params.T), ops.at_azimuth_0(mu)).blend, adapter.target)
    curves = [Float(np.broadcast_to(np.asarray(x, np.float32), len(mu)).copy()) for x in flat]
    wi = ops.at_azimuth_0(Float(mu.astype(np.float32)))
    brdf = adapter.from_numbers(curves, wi)
    lattice = [Float(x.astype(np.float32)) for x in ((lattice_points(samples) + shift) % 1.0).T]

    def body(k, *sums):
        u = [dr.gather(Float, x, k) for x in lattice]
        _, value, pdf = brdf.sample(wi, *u)
        weights = [Sum(dr.select(pdf > 0, c / pdf, 0.0)) for c in value]
        return k + 1, *(s + w for s, w in zip(sums, weights, strict=True))

    # Sums are in double precision, because a million terms in single precision would have large rounding errors.
    start: Any = (dr.zeros(UInt32, len(mu)), *(dr.zeros(Sum, len(mu)) for _ in range(3)))
    sums = dr.while_loop(start, lambda k, *_: k < samples, body, mode="symbolic", label="albedo")[1:]
    return np.max([s.numpy() for s in sums], axis=0) / samples


def plot(curves: dict[str, np.ndarray], path: Path) -> None:
    """Plots the largest albedo of all materials against cos(theta_i), from the estimates of the first round."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot(
        xlabel="cos(theta_i)",
        ylabel="largest directional albedo",
        title="Coarse estimates over all materials",
    )
    for label, curve in curves.items():
        axes.plot((np.arange(ANGLES) + 0.5) / ANGLES, curve, "--" if "not" in label else "-", label=label)
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.grid(alpha=0.3)
    axes.legend()
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
