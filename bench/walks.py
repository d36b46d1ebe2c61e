"""Walks per second and peak memory of the source `layered3`, for several numbers of random materials.

python -m bench.walks [--walks 819200] [--repeat 3]
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

import nma
from bench.machine import header
from nma.table import stream_keys


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--walks", type=int, default=819_200, help="walks per material")
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    print(header())
    source = nma.source("layered3")
    print(
        f"{'materials':>9} {'seconds':>8} {'Mwalks/s':>9}   (best of {arguments.repeat}, after a first run to compile)"
    )
    for count in (16, 32, 64, 128):
        params = nma.LAYERED3.sample(np.random.default_rng(count), count)
        seconds = []
        for _ in range(arguments.repeat + 1):
            began = time.perf_counter()
            nma.tabulate(source, params, arguments.walks, stream_keys(0, range(count)), error=False)
            seconds.append(time.perf_counter() - began)
        best = min(seconds[1:])
        print(f"{count:9d} {best:8.2f} {count * arguments.walks / best / 1e6:9.2f}")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GB")


if __name__ == "__main__":
    main()
