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


def forward_lanes(layers: Sequence[tuple[NDArray, NDArray]], x: Sequence[Float]) -> list[Float]:
    """Outputs for one input per list entry, on Dr.Jit: the network unrolled into the kernel, weights as literals."""
    import drjit as dr

    last = len(layers) - 1
    for number, (matrix, bias) in enumerate(layers):
        outputs = []
        for row, b in zip(matrix.tolist(), bias.tolist(), strict=True):
            total = type(x[0])(b)
            for w, value in zip(row, x, strict=True):
                total = dr.fma(value, w, total)
            outputs.append(total if number == last else dr.maximum(total, 0.0))
        x = outputs
    return list(x)


def parameters(layers: Layers) -> int:
    """Number of trainable numbers."""
    return sum(m.size + b.size for m, b in layers)


def hidden(name: str) -> list[int]:
    """Hidden layer sizes of a network named like "5x64"."""
    depth, _, width = name.partition("x")
    if not (depth.isdigit() and width.isdigit() and int(depth) > 0 and int(width) > 0):
        raise NmaError(f"a network is written as DEPTHxWIDTH, for example 5x64; got '{name}'")
    return [int(width)] * int(depth)
