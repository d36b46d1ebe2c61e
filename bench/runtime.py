"""Times per query of the C++ runtime, by instruction set, compared with Eigen, NumPy, drjit.nn and a large decoder.

python -m bench.runtime [ADAPTER ...] [--json OUT.json]

The adapters are names of shipped ones or files; without any, all shipped ones are measured. Times are in nanoseconds on
one thread. Each time is the shortest of many repetitions, in which the adapters take turns. Behind a time of the C++
runtime stands its ratio to that of the first adapter. The code of prepared BRDFs is compiled for this CPU (`any`), and
without options for a CPU (`any, plain`). Eigen is measured if its headers are installed (Debian: libeigen3-dev). The
large decoder has 1.07 million parameters.
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
    parser.add_argument("adapters", nargs="*", metavar="ADAPTER", help="a shipped adapter or a weights file")
    parser.add_argument("--json", type=Path, help="also write all figures to this file")
    arguments = parser.parse_args()
    print(header(), flush=True)
    adapters = {label(name): name for name in arguments.adapters or nma.shipped()}
    rows = cpp(adapters) + [row for name in adapters.items() for row in python(*name)]
    peak = next((r["ns"] for r in rows if r["what"].startswith("peak")), None)
    for title, what in (
        ("one query, ns", ("network", "inputs and network", "prepare")),
        ("per query of a batch, ns", ("network, batch", "inputs and network, batch", "prepare, batch")),
        ("once prepared, ns", ("curves", "eval and pdf", "sample, eval and pdf")),
    ):
        table(title, what, rows, list(adapters))
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


def label(name: str) -> str:
    """Returns what the tables call an adapter: the name of its file, without that of the class."""
    return Path(name).name.removesuffix(".safetensors").removeprefix("layered3-")


def cpp(adapters: dict[str, str]) -> list[dict]:
    """Compiles and runs bench/runtime.cpp on this machine, and returns its measurements of the labelled adapters."""
    words = [f"{label}={weights_file(name)}" for label, name in adapters.items()]
    eigen = [f"-isystem{EIGEN}"] if Path(EIGEN).exists() else []
    return measured(["-march=native", *eigen], words) + measured([], ["prepared", *words])


def measured(options: list[str], words: list[str]) -> list[dict]:
    """Compiles bench/runtime.cpp with these options, runs it with these words, and returns what it prints."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "runtime"
        flags = ["-std=c++17", "-O2", *options, f"-I{build.sources()}"]
        subprocess.run([build.compiler(), *flags, str(HERE / "runtime.cpp"), "-o", str(program)], check=True)
        run = subprocess.run([program, *words], capture_output=True, text=True, check=True)
    return [json.loads(line) for line in run.stdout.splitlines()]


def python(label: str, name: str) -> list[dict]:
    """Returns the times of an adapter's network in NumPy and in drjit.nn, on one thread."""
    layers = [
        (np.asarray(m, np.float32), np.asarray(b, np.float32)) for m, b in nma.Adapter.load(name).layers
    ]
    size = layers[0][0].shape[1]
    rng = np.random.default_rng(0)
    one, many = rng.random((1, size), np.float32), rng.random((QUERIES, size), np.float32)
    rows = [
        row(label, "network", "NumPy", best(lambda: network.forward(layers, one), 200)),
        row(label, "network, batch", "NumPy", best(lambda: network.forward(layers, many), 5) / QUERIES),
    ]
    # `drjit.nn.Sequential` has no layers that read the inputs again.
    if layers[-1][0].shape[1] == len(layers[-2][1]):
        rows.append(row(label, "network, batch", "drjit.nn, float16", drjit_nn(layers, many)))
    return rows


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


def table(title: str, what: tuple[str, ...], rows: list[dict], adapters: list[str]) -> None:
    """Prints the times `what` of all networks, and for adapters their ratios to the times of the first adapter."""
    print(f"\n{title}\n  {'':16} {'':18} " + "".join(f"{w:>28}" for w in what))
    times = {(r["network"], r["set"], r["what"]): r["ns"] for r in rows if r["what"] in what}
    for name, by in sorted(dict.fromkeys(key[:2] for key in times), key=lambda key: key[0]):
        usual = [times.get((adapters[0], by, w)) if name in adapters[1:] else None for w in what]
        cells = [cell(times.get((name, by, w)), ns) for w, ns in zip(what, usual, strict=True)]
        print(f"  {name:16} {by:18} " + "".join(f"{text:>28}" for text in cells))


def cell(ns: float | None, usual: float | None) -> str:
    """Returns a time as text, followed by its ratio to the time `usual`, if there is one."""
    if ns is None:
        return ""
    return f"{ns:.1f} ({ns / usual:4.2f})" if usual else f"{ns:.1f}       "


if __name__ == "__main__":
    main()
