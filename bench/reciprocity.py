"""Measures how far adapters are from being reciprocal: the difference between f(wi, wo) and f(wo, wi).

python -m bench.reciprocity [--adapter layered3-5x64] [--samples 65536] [--quick] [--output out/bench]

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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import nma
from bench import frames
from nma.adapter import Adapter
from nma.ops import Vec3, at_azimuth_0
from nma.target import Brdf

COSINES = (0.9, 0.5, 0.2)


class Pairs(NamedTuple):
    """Values (3, n) of f at n pairs of directions, divided by the probability density of wo.

    `forward` is f(wi, wo) cos(theta_o) / density, and `swapped` is f(wo, wi) cos(theta_o) / density.
    """

    forward: NDArray
    swapped: NDArray


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
    parser.add_argument("--adapter", default="layered3-5x64")
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
    every = pairs(adapter, params, np.sqrt(rng.random(samples)), rng)
    off = np.abs(every.forward - every.swapped).mean(axis=1) / every.forward.mean(axis=1)
    columns = {"difference": off.tolist()}
    for cosine in COSINES:
        seen = pairs(adapter, params, np.full(samples, cosine), rng)
        columns[f"cos {cosine}"] = (seen.swapped.mean(axis=1) / seen.forward.mean(axis=1) - 1.0).tolist()
    return columns


def pairs(adapter: Adapter, params: NDArray, cosines: NDArray, rng: np.random.Generator) -> Pairs:
    """Draws one light direction from the adapter's blend for each view direction.

    `cosines` (n,) are the cosines of the view directions with the normal.
    """
    n = len(cosines)
    wi = at_azimuth_0(cosines)
    brdf = prepared(adapter, params, wi)
    # The random numbers that choose a lobe of the blend are stratified.
    u = rng.permutation((np.arange(n) + rng.random(n)) / n), *rng.random((2, n))
    wo, value, pdf = brdf.sample(wi, *u)
    valid = (pdf > 0.0) & (wo.z > 1e-4)
    wo = Vec3(*(np.where(valid, x, up) for x, up in zip(wo, (0.0, 0.0, 1.0), strict=True)))
    # The swapped evaluation returns f(wo, wi) cos(theta_i); the factor wo.z / wi.z makes this f(wo, wi) cos(theta_o).
    back = np.stack(prepared(adapter, params, wo).eval(wo, wi)) * wo.z / wi.z
    weight = np.where(valid, 1.0 / np.where(valid, pdf, 1.0), 0.0)
    return Pairs(np.stack(value) * weight, back * weight)


def prepared(adapter: Adapter, params: NDArray, w: Vec3) -> Brdf:
    """Returns the BRDF of one material, with the blend's parameters computed for the view directions `w`."""
    return adapter.prepare([np.full(len(w.z), x) for x in params], w)


if __name__ == "__main__":
    main()
