"""The multilayer perceptron: linear layers with ReLU between them."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import NmaError
from nma.ops import Float

# Share of He's random matrix in hidden layers that start near the identity.
_MIXING = 0.25

# Far beyond what a renderer can run for each shading point.
_MOST_LAYERS, _MOST_NEURONS = 64, 1024

Layers = list[tuple[Any, Any]]  # (matrix (out, in), bias (out,)) per layer
_Activation = Callable[[Float], Float]

# Sums in a dot product of `forward_lanes`: a query of a 5x64 network took .56 us of a Zen 4 core, with one .70.
_SUMS = 4
# Neurons of `forward_lanes` whose sums AVX-512 keeps in its 32 registers: a query of a 5x64 network took .34 us of an
# Intel Xeon (family 6, model 167), without blocks .47. With the 16 registers of AVX2, blocks make it no faster.
_BLOCK = 28


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

    def relu(total: Float) -> Float:
        return dr.maximum(total, 0.0)

    layer = _in_blocks if _many_registers(x[0]) else _by_neuron
    for matrix, bias in layers[:-1]:
        x = layer(matrix.tolist(), bias.tolist(), x, relu)
    matrix, bias = layers[-1]
    return layer(matrix.tolist(), bias.tolist(), x, lambda total: total)


def _by_neuron(
    matrix: list[list[float]], bias: list[float], x: Sequence[Float], activation: _Activation
) -> list[Float]:
    """Each dot product as a few independent sums: in a single one each multiplication waits for the one before it."""
    import drjit as dr

    outputs = []
    for row, b in zip(matrix, bias, strict=True):
        sums = []
        for first in range(_SUMS):
            total = type(x[0])(b if first == 0 else 0.0)
            for w, value in zip(row[first::_SUMS], x[first::_SUMS], strict=True):
                total = dr.fma(value, w, total)
            sums.append(total)
        outputs.append(activation(sum(sums[1:], sums[0])))
    return outputs


def _in_blocks(
    matrix: list[list[float]], bias: list[float], x: Sequence[Float], activation: _Activation
) -> list[Float]:
    """Blocks of neurons whose sums stay in registers while one input after the other is added: an input is fetched once
    for a block. Dr.Jit orders what it compiles by its needs, but for scopes, which it leaves in their order."""
    import drjit as dr

    outputs: list[Float] = []
    for first in range(0, len(bias), _BLOCK):
        rows = matrix[first : first + _BLOCK]
        sums = [type(x[0])(b) for b in bias[first : first + _BLOCK]]
        for i, value in enumerate(x):
            dr.detail.new_scope(dr.backend_v(value))
            sums = [dr.fma(value, row[i], s) for row, s in zip(rows, sums, strict=True)]
        dr.detail.new_scope(dr.backend_v(x[0]))
        outputs += [activation(s) for s in sums]
    return outputs


def _many_registers(value: Float) -> bool:
    """Whether kernels for this array have the 32 vector registers of AVX-512."""
    import drjit as dr

    core: Any = (
        sys.modules.get("numpy._core._multiarray_umath") or sys.modules["numpy.core._multiarray_umath"]
    )
    features: dict[str, bool] = core.__cpu_features__
    return dr.backend_v(value) == dr.JitBackend.LLVM and features.get("AVX512F", False)


def parameters(layers: Layers) -> int:
    """Number of trainable numbers."""
    return sum(m.size + b.size for m, b in layers)


def hidden(name: str) -> list[int]:
    """Hidden layer sizes of a network named like "5x64"."""
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", name, re.ASCII)
    depth, width = (int(number) for number in found.groups()) if found else (0, 0)
    if not (0 < depth <= _MOST_LAYERS and 0 < width <= _MOST_NEURONS):
        raise NmaError(
            f"a network is written as DEPTHxWIDTH, for example 5x64, at most {_MOST_LAYERS}x{_MOST_NEURONS}; "
            f"got '{name}'"
        )
    return [width] * depth
