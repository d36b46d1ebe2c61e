"""Functions that the experiments share: command line, folder of results, reference tables, metrics and saving."""

from __future__ import annotations

import argparse
import fcntl
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
from nma import files
from nma.evaluate.metrics import table_metrics
from nma.params import Population

ROOT = Path(__file__).parent.parent
REFERENCES = ROOT / "out/references"
# The folder of the measured materials. The measurements are not part of this repository.
DATA = Path(os.environ.get("NMA_TEST_DATA") or ROOT.parent / "shared/data")
# Sets of materials that no adapter was trained on, by name: (number of materials, population, seed).
SETS: dict[str, tuple[int, Population, int]] = {
    "range": (89, "range", 89),
    "metals": (60, "unseen_metals", 60),
}
REFERENCE_WALKS = 64_000_000
QUICK_WALKS = 4_000_000


def parser(doc: str | None) -> argparse.ArgumentParser:
    """Returns a command-line parser with the option `--quick`; `doc` is the script's docstring."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--quick", action="store_true", help="a small, short run, in under two minutes")
    return made


def results(script: str, quick: bool) -> Path:
    """Creates and returns the folder for results: the script's own folder, or out/figures/NAME for a quick run."""
    home = Path(script).resolve().parent
    folder = ROOT / "out/figures" / home.name if quick else home
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_json(path: Path, data: Any) -> None:
    files.write_text(path, json.dumps(data, indent=1) + "\n")
    print(f"{path}")


def save_figure(figure: Figure, path: Path, dpi: int = 110) -> None:
    with files.whole(path) as file:
        figure.savefig(file, dpi=dpi)
    print(f"{path}")


def reference(name: str, quick: bool) -> nma.Tables:
    """Returns the reference tables of a set in SETS, made by `nma simulate` if their file does not exist."""
    count, population, seed = SETS[name]
    count, walks = (4, QUICK_WALKS) if quick else (count, REFERENCE_WALKS)
    options = {"--draw": count, "--population": population, "--seed": seed, "--walks": walks}
    return simulated(REFERENCES / f"{name}-{count}x{walks}.npz", options)


def named_reference(material: str, quick: bool) -> nma.Tables:
    """Returns the reference table of a named material, made by `nma simulate` if its file does not exist."""
    walks = QUICK_WALKS if quick else REFERENCE_WALKS
    options = {"--material": material, "--walks": walks}
    return simulated(REFERENCES / f"named-{material}-{walks}.npz", options)


def simulated(path: Path, options: dict[str, Any]) -> nma.Tables:
    """Returns the tables of a file, made by `nma simulate` with `options` if the file does not exist."""
    words = [str(word) for option in (options | {"-o": path}).items() for word in option]
    REFERENCES.mkdir(parents=True, exist_ok=True)
    with path.with_suffix(".lock").open("w") as lock:
        # If another experiment simulates the same tables, wait for its result.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            subprocess.run([sys.executable, "-m", "nma.cli", "simulate", *words], check=True)
    return nma.Tables.load(path)


def kept(path: Path, make: Callable[[], Any], again: bool = False) -> Any:
    """Returns the content of a JSON file. If the file does not exist or `again` is true, first calls `make` and writes
    the result of the call to the file."""
    if again or not path.exists():
        files.write_text(path, json.dumps(make()))
    return json.loads(path.read_text())


def save_array(path: Path, array: NDArray) -> None:
    """Writes the array to an .npy file."""
    with files.whole(path) as file:
        np.save(file, array)


def figures(
    adapter: nma.Adapter, tables: nma.Tables, directions: int | None = None
) -> list[dict[str, float]]:
    """Returns the adapter's metrics for every material of the tables. The tables must have standard errors.

    This function integrates the adapter over the bins once, while `nma.evaluate_adapter` integrates twice to measure
    the accuracy of the integration.

    Args:
        directions: number of values of cos(theta_i) in each row of a table; None for the default of `tabulate_adapter`.
    """
    assert tables.error is not None
    return [
        table_metrics(nma.tabulate_adapter(adapter, params[None], directions=directions)[0], table, error)
        for params, table, error in zip(tables.params, tables.values, tables.error, strict=True)
    ]


def row(angle: float, rows: int) -> int:
    """Returns the index of the row with the angle of incidence `angle` [degrees], in a table of `rows` rows."""
    return min(int(math.cos(math.radians(angle)) * rows), rows - 1)
