"""Times per query of the C++ runtime, by instruction set, compared with Eigen, NumPy, drjit.nn and a large decoder.

python -m bench.runtime [--json OUT.json]

Times are in nanoseconds on one thread. Each time is the shortest of many repetitions. Eigen is measured if its headers
are installed (Debian: libeigen3-dev). The large decoder has 1.07 million parameters.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

# The number of threads of OpenBLAS must be set before NumPy loads OpenBLAS.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import drjit as dr
import numpy as np

import nma
from bench.machine import header
from nma import network
from nma.adapter import weights_file
from nma.files import write_text
from nma.llvm import ensure_llvm
from nma.native import build

HERE = Path(__file__).parent
EIGEN = "/usr/include/eigen3"
QUERIES = 1 << 16


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write all figures to this file")
    arguments = parser.parse_args()
    print(header(), flush=True)
    rows = cpp() + [row for name in nma.shipped() for row in python(name)]
    peak = next((r["ns"] for r in rows if r["what"].startswith("peak")), None)
    for title, what in (
        ("one query, ns", ("network", "inputs and network", "prepare")),
        ("per query of a batch, ns", ("network, batch", "inputs and network, batch", "prepare, batch")),
        ("once prepared, ns", ("curves", "eval and pdf", "sample, eval and pdf")),
    ):
        table(title, what, rows)
    if peak:
        print(f"\nbatch in multiply-adds per ns; the core's peak in float32 is {peak:.1f}")
        for row in rows:
            if row["what"].startswith("multiply"):
                print(
                    f"  {row['network']:7} {row['set']:16} {row['ns']:7.1f} {100 * row['ns'] / peak:6.0f} %"
                )
    if arguments.json:
        write_text(
            arguments.json, json.dumps({"machine": header().splitlines(), "rows": rows}, indent=1) + "\n"
        )


def cpp() -> list[dict]:
    """Compiles and runs bench/runtime.cpp on this machine, and returns its measurements."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "runtime"
        flags = ["-std=c++17", "-O2", "-march=native", f"-I{build.sources()}"]
        flags += [f"-isystem{EIGEN}"] if Path(EIGEN).exists() else []
        subprocess.run([build.compiler(), *flags, str(HERE / "runtime.cpp"), "-o", str(program)], check=True)
        words = [f"{name.split('-')[1]}={weights_file(name)}" for name in nma.shipped()]
        run = subprocess.run([program, *words], capture_output=True, text=True, check=True)
    return [json.loads(line) for line in run.stdout.splitlines()]


def python(name: str) -> list[dict]:
    """Returns the times of an adapter's network in NumPy and in drjit.nn, on one thread."""
    adapter = nma.Adapter.load(name)
    label = name.split("-")[1]
    layers = [(np.asarray(m, np.float32), np.asarray(b, np.float32)) for m, b in adapter.layers]
    size = layers[0][0].shape[1]
    rng = np.random.default_rng(0)
    one, many = rng.random((1, size), np.float32), rng.random((QUERIES, size), np.float32)
    return [
        row(label, "network", "NumPy", best(lambda: network.forward(layers, one), 200)),
        row(label, "network, batch", "NumPy", best(lambda: network.forward(layers, many), 5) / QUERIES),
        row(label, "network, batch", "drjit.nn, float16", drjit_nn(layers, many)),
    ]


def drjit_nn(layers: list, many: np.ndarray) -> float:
    """Returns the seconds per query of drjit.nn with packed float16 weights, without the time of compilation."""
    ensure_llvm()
    import drjit.nn as nn
    from drjit.llvm import Float16, Float32, TensorXf16

    dr.set_thread_count(1)
    parts: list = []
    for matrix, _ in layers[:-1]:
        parts += [nn.Linear(matrix.shape[1], matrix.shape[0]), nn.ReLU()]
    parts.append(nn.Linear(layers[-1][0].shape[1], layers[-1][0].shape[0]))
    net: Any = nn.Sequential(*parts).alloc(TensorXf16, layers[0][0].shape[1])
    net = nn.pack(net, layout="inference")
    inputs = [Float16(Float32(column)) for column in many.T]
    dr.eval(inputs, net)

    def run() -> None:
        outputs = net(nn.CoopVec(*inputs))
        dr.eval(list(outputs))
        dr.sync_thread()

    run()
    return best(run, 5) / len(many)


def best(call, repetitions: int) -> float:
    """Calls a function several times, and returns the seconds of the fastest call."""
    least = float("inf")
    for _ in range(repetitions):
        began = time.perf_counter()
        call()
        least = min(least, time.perf_counter() - began)
    return least


def row(network_name: str, what: str, by: str, seconds: float) -> dict:
    return {"network": network_name, "what": what, "set": by, "ns": round(1e9 * seconds, 2)}


def table(title: str, what: tuple[str, ...], rows: list[dict]) -> None:
    print(f"\n{title}\n  {'':7} {'':18} " + "".join(f"{w:>28}" for w in what))
    keys = dict.fromkeys((r["network"], r["set"]) for r in rows if r["what"] in what)
    for key in sorted(keys, key=lambda k: k[0]):
        cells = {r["what"]: r["ns"] for r in rows if (r["network"], r["set"]) == key}
        print(
            f"  {key[0]:7} {key[1]:18} "
            + "".join(f"{cells[w]:28.1f}" if w in cells else f"{'':28}" for w in what)
        )


if __name__ == "__main__":
    main()
