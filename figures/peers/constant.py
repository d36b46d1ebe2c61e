"""The best constant Principled: one parameter vector per material, fitted to the material's reference table."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import nma
from bench.runtime import measured
from figures import common
from nma.adapter import weights_file
from nma.train.principled import CONSTANT, fit_constant

QUICK_STEPS = 20


def fitted(name: str, tables: nma.Tables, number: int, quick: bool) -> tuple[dict[str, float], Path]:
    """Returns the metrics of the fit to a material of the set `name`, and the weights file of the fit.

    Both are kept in out/figures/peers, so a killed run continues where it stopped.
    """
    folder = common.ROOT / "out/figures/peers" / ("quick" if quick else "fits")
    weights = folder / f"{name}-{number}.safetensors"

    def fit() -> dict[str, float]:
        recipe = replace(CONSTANT, steps=QUICK_STEPS) if quick else CONSTANT
        found = fit_constant(tables[number : number + 1], recipe)
        found.adapter.save(weights)
        return found.figures

    return common.kept(folder / f"{name}-{number}.json", fit, quick), weights


def nanoseconds(label: str, name: str, tables: nma.Tables) -> dict[str, dict[str, float]]:
    """Returns the times of the C++ runtime per query, of the shipped adapters and of a fit, by their labels.

    `prepare` is the time of a single query with the fastest instruction set. A fit needs no preparation.
    """
    words = [f"{adapter}={weights_file(adapter)}" for adapter in nma.shipped()]
    words.append(f"{label}={fitted(name, tables, 0, False)[1]}")
    rows = [row for row in measured(["-march=native"], words) if row["what"] in ("prepare", "eval and pdf")]
    times: dict[str, dict[str, float]] = {}
    for row in rows:
        found = times.setdefault(row["network"], {"prepare": math.inf, "eval and pdf": math.inf})
        found[row["what"]] = min(found[row["what"]], row["ns"])
    times[label]["prepare"] = 0.0
    return times
