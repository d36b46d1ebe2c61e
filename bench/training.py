"""Training speed in bins per second, and the time of each stage of a training step, with our and the paper's recipe.

python -m bench.training [--steps 300]

The stages are:

drawing  drawing a batch, on a separate thread
network  the network and its derivatives
target   the target and its derivatives at the points of the bins, and Adam
albedo   the term of the directional albedo

The times of `target` and `albedo` are computed from the times of whole steps with and without these stages.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import jax
import numpy as np

import nma
from bench.machine import header
from nma.table.dataset import Settings, simulate_block
from nma.train import loop
from nma.train.batches import Batch, BinSampler, Pool, draw
from nma.train.loss import network_outputs
from nma.train.recipe import Recipe, preset
from nma.train.run import initial_layers


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=300)
    steps = parser.parse_args().steps
    print(header())
    pool = Pool.of(simulate_block(Settings("layered3", 16, 81_920, 0), range(16)))
    columns = ("ms/step", "CPU ms", "Mbins/s", "drawing", "network", "target", "albedo")
    print(f"{'recipe':12}" + "".join(f"{c:>9}" for c in columns))
    for name, network in (("class", "5x64"), ("class", "3x32"), ("paper", "5x64")):
        print(measure(pool, name, network, steps))


def measure(pool: Pool, name: str, network: str, steps: int) -> str:
    """Trains with the preset `name` on the bins of `pool`. Returns one line of the table, with times in ms per step."""
    recipe = preset(name, steps=steps, network=network)
    sampler = BinSampler(recipe.bins_law)
    began = time.perf_counter()
    batches = [draw(pool, sampler, recipe, k) for k in range(steps)]
    drawing = 1e3 * (time.perf_counter() - began) / steps
    step, cpu = seconds(recipe, batches)
    without, _ = seconds(replace(recipe, albedo=0.0), batches) if recipe.albedo else (step, cpu)
    passes = network_seconds(recipe, batches[0])
    rate = recipe.bins_per_step / step / 1e3
    numbers = (step, cpu, rate, drawing, passes, without - passes, step - without)
    return f"{name + ' ' + network:12}" + "".join(f"{x:9.2f}" for x in numbers)


def seconds(recipe: Recipe, batches: list[Batch]) -> tuple[float, float]:
    """Returns the milliseconds of a whole step: wall time, and processor time summed over all cores."""
    clock: list[tuple[float, float]] = []
    run = loop.start(recipe, initial_layers(recipe, nma.LAYERED3))
    loop.train(
        recipe,
        run,
        batches.__getitem__,
        progress=lambda _: clock.append((time.perf_counter(), time.process_time())),
    )
    # The time of the first group of steps includes compilation, so this group is not counted.
    wall, cpu = (np.array(clock[-1]) - np.array(clock[0])) / (recipe.steps - loop.GROUP)
    return 1e3 * wall, 1e3 * cpu


def network_seconds(recipe: Recipe, batch: Batch, repeats: int = 200) -> float:
    """Returns the milliseconds of a forward and backward pass of the network for a batch."""
    layers = initial_layers(recipe, nma.LAYERED3)
    passes = jax.jit(jax.grad(lambda layers: (network_outputs(layers, batch, recipe) ** 2).sum()))
    jax.block_until_ready(passes(layers))
    began = time.perf_counter()
    for _ in range(repeats):
        jax.block_until_ready(passes(layers))
    return 1e3 * (time.perf_counter() - began) / repeats


if __name__ == "__main__":
    main()
