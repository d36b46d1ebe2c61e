"""Evaluates the network of an adapter: linear layers with ReLU between them.

The last layer may read the inputs of the network, too, in addition to the neurons of the layer before. Its matrix then
has further columns, for the inputs.
"""

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

# `init` sets a layer with as many inputs as outputs to the identity plus this factor times the random matrix of He
# 2015.
_MIXING = 0.25

# The largest depth and width of a network. Larger networks would be too slow to run at every shading point.
_MOST_LAYERS, _MOST_NEURONS = 64, 1024

Layers = list[tuple[Any, Any]]  # for each layer: the matrix (out, in) and the bias (out,)
_Activation = Callable[[Float], Float]

# `forward_lanes` splits a dot product into _SUMS sums. A query of a 5x64 network took .56 us on a Zen 4 core with 4
# sums, and .70 us with one sum.
_SUMS = 4
# With AVX-512, `forward_lanes` computes the neurons in blocks of _BLOCK neurons, because the sums of a block fit in the
# 32 registers. A query of a 5x64 network took .34 us on an Intel Xeon (family 6, model 167) with blocks, and .47 us
# without. With the 16 registers of AVX2, blocks bring no gain.
_BLOCK = 28


def init(
    rng: np.random.Generator,
    sizes: Sequence[int],
    output_bias: NDArray | None = None,
    skip: NDArray | None = None,
) -> Layers:
    """Random layers of the given `sizes` (inputs, hidden layers, outputs), initialised as in He 2015.

    A layer with as many inputs as outputs is initialised near the identity, which makes a deep network as easy to train
    as a shallow network. The last layer has small weights and the bias `output_bias` (outputs,), or the bias 0 if
    `output_bias` is None. With `skip` (outputs, inputs), the last layer reads the inputs, too, by these weights.
    """
    layers: Layers = []
    for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
        matrix = rng.standard_normal((fan_out, fan_in)) * np.sqrt(2.0 / fan_in)
        if fan_in == fan_out:
            matrix = np.eye(fan_in) + _MIXING * matrix
        layers.append((matrix.astype(np.float32), np.zeros(fan_out, np.float32)))
    matrix, bias = layers[-1]
    matrix = 0.1 * matrix if skip is None else np.concatenate([0.1 * matrix, skip], axis=1, dtype=np.float32)
    layers[-1] = (matrix, bias if output_bias is None else np.asarray(output_bias, np.float32))
    return layers


def skip_width(layers: Sequence[tuple[Any, Any]]) -> int:
    """The number of the network's inputs that the last layer reads, all or none of them."""
    return int(layers[-1][0].shape[1] - layers[-2][0].shape[0]) if len(layers) > 1 else 0


def forward(layers: Layers, x: Any) -> Any:
    """The outputs (n, out) of the network for the inputs `x` (n, in), in NumPy, in JAX, or of Dr.Jit's tensors."""
    y = x
    for matrix, bias in layers[:-1]:
        y = ops.maximum(y @ matrix.T + bias, 0.0)
    matrix, bias = layers[-1]
    if not skip_width(layers):
        return y @ matrix.T + bias
    own = matrix.shape[1] - skip_width(layers)
    return y @ matrix[:, :own].T + (x @ matrix[:, own:].T + bias)


def forward_lanes(
    layers: Sequence[tuple[NDArray, NDArray]], x: Sequence[Float], active: Any = True
) -> list[Float]:
    """The outputs of the network in Dr.Jit. `x` has one array per input, and the result has one array per output.

    The network is unrolled into the kernel, with its weights as literals. In the virtual functions of a renderer,
    reading the weights from memory, as `drjit.nn` does, would take ten times as long on LLVM, because the weights would
    be gathered lane by lane. A SIMD packet without any `active` lane skips the network and returns zeros. The skip
    saves time, because in a scene with only one BSDF, a renderer calls this BSDF even for rays that hit nothing.
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
    inputs = list(x) if skip_width(layers) else []
    for matrix, bias in layers[:-1]:
        x = layer(matrix.tolist(), bias.tolist(), x, relu)
    matrix, bias = layers[-1]
    return layer(matrix.tolist(), bias.tolist(), [*x, *inputs], lambda total: total)


def _by_neuron(
    matrix: list[list[float]], bias: list[float], x: Sequence[Float], activation: _Activation
) -> list[Float]:
    """Computes a layer neuron by neuron, with each dot product split into independent sums.

    In a single sum, every addition would have to wait for the previous addition.
    """
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
    """Computes a layer in blocks of neurons. The sums of a block stay in registers while the inputs are processed one
    by one, so every input is loaded once per block. Each input gets a new scope, because Dr.Jit may reorder operations
    within a scope, but it keeps the order of scopes.
    """
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
    """Whether kernels for arrays of this type can use the 32 vector registers of AVX-512."""
    import drjit as dr

    core: Any = (
        sys.modules.get("numpy._core._multiarray_umath") or sys.modules["numpy.core._multiarray_umath"]
    )
    features: dict[str, bool] = core.__cpu_features__
    return dr.backend_v(value) == dr.JitBackend.LLVM and features.get("AVX512F", False)


def parameters(layers: Layers) -> int:
    """The number of trainable parameters."""
    return sum(m.size + b.size for m, b in layers)


def hidden(name: str) -> list[int]:
    """The widths of the hidden layers of a network with a name such as "5x64".

    Raises `NmaError` if the name is malformed or the network is too large.
    """
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", name, re.ASCII)
    depth, width = (int(number) for number in found.groups()) if found else (0, 0)
    if not (0 < depth <= _MOST_LAYERS and 0 < width <= _MOST_NEURONS):
        raise NmaError(
            f"a network is written as DEPTHxWIDTH, for example 5x64, at most {_MOST_LAYERS}x{_MOST_NEURONS}; "
            f"got '{name}'"
        )
    return [width] * depth
