"""Reads and writes weights files, which are safetensors files whose header describes the network in JSON.

The tensors are float32: `layer0.weight` (out, in), `layer0.bias` (out,), `layer1.weight` and so on. The file of a
library (`nma.adapter.library`) also has the tensor `codes`. The metadata in the header has one entry, `nma`: a JSON
object with the fields of `Header`.
"""

from __future__ import annotations

import json
import math
import os
import re
import textwrap
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_origin, get_type_hints

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from nma import sources
from nma.errors import WeightsError, shown
from nma.files import write_bytes
from nma.network import Layers
from nma.params import ParamSpace

FORMAT = 1
# Brackets in the metadata may nest at most MAX_DEPTH deep. In the files of trained adapters, brackets nest 4 deep.
MAX_DEPTH = 32


@dataclass(frozen=True)
class Header:
    """The metadata of a weights file.

    `parameters` declares the parameters of the class, so that programs in other languages do not need this package.
    `reciprocal` is true if the target does not depend on the view direction. `target` lists the target's parameters
    with their ranges. `dialect` names the version of the Principled BRDF. `bounded` says whether the target is dimmed
    where it might reflect more light than it receives. `interface` names the two parameters of the class that are the
    width and the index of the interface under which the target lies; it is empty for other targets. `skip` says whether
    the last layer reads the network's inputs, too (`nma.network`). `training` records how the weights were made.
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
    bounded: bool = False
    training: dict[str, Any] = field(default_factory=dict)
    format: int = FORMAT
    interface: list[str] = field(default_factory=list)
    skip: bool = False


def describe(space: ParamSpace) -> list[dict[str, Any]]:
    """The parameters of a class, with their ranges, as JSON data. Infinite bounds become null."""
    rows = [asdict(p) for p in space.params]
    return [{k: None if v in (float("inf"), float("-inf")) else v for k, v in row.items()} for row in rows]


def write(
    path: str | Path, header: Header, layers: Layers, more: Mapping[str, np.ndarray] | None = None
) -> None:
    """Writes a weights file, atomically. `more` contains further tensors to store in the same file."""
    tensors = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in (more or {}).items()}
    for number, (matrix, bias) in enumerate(layers):
        tensors[f"layer{number}.weight"] = np.ascontiguousarray(matrix, np.float32)
        tensors[f"layer{number}.bias"] = np.ascontiguousarray(bias, np.float32)
    write_bytes(path, save(tensors, metadata={"nma": json.dumps(_plain(asdict(header)), allow_nan=False)}))


def _plain(data: Any) -> Any:
    """JSON data with null in place of numbers that are not finite, which JSON does not have."""
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def read(path: str | Path) -> tuple[Header, Layers]:
    """The header and the layers of a weights file. Raises `WeightsError`, which says what is wrong with the file."""
    path = Path(path)
    if not os.path.isfile(path):
        raise WeightsError(f"{path}: no such weights file; `nma train` or `nma fit` writes one")
    try:
        with safe_open(path, framework="numpy") as f:
            metadata = f.metadata() or {}
            types = {name: f.get_slice(name).get_dtype() for name in f.keys()}  # noqa: SIM118
            tensors = {name: f.get_tensor(name) for name, kind in types.items() if kind == "F32"}
    except (SafetensorError, OSError, ValueError, TypeError) as e:
        raise WeightsError(
            f"{path}: truncated, or not a safetensors file ({e}); copy the file again, or train again"
        ) from None
    if "nma" not in metadata:
        raise WeightsError(
            f"{path}: a safetensors file without NMA metadata, so the file is not an adapter; "
            "`nma train` writes adapters"
        )
    _check_types(path, types)
    try:
        _parsed(_raw_header(path))  # safetensors itself accepts a key that occurs twice
        header = _header(metadata["nma"])
    except WeightsError as e:
        raise WeightsError(f"{path}: {e}") from None
    _check_class(path, header)
    return header, _layers(path, header, tensors)


def _check_types(path: Path, types: Mapping[str, str]) -> None:
    """Raises `WeightsError` for tensors that are not float32."""
    for name, kind in types.items():
        if kind != "F32":
            raise WeightsError(
                f"{path}: tensor {shown(name)} holds numbers of type {kind}, but this package reads only F32; convert "
                "the file, or train again"
            )


def _raw_header(path: Path) -> str:
    """The JSON text at the beginning of a safetensors file."""
    with path.open("rb") as file:
        return file.read(int.from_bytes(file.read(8), "little")).decode()


def _parsed(text: str) -> Any:
    """Parses JSON as strictly as the C++ runtime does. Raises `WeightsError` for a key that occurs twice, because
    readers would differ in which of the two values they take, and `ValueError` for text that is not JSON."""
    return json.loads(text, object_pairs_hook=_fields, parse_constant=_finite, parse_float=_finite)


def _fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise WeightsError(
                f"the header has the key {shown(key)} twice; copy the file again or train again"
            )
        found[key] = value
    return found


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"the number {shown(text)} is not finite")
    return number


def _header(text: str) -> Header:
    """Parses the JSON text of the header and checks the type of each field."""
    if _depth(text) > MAX_DEPTH:
        raise WeightsError(
            f"the brackets of the metadata nest {_depth(text)} deep, but at most {MAX_DEPTH} is allowed; train again"
        )
    try:
        found = _parsed(text)
        # A later format may have other fields, so the format is checked before the fields.
        if isinstance(found, dict):
            _check_format(found.get("format"))
        header = Header(**found)
    except WeightsError:
        raise
    except (TypeError, ValueError) as e:
        raise WeightsError(
            f"the metadata comes from another version ({textwrap.shorten(str(e), 200)}); upgrade the package or train "
            "again"
        ) from None
    for name, hint in get_type_hints(Header).items():
        # `isinstance` would count True as an integer.
        if type(getattr(header, name)) is not (get_origin(hint) or hint):
            raise WeightsError(
                f"the metadata field '{name}' has the wrong type, {shown(getattr(header, name))}; train again"
            )
    if any(type(width) is not int for width in header.hidden):
        raise WeightsError(
            f"the metadata field 'hidden' is not a list of whole numbers, {shown(header.hidden)}; train again"
        )
    if any(type(name) is not str for name in header.interface):
        raise WeightsError(
            f"the metadata field 'interface' is not a list of names, {shown(header.interface)}; train again"
        )
    return header


def _check_format(found: Any) -> None:
    if type(found) is not int or found != FORMAT:
        raise WeightsError(
            f"the file has format {shown(found)}, but this version reads format {FORMAT}; upgrade the package"
        )


def _depth(text: str) -> int:
    """How deep the brackets of a JSON text nest. Brackets in strings do not count."""
    depth = deepest = 0
    for token in re.findall(r'"(?:[^"\\]|\\.)*"|[\[{\]}]', text, re.DOTALL):
        depth += (token in "[{") - (token in "]}")
        deepest = max(deepest, depth)
    return deepest


def _check_class(path: Path, header: Header) -> None:
    """Raises `WeightsError` if this version does not support the file's class, or declares other parameters
    for the class."""
    if header.class_name not in sources.classes():
        raise WeightsError(
            f"{path}: the class {shown(header.class_name)} is unknown; this version has {', '.join(sources.classes())}"
        )
    space = sources.space(header.class_name)
    keys = ("name", "size", "law", "low", "high")
    for number, declared in enumerate(describe(space)):
        theirs = header.parameters[number] if number < len(header.parameters) else None
        if not isinstance(theirs, dict) or any(_differ(theirs.get(k), declared[k]) for k in keys):
            raise WeightsError(
                f"{path}: the file's class '{header.class_name}' differs from this version's in parameter {number}, "
                f"{declared['name']}; use the version that wrote the file, or train again"
            )
    if len(header.parameters) > len(space.params):
        raise WeightsError(
            f"{path}: the file's class '{header.class_name}' has more parameters than this version's; "
            "upgrade the package"
        )


def _differ(found: Any, declared: Any) -> bool:
    """Whether a value of the file differs from the declared value. A number may be an integer in place of a float, but
    true and false are not numbers."""
    return found != declared or isinstance(found, bool) or (type(declared) is int and type(found) is not int)


def _layers(path: Path, header: Header, tensors: dict[str, np.ndarray]) -> Layers:
    """The layers in order, after checking that their shapes fit together."""
    layers: Layers = []
    for number in range(len(header.hidden) + 1):
        try:
            matrix, bias = tensors[f"layer{number}.weight"], tensors[f"layer{number}.bias"]
        except KeyError as e:
            raise WeightsError(
                f"{path}: tensor {e} is missing; copy the file again, or train again"
            ) from None
        fan_in = layers[-1][0].shape[0] if layers else matrix.shape[-1] if matrix.ndim else 0
        if header.skip and layers and number == len(header.hidden):
            fan_in += layers[0][0].shape[1]
        if matrix.ndim != 2 or matrix.shape[1] != fan_in or bias.shape != matrix.shape[:1]:
            raise WeightsError(
                f"{path}: layer {number} has weights of shape {matrix.shape} and biases of shape {bias.shape}, which "
                "do not fit together; train again"
            )
        if not (np.isfinite(matrix).all() and np.isfinite(bias).all()):
            raise WeightsError(f"{path}: layer {number} holds numbers that are not finite; train again")
        layers.append((matrix, bias))
    if [m.shape[0] for m, _ in layers[:-1]] != header.hidden:
        raise WeightsError(
            f"{path}: the hidden layers do not have the widths {header.hidden} that the metadata states; train again"
        )
    return layers
