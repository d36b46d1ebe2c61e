"""Report of the trainings: means and standard deviations, ordering of the variants, tables, and plot of Fig. 3."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import nma
from figures import common
from figures.variants.paper import PERCENT, TABLE_2, TABLE_3
from figures.variants.train import INSTANCES, VARIANTS, Job
from nma.images.metrics import METRICS

Results = dict[Job, dict[str, Any]]
WORST, BEST = "single", "blended + omega_i"
# The names of the rows of the paper's Table 3, by variant.
ROWS_3 = {"omega_i": "1 instance", BEST: "2 instances"} | {name: name for name in INSTANCES}


def statistics(values: list[float]) -> dict[str, Any]:
    """Returns mean, standard deviation (None for a single seed) and number of seeds."""
    deviation = round(float(np.std(values, ddof=1)), 7) if len(values) > 1 else None
    return {"mean": round(float(np.mean(values)), 7), "std": deviation, "seeds": len(values)}


def summary(results: Results, sizes: list[int]) -> dict[str, Any]:
    """Returns the results that the tables show: log losses by variant and size, orderings, and image metrics."""
    losses: dict[str, dict[str, Any]] = {}
    for name in [*VARIANTS, *INSTANCES]:
        for size in [*sizes, 0]:
            found = [
                r["tables"]["log_loss"] for j, r in results.items() if (j.variant, j.size) == (name, size)
            ]
            if found:
                losses.setdefault(name, {})[str(size or "overfit")] = statistics(found)
    images = {}
    for name in [*VARIANTS, *INSTANCES]:
        found = [r["images"] for j, r in results.items() if j.variant == name and r.get("images")]
        if found:
            images[name] = {metric: statistics([f[metric] for f in found]) for metric in METRICS}
    return {"log_loss": losses, "ordering": orderings(results, sizes), "images": images}


def orderings(results: Results, sizes: list[int]) -> dict[str, dict[str, list[bool]]]:
    """Returns whether `single` is worst and `blended + omega_i` is best, by metric and dataset size.

    Each result is a list of truth values, one for each seed with which all variants were trained.
    """
    found: dict[str, dict[str, list[bool]]] = {}
    for size in sizes:
        for seed in sorted({job.seed for job in results}):
            runs = {
                job.variant: r
                for job, r in results.items()
                if (job.size, job.seed) == (size, seed) and job.variant in VARIANTS
            }
            if len(runs) < len(VARIANTS):
                continue
            for figure, errors in _errors(runs).items():
                line = found.setdefault(
                    f"{figure}, {size} materials", {f"{WORST} worst": [], f"{BEST} best": []}
                )
                line[f"{WORST} worst"].append(max(errors, key=errors.__getitem__) == WORST)
                line[f"{BEST} best"].append(min(errors, key=errors.__getitem__) == BEST)
    return found


def _errors(runs: dict[str, dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Returns the errors of each variant, by metric: log loss, and the image metrics if all variants have images."""
    found = {"log loss": {name: run["tables"]["log_loss"] for name, run in runs.items()}}
    if all("images" in run for run in runs.values()):
        for metric in METRICS:
            # A higher SSIM is better, while the other metrics are errors, so the sign of the SSIM is changed.
            sign = -1.0 if metric == "ssim" else 1.0
            found[metric] = {name: sign * run["images"][metric] for name, run in runs.items()}
    return found


def markdown(found: dict[str, Any], noise: dict[str, float], floor: float) -> str:
    """Returns all tables with headings, in Markdown."""
    parts = [
        "## Log loss (Fig. 3)",
        loss_table(found["log_loss"]),
        f"The noise of the references alone gives a log loss of {floor:.5f}.",
    ]
    parts += ["## Ordering", ordering_lines(found["ordering"])]
    for title, names, paper in (
        ("## Images (Table 2)", {name: name for name in (*VARIANTS, *nma.shipped())}, TABLE_2),
        ("## Instances (Table 3)", ROWS_3, TABLE_3),
    ):
        parts += [title, image_table(found["images"], names, paper, noise)]
    return "\n\n".join(parts) + "\n"


