"""The headline figures of one recipe, as mean and standard deviation over several seeds of training."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import nma
from figures import common
from figures.variants.report import statistics
from nma.files import write_text

FIGURES = ("log_loss", "smape", "albedo_error")


def write(recipes: list[list[str]], references: dict[str, nma.Tables], folder: Path) -> str:
    """Evaluates the weights files of each recipe, writes seeds.json and seeds.md, and returns the table.

    Args:
        recipes: for each recipe, the weights files of its seeds.
        references: the reference tables of each set of materials, by the set's name.
    """
    adapters = [[nma.Adapter.load(file) for file in files] for files in recipes]
    for files, trained in zip(recipes, adapters, strict=True):
        check(files, trained)
    results = {}
    for files, trained in zip(recipes, adapters, strict=True):
        results[Path(files[0]).stem] = {name: spread(trained, tables) for name, tables in references.items()}
    common.write_json(folder / "seeds.json", results)
    text = table(results)
    write_text(folder / "seeds.md", text + "\n")
    return text


def check(files: list[str], adapters: list[nma.Adapter]) -> None:
    """Exits with a message unless the adapters were trained by one recipe, each with another seed."""
    trainings = [
        {"dataset": adapter.training.get("dataset"), **(adapter.training.get("recipe") or {})}
        for adapter in adapters
    ]
    seeds = [training.get("seed") for training in trainings]
    if None in seeds:
        sys.exit(
            f"{files[seeds.index(None)]} does not record its seed of training; train it with `nma train`"
        )
    if len(set(seeds)) < len(seeds):
        sys.exit(f"{', '.join(files)} have the seeds {seeds}; train each with another --seed")
    first = trainings[0] | {"seed": None}
    for file, training in zip(files, trainings, strict=True):
        other = [key for key in first | training if key != "seed" and first.get(key) != training.get(key)]
        if other:
            sys.exit(f"{file} was trained with another {other[0]} than {files[0]}; give files of one recipe")


def spread(adapters: list[nma.Adapter], tables: nma.Tables) -> dict[str, dict[str, Any]]:
    """Returns mean, standard deviation and number of seeds for each figure."""
    means = [nma.evaluate_adapter(adapter, tables).mean for adapter in adapters]
    return {figure: statistics([mean[figure] for mean in means]) for figure in FIGURES}


def table(results: dict[str, dict[str, dict[str, Any]]]) -> str:
    lines = [["recipe", "set", "seeds", *FIGURES]]
    lines.append(["---"] * len(lines[0]))
    for recipe, sets in results.items():
        for name, found in sets.items():
            values = (found[figure] for figure in FIGURES)
            lines.append([recipe, name, str(found[FIGURES[0]]["seeds"]), *map(_cell, values)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(found: dict[str, Any]) -> str:
    return f"{found['mean']:.4f}" + ("" if found["std"] is None else f" +- {found['std']:.4f}")
