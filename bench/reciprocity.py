"""Measures how far adapters are from being reciprocal: the difference between f(wi, wo) and f(wo, wi).

python -m bench.reciprocity [--adapter layered3-3x32] [--samples 65536] [--quick] [--output out/bench]

An adapter's network computes the blend's parameters for the view direction, so f(wi, wo) and f(wo, wi) differ. Paths
from the camera use f(wi, wo), paths from a light would use f(wo, wi). This bench needs no renderer: it averages f(wi,
wo) and f(wo, wi) over directions wo that are sampled from the adapter's blend. The bench prints a table with a row for
each named material and these columns:

difference      mean of |f(wi, wo) - f(wo, wi)|, weighted by both cosines, divided by the mean of f
cos .9, .5, .2  relative change of brightness if wi and wo are swapped, under a uniform sky, at this cosine of theta_i

Writes reciprocity.json.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import nma
from bench import frames
from nma.adapter import DEFAULT_ADAPTER, Adapter
from nma.evaluate.reciprocity import swapped_pairs

COSINES = (0.9, 0.5, 0.2)


def main() -> None:
    arguments = parse()
    head = frames.begin()
    adapter = Adapter.load(arguments.adapter)
    names = nma.material_names()[: 2 if arguments.quick else None]
    found = {name: measured(adapter, nma.load_material(name).vector(), arguments.samples) for name in names}
    rows = [[name, *(percent(values) for values in columns.values())] for name, columns in found.items()]
    print(frames.markdown(["% of R, G, B", "difference", *(f"cos {c}" for c in COSINES)], rows))
    frames.write(arguments.output / "reciprocity.json", head, arguments, materials=found)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--adapter", default=DEFAULT_ADAPTER)
    parser.add_argument("--samples", type=int, default=1 << 16, help="pairs of directions for each figure")
    parser.add_argument(
        "--quick", action="store_true", help="few pairs and two materials, to see that the bench works"
    )
    parser.add_argument("--output", type=Path, default=frames.OUTPUT, help="folder for the results")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.samples = 1 << 12
    return arguments


def percent(values: list[float]) -> str:
    return "  ".join(f"{100 * x:+.1f}" for x in values)


def measured(adapter: Adapter, params: NDArray, samples: int) -> dict[str, list[float]]:
    """Returns one row of the table: the values of R, G and B for each column."""
    rng = np.random.default_rng(0)
    every = swapped_pairs(adapter, params, np.sqrt(rng.random(samples)), rng)
    off = np.abs(every.forward - every.swapped).mean(axis=1) / every.forward.mean(axis=1)
    columns = {"difference": off.tolist()}
    for cosine in COSINES:
        seen = swapped_pairs(adapter, params, np.full(samples, cosine), rng)
        columns[f"cos {cosine}"] = (seen.swapped.mean(axis=1) / seen.forward.mean(axis=1) - 1.0).tolist()
    return columns


if __name__ == "__main__":
    main()