def loss_table(losses: dict[str, dict[str, Any]]) -> str:
    columns = list(dict.fromkeys(size for row in losses.values() for size in row))
    lines = [["variant", *columns]]
    for name, row in losses.items():
        lines.append([name, *(number(row[c]) if c in row else "" for c in columns)])
    return table(lines)


def ordering_lines(found: dict[str, dict[str, list[bool]]]) -> str:
    """Returns a table that counts the seeds for which the paper's ordering of the variants holds."""
    if not found:
        return "No dataset size has results of all variants yet."
    lines = [["", *next(iter(found.values()))]]
    for figure, row in found.items():
        lines.append([figure, *(f"{sum(holds)} of {len(holds)} seeds" for holds in row.values())])
    losses = [
        holds for figure, row in found.items() if figure.startswith("log loss") for holds in row.values()
    ]
    answer = "Yes" if all(map(all, losses)) else "No"
    question = "Does the paper's ordering hold for the log loss of every seed and dataset size?"
    return table(lines) + f"\n\n{question} {answer}."


def image_table(
    images: dict[str, Any], names: dict[str, str], paper: dict[str, dict[str, float]], noise: dict[str, float]
) -> str:
    """Returns a table of image metrics, with MAPE and SMAPE in percent.

    Each variant has a row with our results and a row with the paper's results. The last row shows the metrics of noise
    alone.
    """
    lines = [["", *(f"{m}, %" if m in PERCENT else m for m in METRICS)]]
    for variant, label in names.items():
        if variant in images:
            ours = images[variant].items()
            lines.append([f"{label}, ours", *(number(v, 100 if m in PERCENT else 1) for m, v in ours)])
        if label in paper:
            lines.append([f"{label}, paper", *(f"{value:g}" for value in paper[label].values())])
    if noise:
        cells = (f"{noise[m] * (100 if m in PERCENT else 1):.4g}" for m in METRICS)
        lines.append(["noise: reference against itself", *cells])
    return table(lines)


def number(value: dict[str, Any], factor: float = 1.0) -> str:
    text = f"{value['mean'] * factor:.4g}"
    return text if value["std"] is None else f"{text} ± {value['std'] * factor:.1g}"


def table(lines: list[list[str]]) -> str:
    rule = "|" + "---|" * len(lines[0])
    rows = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([rows[0], rule, *rows[1:]])


def plot(losses: dict[str, dict[str, Any]], floor: float, path: Path) -> None:
    """Plots log loss against the dataset's size (Fig. 3). Dashed lines show adapters trained on the validation set."""
    figure = Figure(figsize=(8.5, 4.5), layout="constrained")
    axes = figure.add_subplot(xlabel="materials in the training set", ylabel="validation log loss (eq. 7)")
    sizes: list[int] = []
    for number_of, name in enumerate(VARIANTS):
        row, colour = losses.get(name, {}), f"C{number_of}"
        mine = [int(size) for size in row if size != "overfit"]
        means = [row[str(size)]["mean"] for size in mine]
        deviations = [row[str(size)]["std"] or 0.0 for size in mine]
        if mine:
            axes.errorbar(mine, means, deviations, marker="o", capsize=3, color=colour, label=name)
        if "overfit" in row:
            axes.axhline(row["overfit"]["mean"], color=colour, linestyle="--", linewidth=1)
        sizes += mine
    axes.axhline(floor, color="black", linestyle=":", linewidth=1)
    axes.annotate("noise of the references", (1, floor), xycoords=("axes fraction", "data"), **_LEFT_ABOVE)
    axes.plot([], [], "k--", linewidth=1, label="trained on the validation set")
    axes.set(xscale="log", ylim=(0, None))
    axes.set_xticks(sorted(set(sizes)), [f"{size:,}" for size in sorted(set(sizes))])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize=9)
    common.save_figure(figure, path)


_LEFT_ABOVE: dict[str, Any] = {
    "xytext": (-4, 3),
    "textcoords": "offset points",
    "ha": "right",
    "fontsize": 8,
}
