"""The weights file: safetensors, with everything needed to use the network as JSON in its header.

Tensors `layer0.weight` (out, in), `layer0.bias` (out,), `layer1.weight`, ... float32. The header's metadata has one entry,
`nma`, a JSON object with the fields of `Header`.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from nma.errors import WeightsError
from nma.network import Layers
from nma.params import SPACES, ParamSpace

FORMAT = 1


@dataclass(frozen=True)
class Header:
    """What a weights file says about itself.

    `parameters` repeats the class's declaration, so that other languages need no Python. `reciprocal` holds for adapters
    whose target does not depend on the view direction. `target` lists the target's numbers with their ranges, `dialect`
    names the Principled BRDF meant. `training` is the record of how the weights came to be.
    """

    class_name: str
    parameters: list[dict[str, Any]]
    encoding: str
    hidden: list[int]
    instances: int
    directional: bool
    reciprocal: bool
    dialect: str
    target: list[dict[str, Any]]
    training: dict[str, Any] = field(default_factory=dict)
    format: int = FORMAT


def describe(space: ParamSpace) -> list[dict[str, Any]]:
    """A class's declaration as JSON data; infinite bounds become null."""
    rows = [asdict(p) for p in space.params]
    return [{k: None if v in (float("inf"), float("-inf")) else v for k, v in row.items()} for row in rows]


def write(path: str | Path, header: Header, layers: Layers) -> None:
    """Writes the file atomically."""
    tensors = {}
    for number, (matrix, bias) in enumerate(layers):
        tensors[f"layer{number}.weight"] = np.ascontiguousarray(matrix, np.float32)
        tensors[f"layer{number}.bias"] = np.ascontiguousarray(bias, np.float32)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    partial.write_bytes(save(tensors, metadata={"nma": json.dumps(asdict(header))}))
    partial.replace(path)


def read(path: str | Path) -> tuple[Header, Layers]:
    """Header and layers of a weights file; `WeightsError` says what is wrong with it."""
    path = Path(path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such weights file; `nma train` or `nma fit` writes one")
    try:
        with safe_open(path, framework="numpy") as f:
            metadata = f.metadata() or {}
            tensors = {name: f.get_tensor(name) for name in f.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as e:
        raise WeightsError(
            f"{path}: truncated, or not a safetensors file ({e}); copy or train it again"
        ) from None
    if "nma" not in metadata:
        raise WeightsError(f"{path}: a safetensors file without NMA metadata; `nma train` writes adapters")
    try:
        header = Header(**json.loads(metadata["nma"]))
    except (TypeError, json.JSONDecodeError) as e:
        raise WeightsError(
            f"{path}: metadata of another version ({e}); upgrade the package or train again"
        ) from None
    _check_class(path, header)
    return header, _layers(path, header, tensors)


def _check_class(path: Path, header: Header) -> None:
    """Refuses formats and classes that this version does not know, or knows differently."""
    if header.format != FORMAT:
        raise WeightsError(
            f"{path}: format {header.format}, this version reads {FORMAT}; upgrade the package"
        )
    space = SPACES.get(header.class_name)
    if space is None:
        raise WeightsError(
            f"{path}: made for class '{header.class_name}'; this version knows {', '.join(SPACES)}"
        )
    names = [(p["name"], p["size"]) for p in header.parameters]
    if names != [(p.name, p.size) for p in space.params]:
        raise WeightsError(
            f"{path}: its class '{header.class_name}' has the parameters {names}, unlike this version's"
        )


def _layers(path: Path, header: Header, tensors: dict[str, np.ndarray]) -> Layers:
    """The layers in order, after checking that their shapes fit together."""
    layers: Layers = []
    for number in range(len(header.hidden) + 1):
        try:
            matrix, bias = tensors[f"layer{number}.weight"], tensors[f"layer{number}.bias"]
        except KeyError as e:
            raise WeightsError(f"{path}: tensor {e} is missing; copy or train it again") from None
        fan_in = layers[-1][0].shape[0] if layers else matrix.shape[-1]
        if matrix.ndim != 2 or matrix.shape[1] != fan_in or bias.shape != matrix.shape[:1]:
            raise WeightsError(
                f"{path}: layer {number} has shapes {matrix.shape} and {bias.shape}, which do not fit"
            )
        if not (np.isfinite(matrix).all() and np.isfinite(bias).all()):
            raise WeightsError(f"{path}: layer {number} holds numbers that are not finite; train again")
        layers.append((matrix, bias))
    return layers
