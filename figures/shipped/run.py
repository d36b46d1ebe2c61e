"""The shipped adapters on materials they have not seen: 89 from Table 1's ranges, 60 with real metals.

    python figures/shipped/run.py [--quick] [--adapter FILE ...]

Every third of the 60 has a metal that training never saw. References of 64 M walks per material are simulated once,
from the seeds below, into out/references (about 15 minutes on 2 cores; a killed run resumes). Writes shipped.json and
shipped.png beside this file; with --quick, few materials and walks, to out/figures/shipped.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import nma

HERE = Path(__file__).parent
REFERENCES = Path("out/references")
# name: (materials, population, seed)
SETS = {"range": (89, "range", 89), "metals": (60, "unseen_metals", 60)}
WALKS = 64_000_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--adapter", action="append", help="a weights file or a shipped name; may be repeated"
    )
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    adapters = arguments.adapter or list(nma.shipped())
    folder = Path("out/figures/shipped") if arguments.quick else HERE
    folder.mkdir(parents=True, exist_ok=True)
    results: dict[str, dict] = {}
    for name in SETS:
        tables = nma.Tables.load(reference(name, arguments.quick))
        for weights in adapters:
            label = Path(weights).stem
            evaluation = nma.evaluate_adapter(nma.Adapter.load(weights), tables)
            results.setdefault(label, {})[name] = summary(evaluation, tables)
            print(f"{label} on {name}: {json.dumps(results[label][name]['mean'])}", flush=True)
    (folder / "shipped.json").write_text(json.dumps(results, indent=1) + "\n")
    plot(results, folder / "shipped.png")


def reference(name: str, quick: bool) -> Path:
    """The reference file of a set, simulated with `nma simulate` if it is not there."""
    count, population, seed = SETS[name]
    count, walks = (4, 4_000_000) if quick else (count, WALKS)
    path = REFERENCES / f"{name}-{count}x{walks}.npz"
    if not path.exists():
        command = [
            "simulate",
            "--draw",
            count,
            "--population",
            population,
            "--seed",
            seed,
            "--walks",
            walks,
            "-o",
            path,
        ]
        subprocess.run([sys.executable, "-m", "nma.cli", *map(str, command)], check=True)
    return path


def summary(evaluation, tables) -> dict:
    """Means, the figures of sharp coats and of held-out metals, and every material's two main figures."""
    rounded = {k: round(v, 6) for k, v in evaluation.mean.items()}
    errors = np.array([m["albedo_error"] for m in evaluation.materials])
    sharp = tables.params[:, nma.LAYERED3.slices["alpha_top"]][:, 0] < 0.01
    return {
        "mean": rounded,
        "albedo_error_of_coats_below_.01": round(float(errors[sharp].mean()), 6) if sharp.any() else None,
        "worst_log_loss": round(max(m["log_loss"] for m in evaluation.materials), 6),
        "worst_albedo_error": round(float(errors.max()), 6),
        "integration_error": evaluation.integration_error,
        "log_loss": [round(m["log_loss"], 6) for m in evaluation.materials],
        "albedo_error": [round(float(e), 6) for e in errors],
    }


def plot(results: dict, path: Path) -> None:
    """Sorted log loss and albedo error of every material, one curve per adapter and set."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    for label, sets in results.items():
        for name, result in sets.items():
            for ax, quantity in zip(axes, ("log_loss", "albedo_error"), strict=True):
                ax.plot(np.sort(result[quantity]), label=f"{label}, {name}")
    for ax, text in zip(axes, ("log loss (eq. 7)", "albedo error"), strict=True):
        ax.set(xlabel="materials, sorted", ylabel=text)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
