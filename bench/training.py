"""Bins per second of a training step, ours and the paper's recipe, and how much of it is drawing batches.

python bench/training.py [--steps 300]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from machine import header

import nma
from nma.dataset import Settings, simulate_block
from nma.train import loop
from nma.train.data import BinSampler, Pool, draw
from nma.train.recipe import preset
from nma.train.run import initial_layers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300)
    steps = parser.parse_args().steps
    print(header())
    pool = Pool.of(simulate_block(Settings("layered3", 16, 81_920, 0), range(16)))
    print(f"{'recipe':22} {'ms/step':>8} {'CPU ms/step':>12} {'Mbins/s':>8} {'drawing ms':>11}")
    for name, network in (("class", "5x64"), ("class", "3x32"), ("paper", "5x64")):
        print(measure(pool, name, network, steps))


def measure(pool: Pool, name: str, network: str, steps: int) -> str:
    """One line of the table: a preset's training on a small pool."""
    recipe = preset(name, steps=steps, network=network)
    sampler = BinSampler(recipe.bins_law)
    began = time.perf_counter()
    batches = [draw(pool, sampler, recipe, k) for k in range(steps)]
    drawing = (time.perf_counter() - began) / steps
    clock: list[tuple[float, float]] = []
    run = loop.start(recipe, initial_layers(recipe, nma.LAYERED3))
    loop.train(
        recipe,
        run,
        batches.__getitem__,
        progress=lambda _: clock.append((time.perf_counter(), time.process_time())),
    )
    # The first group compiles.
    wall, cpu = (np.array(clock[-1]) - np.array(clock[0])) / (steps - loop.GROUP)
    rate = recipe.bins_per_step / wall / 1e6
    label = f"{name} {network}"
    return f"{label:22} {wall * 1e3:8.2f} {cpu * 1e3:12.2f} {rate:8.2f} {drawing * 1e3:11.2f}"


if __name__ == "__main__":
    main()
