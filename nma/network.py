"""The multilayer perceptron: linear layers with ReLU between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import NmaError
from nma.ops import Float

# Share of He's random matrix in hidden layers that start near the identity.
_MIXING = 0.25

Layers = list[tuple[Any, Any]]  # (matrix (out, in), bias (out,)) per layer

# Sums in a dot product of `forward_lanes`: a query of a 5x64 network took .56 us of a Zen 4 core, with one .70.
_SUMS = 4


def init(rng: np.random.Generator, sizes: Sequence[int], output_bias: NDArray | None = None) -> Layers:
    """Random layers: He 2015 initialisation, with hidden layers of equal width starting near the identity, so that a
    deep network starts out as easy to train as a shallow one; the last layer starts small around `output_bias`."""
    layers: Layers = []
    for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
        matrix = rng.standard_normal((fan_out, fan_in)) * np.sqrt(2.0 / fan_in)
        if fan_in == fan_out:
            matrix = np.eye(fan_in) + _MIXING * matrix
        layers.append((matrix.astype(np.float32), np.zeros(fan_out, np.float32)))
    matrix, bias = layers[-1]
    layers[-1] = (0.1 * matrix, bias if output_bias is None else np.asarray(output_bias, np.float32))
    return layers


def forward(layers: Layers, x: Any) -> Any:
    """Outputs (n, out) for inputs (n, in), on NumPy or JAX."""
    for matrix, bias in layers[:-1]:
        x = ops.maximum(x @ matrix.T + bias, 0.0)
    matrix, bias = layers[-1]
    return x @ matrix.T + bias


def forward_lanes(
    layers: Sequence[tuple[NDArray, NDArray]], x: Sequence[Float], active: Any = True
) -> list[Float]:
    """Outputs for one input per list entry, on Dr.Jit: the network unrolled into the kernel, weights as literals.

    Inside a renderer's virtual functions this is the fast way: on LLVM, weights in memory, as `drjit.nn` has them, are
    gathered there lane by lane, which takes ten times as long. Packets without an `active` lane skip the network and
    return zeros: a renderer calls the only BSDF of a scene for rays that met nothing, too.
    """
    import drjit as dr

    if active is True:
        return _unrolled(layers, x)
    outputs = dr.if_stmt(
        tuple(x),
        active,
        lambda *inputs: tuple(_unrolled(layers, inputs)),
        lambda *inputs: (dr.zeros(type(inputs[0])),) * len(layers[-1][1]),
        label="network",
    )
    return list(outputs)


def _unrolled(layers: Sequence[tuple[NDArray, NDArray]], x: Sequence[Float]) -> list[Float]:
    import drjit as dr

    x = list(x)
    last = len(layers) - 1
    for number, (matrix, bias) in enumerate(layers):
        sums = [_dot(row, x, b) for row, b in zip(matrix.tolist(), bias.tolist(), strict=True)]
        x = sums if number == last else [dr.maximum(s, 0.0) for s in sums]
    return x


def _dot(row: Sequence[float], x: Sequence[Float], bias: float) -> Float:
    """bias + row . x as a few independent sums: in a single one each multiplication waits for the one before it."""
    import drjit as dr

    sums = []
    for first in range(_SUMS):
        total = type(x[0])(bias if first == 0 else 0.0)
        for w, value in zip(row[first::_SUMS], x[first::_SUMS], strict=True):
            total = dr.fma(value, w, total)
        sums.append(total)
    return sum(sums[1:], sums[0])


def parameters(layers: Layers) -> int:
    """Number of trainable numbers."""
    return sum(m.size + b.size for m, b in layers)


def hidden(name: str) -> list[int]:
    """Hidden layer sizes of a network named like "5x64"."""
    depth, _, width = name.partition("x")
    if not (depth.isdigit() and width.isdigit() and int(depth) > 0 and int(width) > 0):
        raise NmaError(f"a network is written as DEPTHxWIDTH, for example 5x64; got '{name}'")
    return [int(width)] * int(depth)
