"""Lobes of layered materials, fitted with one Principled BRDF and with a blend of two Principled BRDFs (paper Fig. 2).

    python -m figures.lobes.run [--quick] [MATERIAL ...]

The parameters of the blend depend on wi. The single BRDF and the blend are fitted to the same table of 64 M walks, and
compared with an independent table of 64 M walks. The plot shows bin averages of f cos(theta_o) in the plane of
incidence.

Writes lobes.json and lobes.png beside this file. With --quick, fits one material with few walks and few steps, and
writes to out/figures/lobes.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
from figures import common
from nma.table import stream_keys
from nma.train.recipe import preset
from nma.train.run import fit_material

MATERIALS = ("copper-purple-medium", "beetle-green")
ANGLES = (20, 50, 75)  # angles of incidence, in degrees
# The paper's targets. Each instance has the 11 parameters of the Principled BRDF.
VARIANTS = {
    "single": {"instances": 1, "directional": False, "target": "principled"},
    "blended + ωi": {"instances": 2, "directional": True, "target": "principled"},
}
# The plot cuts off values that exceed CUT times the value of the PEAK_BINS-th brightest bin.
CUT, PEAK_BINS = 4.0, 6
COLOURS = ("#d62728", "#2ca02c", "#1f5fd0")


class Fit(NamedTuple):
    """A material's reference table (40, 40, 40, 3), and for each variant its table (40, 40, 40, 3) and metrics."""

    reference: NDArray
    tables: dict[str, NDArray]
    figures: dict[str, dict[str, float]]


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("materials", nargs="*", default=None)
    arguments = parser.parse_args()
    names = arguments.materials or MATERIALS[: 1 if arguments.quick else None]
    folder = common.results(__file__, arguments.quick)
    fits = {name: fit(name, arguments.quick) for name in names}
    common.write_json(folder / "lobes.json", {name: f.figures for name, f in fits.items()})
    plot(fits, folder / "lobes.png")


def fit(name: str, quick: bool) -> Fit:
    """Fits every variant to one table, and compares each fit with a reference from an independent random stream."""
    source, vector = nma.source("layered3"), nma.load_material(name).vector()
    walks = 4_000_000 if quick else common.REFERENCE_WALKS
    seen = nma.tabulate(source, vector[None], walks, stream_keys(0, [0]), error=False)
    reference = nma.tabulate(source, vector[None], walks, stream_keys(999, [0]))
    tables: dict[str, NDArray] = {}
    figures: dict[str, Any] = {}
    for label, changes in VARIANTS.items():
        began = time.perf_counter()
        recipe = preset("single", **changes, steps=150 if quick else None)
        adapter, _ = fit_material(source.space, recipe, vector, seen, {})
        tables[label] = nma.tabulate_adapter(adapter, vector)[0]
        mean = nma.evaluate_adapter(adapter, reference).mean
        figures[label] = {
            **{k: round(mean[k], 6) for k in ("log_loss", "noise_floor", "albedo_error")},
            "numbers": adapter.size,
            "plane_error": plane_errors(tables[label], reference.values[0]),
        }
        print(f"{name}, {label}: {time.perf_counter() - began:.0f} s, {figures[label]}", flush=True)
    return Fit(reference.values[0], tables, figures)


def in_plane(table: NDArray, angle: float) -> tuple[NDArray, NDArray]:
    """Cuts a table (theta_i, theta_o, phi, 3) along the plane of incidence, for an angle of incidence in degrees.

    Returns the angles theta_o [radians], positive on the side of the mirror direction, and the values (angles, 3).
    """
    bins = table.shape[1]
    theta = np.arccos((np.arange(bins) + 0.5) / bins)
    values = table[common.row(angle, len(table))].astype(np.float64)
    # The slice runs from grazing on the side of wi (delta_phi = 0), through the normal, to grazing on the side of the
    # mirror direction (delta_phi = pi).
    return np.concatenate([-theta, theta[::-1]]), np.concatenate([values[:, 0], values[::-1, -1]])


