"""BRDF slices of six unseen materials, from the simulation and the adapter, at two angles of incidence (paper Fig. 10).

    python -m figures.slices.run [--quick] [--adapter FILE]

A slice shows f cos(theta_o) for all directions wo, at an angle of incidence of 70 or 0 degrees. The materials of the
set "range" (figures/common.py) are sorted by the roughness of the coat, and materials at even intervals in this order
are shown.

Writes slices.json and slices.png beside this file. With --quick, takes four materials with few walks, and writes to
out/figures/slices.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
from figures import common
from nma.images.io import tonemap

MATERIALS = 6
ANGLES = (70, 0)  # angles of incidence, in degrees
PIXELS = 256
# A value v [1/sr] is displayed as y / (1 + y), where y = EXPOSURE v.
EXPOSURE = 3.0
# The absolute error [1/sr] at the upper end of the colour scale.
ERROR_SCALE = 0.5


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--adapter", default="layered3-5x64", help="a weights file or a shipped name")
    arguments = parser.parse_args()
    folder = common.results(__file__, arguments.quick)
    tables = chosen(common.reference("range", arguments.quick))
    adapter = nma.tabulate_adapter(nma.Adapter.load(arguments.adapter), tables.params)
    label = Path(arguments.adapter).stem
    common.write_json(folder / "slices.json", summary(tables, adapter, label))
    plot(tables, adapter, label, folder / "slices.png")


def chosen(tables: nma.Tables) -> nma.Tables:
    """Sorts materials by the roughness of the coat, and chooses materials at even intervals in this order."""
    order = np.argsort(tables.params[:, nma.LAYERED3.slices["alpha_top"]][:, 0])
    count = min(MATERIALS, len(order))
    picked = order[((np.arange(count) + 0.5) / count * len(order)).astype(int)]
    return tables[picked]


def summary(tables: nma.Tables, adapter: NDArray, label: str) -> dict:
    """Returns mean absolute error, mean value and error of noise alone for each slice, in 1/sr."""
    slices = []
    for m, params in enumerate(tables.params):
        entry: dict = {"params": [round(float(x), 5) for x in params]}
        for angle in ANGLES:
            at = m, common.row(angle, adapter.shape[1])
            reference = tables.values[at].astype(np.float64)
            figures = {
                "mean_absolute_error": np.abs(adapter[at] - reference).mean(),
                "mean": reference.mean(),
            }
            if tables.error is not None:
                # A normally distributed e with standard deviation s has a mean |e| of sqrt(2 / pi) s.
                figures["of_noise_alone"] = np.sqrt(2 / np.pi) * tables.error[at].mean(dtype=np.float64)
            entry[f"{angle} degrees"] = {name: round(float(x), 6) for name, x in figures.items()}
        slices.append(entry)
        print(f"alpha_top {params[0]:.4f}: { ({a: entry[f'{a} degrees'] for a in ANGLES}) }", flush=True)
    mean = {a: np.mean([s[f"{a} degrees"]["mean_absolute_error"] for s in slices]) for a in ANGLES}
    return {
        "adapter": label,
        "mean_absolute_error": {f"{a} degrees": round(float(x), 6) for a, x in mean.items()},
        "slices": slices,
    }


def disc(values: NDArray, outside: float = 1.0) -> NDArray[np.float32]:
    """Draws the hemisphere of wo from above, with wi to the left and the mirror direction to the right.

    The projection is Lambert's equal-area projection: all bins have equal areas on the disc, as on the hemisphere.

    Args:
        values: bin averages (theta_o, phi, channels).
        outside: the value of pixels outside the disc.

    Returns:
        a picture (PIXELS, PIXELS, channels).
    """
    # Each pixel is the average of 2 x 2 samples, which makes the disc's edge smooth.
    axis = (np.arange(2 * PIXELS) + 0.5) / PIXELS - 1.0
    x, y = np.meshgrid(axis, axis)
    cosine = 1.0 - x * x - y * y
    azimuth = np.arctan2(np.abs(y), -x)
    bins = values.shape[:2]
    o = np.clip((cosine * bins[0]).astype(int), 0, bins[0] - 1)
    p = np.clip((azimuth / np.pi * bins[1]).astype(int), 0, bins[1] - 1)
    image = np.where(cosine[..., None] >= 0.0, values[o, p], outside)
    return image.reshape(PIXELS, 2, PIXELS, 2, -1).mean(axis=(1, 3)).astype(np.float32)


def plot(tables: nma.Tables, adapter: NDArray, label: str, path: Path) -> None:
    """Draws a column for each material, and three rows for each angle: reference, adapter and absolute error."""
    count = len(tables.params)
    figure = Figure(figsize=(1.5 * count + 1.3, 9.6), layout="constrained")
    axes = figure.subplots(3 * len(ANGLES), count, squeeze=False)
    norm = PowerNorm(0.5, 0.0, ERROR_SCALE)
    for m in range(count):
        axes[0, m].set_title(caption(tables.params[m]), fontsize=7.5)
        for k, angle in enumerate(ANGLES):
            at = m, common.row(angle, adapter.shape[1])
            reference, ours = tables.values[at].astype(np.float64), adapter[at].astype(np.float64)
            error = np.abs(ours - reference).mean(axis=-1, keepdims=True)
            for ax, values in zip(axes[3 * k :, m], (reference, ours), strict=False):
                ax.imshow(disc(tonemap(EXPOSURE * values / (1.0 + EXPOSURE * values))))
            shown = axes[3 * k + 2, m].imshow(disc(error, np.nan)[..., 0], cmap="magma", norm=norm)
            axes[3 * k + 2, m].set_xlabel(f"{np.abs(ours - reference).mean():.4f}", fontsize=8, labelpad=1)
    for k, angle in enumerate(ANGLES):
        for ax, text in zip(axes[3 * k :, 0], ("reference", label, "|error|"), strict=False):
            ax.set_ylabel(f"{angle}°: {text}", fontsize=8)
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    bar = figure.colorbar(shown, ax=axes, shrink=0.35, pad=0.01)
    bar.set_label("absolute error, mean of channels [1/sr]", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    common.save_figure(figure, path)


def caption(params: NDArray) -> str:
    values = {name: params[columns] for name, columns in nma.LAYERED3.slices.items()}
    coat, metal = (f"{values[name][0]:.2g}".lstrip("0") for name in ("alpha_top", "alpha_bottom"))
    return f"coat $\\alpha$ {coat}, metal $\\alpha$ {metal}\n$\\sigma_t$ {values['sigma_t'][0]:.2f}"


if __name__ == "__main__":
    main()