def plane_errors(table: NDArray, reference: NDArray) -> dict[str, float]:
    """Returns the mean absolute error over the bins in the plane of incidence [1/sr], for each angle."""
    errors = {a: np.abs(in_plane(table, a)[1] - in_plane(reference, a)[1]).mean() for a in ANGLES}
    return {f"{angle} degrees": round(float(error), 5) for angle, error in errors.items()}


def plot(fits: dict[str, Fit], path: Path) -> None:
    """Draws the lobes, with a row for each pair of material and variant, and a column for each angle of incidence."""
    rows = [(name, label) for name in fits for label in VARIANTS]
    figure = Figure(figsize=(11, 1.7 * len(rows) + 0.7), layout="constrained")
    axes = figure.subplots(len(rows), len(ANGLES), squeeze=False)
    for line, (name, label) in zip(axes, rows, strict=True):
        for ax, angle in zip(line, ANGLES, strict=True):
            draw(ax, fits[name], label, angle)
        loss = fits[name].figures[label]["log_loss"]
        line[0].set_ylabel(f"{name}\n{label}\nlog loss {loss:.4f}", fontsize=8.5)
    for ax, angle in zip(axes[0], ANGLES, strict=True):
        ax.set_title(rf"$\theta_i$ = {angle}°", fontsize=10)
    what = r"f cos $\theta_o$ [1/sr] in the plane of incidence, radius its square root; sharp peaks are cut off. "
    figure.suptitle(what + r"Thick: reference, thin: fit, arrow: $\omega_i$", fontsize=10)
    common.save_figure(figure, path)


def draw(ax: Axes, fit: Fit, label: str, angle: float) -> None:
    """Draws the lobe of one material, variant and angle in a half disc.

    Radii are square roots of the values, so that weak lobes are visible. The half discs of both variants have the same
    scale.
    """
    theta, reference = in_plane(fit.reference, angle)
    across, up = np.sin(theta)[:, None], np.cos(theta)[:, None]
    ours = in_plane(fit.tables[label], angle)[1]
    styles: list[dict[str, Any]] = [{"alpha": 0.3, "linewidth": 4.5}, {"linewidth": 1.2}]
    for values, style in zip((reference, ours), styles, strict=True):
        for x, y, colour in zip((across * np.sqrt(values)).T, (up * np.sqrt(values)).T, COLOURS, strict=True):
            ax.plot(x, y, color=colour, **style)
    # The peak of a sharp coat is a few bins wide and far above all other values, so the peak is cut off.
    peak = max(in_plane(t, angle)[1].max() for t in (fit.reference, *fit.tables.values()))
    top = 1.05 * np.sqrt(min(peak, CUT * np.sort(reference.max(axis=1))[-PEAK_BINS]))
    scale(ax, top)
    wi = np.array([-np.sin(np.radians(angle)), np.cos(np.radians(angle))])
    ax.annotate("", wi * top, wi * 0.7 * top, arrowprops={"arrowstyle": "->"})


def scale(ax: Axes, top: float) -> None:
    """Draws the frame of a half disc of the radius `top`, with rings at fixed values and rays every 30 degrees."""
    half = np.linspace(-np.pi / 2, np.pi / 2, 181)
    rings = [t for t in (0.01, 0.05, 0.2, 1, 5, 20, 100) if 0.02 * top**2 < t < top**2]
    for radius in (top, *np.sqrt(rings)):
        ax.plot(radius * np.sin(half), radius * np.cos(half), color="0.5", linewidth=0.4, zorder=0)
    for ray in np.radians((-60, -30, 0, 30, 60)):
        ax.plot([0.0, top * np.sin(ray)], [0.0, top * np.cos(ray)], color="0.8", linewidth=0.4, zorder=0)
    ax.set(aspect="equal", xlim=(-1.01 * top, 1.01 * top), ylim=(0.0, 1.01 * top), yticks=[])
    ax.set_xticks(np.sqrt(rings), [f"{t:g}" for t in rings], fontsize=7)
    ax.spines[["left", "right", "top"]].set_visible(False)


if __name__ == "__main__":
    main()
