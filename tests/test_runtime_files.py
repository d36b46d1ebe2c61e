"""Files of the C++ runtime: faulty weights files are refused, and the generated headers are up to date."""

import importlib.util
import json
import math
import re
import struct
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from adapter_cases import random_adapter
from weights_cases import FIRST, changed, header_of, packed, ranged, stored

from nma.adapter import Adapter
from nma.errors import ParamError, WeightsError
from nma.export import FILES, printed
from nma.export.cpp import print_function
from nma.export.functions import Unsupported, parsed
from nma.native.runtime import Runtime
from nma.params import LAYERED3

ROOT = Path(__file__).parent.parent
IN_PLANE = {"name": "anisotropic", "size": 1, "low": 0, "high": 1, "scale": "linear", "in_plane": True}


# Faulty records of a material: an object, texts, truths, and numbers outside the ranges that the source accepts.
OTHER_PARAMS = (
    {str(k): 0.5 for k in range(13)},
    ["0.5"] * 13,
    [True] * 13,
    [5.0] * 13,
    [-0.5] * 13,
)


TARGET = header_of(FIRST)[1]["target"]
BASE_COLOR = TARGET[0]


def shifted(places, gap=b""):
    """Returns a weights file with the bytes `gap` before its tensors.

    The header adds `places` bytes to the offset of every tensor.
    """
    header, about, data = header_of(FIRST)
    for entry in (entry for name, entry in header.items() if name != "__metadata__"):
        entry["data_offsets"] = [places + at for at in entry["data_offsets"]]
    return packed(header, about, gap + data)


def of_integers(name):
    header, about, data = header_of(FIRST)
    header[name]["dtype"] = "I32"
    return packed(header, about, data)


def with_more(tensor):
    """Returns a weights file with one additional tensor at its end."""
    header, about, data = header_of(FIRST)
    extra = {"dtype": tensor.dtype.str.replace("<f", "F").replace("4", "32").replace("8", "64")}
    extra |= {"shape": list(tensor.shape), "data_offsets": [len(data), len(data) + tensor.nbytes]}
    return packed(header | {"more": extra}, about, data + tensor.tobytes())


def nested(depth):
    """Returns a weights file whose metadata is nested `depth` levels deep, by its training record."""
    _, about, _ = header_of(FIRST)
    about["training"] = "HERE"
    text = json.dumps(about).replace('"HERE"', '{"a": ' * (depth - 1) + "1" + "}" * (depth - 1))
    header, _, data = header_of(FIRST)
    return packed(header, text, data)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize(
    "data, message",
    [
        (b"", "too short"),
        (stored(FIRST)[:1000], "truncated"),
        (stored(FIRST)[:-4], "does not lie within the file"),
        (b"\xff" * 100, "truncated"),
        (struct.pack("<Q", 2) + b"{}", "__metadata__"),
        (struct.pack("<Q", 3) + b'{"a', "a string without an end"),
        (struct.pack("<Q", 60) + b"[" * 60, "nested too deep"),
        (changed(FIRST, format=2), "format"),
        (changed(FIRST, encoding="new"), "unknown input encoding 'new'"),
        (changed(FIRST, dialect="cycles"), "dialect 'cycles'"),
        (changed(FIRST, instances=1), "does not fit its description"),
        (changed(FIRST, hidden=[32, 32, 31]), "hidden layers"),
        (changed(FIRST, hidden="many"), "'hidden'"),
        (changed(FIRST, target=[]), "target parameters must have a base_color, and no name twice"),
        (changed(FIRST, target=[BASE_COLOR]), "does not fit its description"),
        (changed(FIRST, target=[*TARGET[:3], *TARGET[1:]]), "base_color, and no name twice"),
        # `sheen` occurs twice and `sheen_tint` is missing. The number of outputs is still correct, so the file passes
        # the check of this number.
        (
            changed(FIRST, target=[*TARGET[:6], TARGET[5], *TARGET[7:]]),
            "base_color, and no name twice",
        ),
        (changed(FIRST, encoding="azimuth"), "does not fit its description"),
        (
            changed(FIRST, encoding="azimuth", target=[BASE_COLOR, IN_PLANE]),
            "lobes stretch along the plane of incidence",
        ),
        (changed(FIRST, encoding="azimuth", directional=False), "does not read the view direction"),
    ],
)
def test_inconsistent_files_are_refused(tmp_path, data, message):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(data)
    with pytest.raises(WeightsError, match=re.escape(f"{path}: ") + ".*" + re.escape(message)):
        Runtime(path)


@pytest.mark.usefixtures("compiler")
def test_a_folder_is_no_weights_file(tmp_path):
    """A folder in place of a file is refused with an `nma::Error`.

    A folder can be opened like a file, and only reading from it fails.
    """
    with pytest.raises(
        WeightsError, match=re.escape(f"{tmp_path}: no such weights file, or it cannot be read")
    ):
        Runtime(tmp_path)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize(
    "data, message",
    [
        (nested(33), "nested too deep"),
        (nested(100_000), "nested too deep"),
        (shifted(1), "does not lie within the file"),
        (shifted(1, b"x"), "tensor layer0.bias does not begin where the tensor before it ends"),
        (shifted(0)[:-4] + b"more" * 2, "the tensors end before the file does"),
        (of_integers("layer1.weight"), "tensor layer1.weight is not float32"),
        (with_more(np.ones(3)), "tensor more is not float32"),
        (ranged("parameters", 3, high=1.001e6), "parameter 'eta_conductor' has no valid range"),
        (ranged("parameters", 3, high=math.inf), "JSON"),
        (ranged("parameters", 0, low=-1.0), "parameter 'alpha_top' has no valid range"),
        (ranged("parameters", 6, low=2.0), "parameter 'sigma_t' has no valid range"),
        (ranged("parameters", 6, high=None), "'high'"),
        (ranged("target", 1, high=1e300), "target parameter 'roughness' has no valid range"),
        (ranged("target", 0, low=-5.0), "target parameter 'base_color' has no valid range"),
        (ranged("target", 3, high=12.01), "target parameter 'specular' has no valid range"),
        (ranged("target", 3, high=math.nan), "JSON"),
        (ranged("target", 2, scale="cubic"), "unknown scale 'cubic'"),
        (ranged("target", 2, in_plane=True), "'metallic' has the flag in_plane"),
    ],
)
def test_files_with_implausible_numbers_are_refused(tmp_path, data, message):
    """The runtime and the package refuse files that would lead to NaN, to negative values or to wrong values."""
    path = tmp_path / "bad.safetensors"
    path.write_bytes(data)
    with pytest.raises(WeightsError, match=re.escape(f"{path}: ") + ".*" + re.escape(message)):
        Runtime(path)
    with pytest.raises(WeightsError):
        Adapter.load(path)


@pytest.mark.usefixtures("compiler")
def test_unusual_but_valid_files_load(tmp_path):
    path = tmp_path / "good.safetensors"
    for data in (
        nested(32),
        with_more(np.ones((5000, 2), np.float32)),
        with_more(np.ones((0, 3), np.float32)),
        ranged("target", 3, high=12.0),
    ):
        path.write_bytes(data)
        assert Runtime(path).parameters == 13
        assert Adapter.load(path).space.size == 13


@pytest.mark.usefixtures("compiler")
def test_ranges_of_parameters_may_be_as_wide_as_the_readme_says(tmp_path):
    """The runtime knows no classes, so a class may have other ranges than the classes of the package."""
    path = tmp_path / "wide.safetensors"
    path.write_bytes(ranged("parameters", 3, low=-1e6, high=1e6))
    assert Runtime(path).parameters == 13
    path.write_bytes(ranged("parameters", 3, low=-1.001e6))
    with pytest.raises(WeightsError, match="parameter 'eta_conductor' has no valid range"):
        Runtime(path)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize(
    ("width", "message"),
    [
        (512, None),
        (513, "runs at most 512 inputs"),
        (4096, "runs at most 512 inputs"),
        (4097, "the header has a size"),
    ],
)
def test_a_network_that_is_too_wide_is_refused_with_the_limit(tmp_path, width, message):
    path = tmp_path / "wide.safetensors"
    adapter = random_adapter(hidden="1x8")
    (first, _), (last, bias) = adapter.layers
    layers = [(np.resize(first, (width, first.shape[1])), np.zeros(width, np.float32))]
    replace(adapter, layers=[*layers, (np.resize(last, (len(bias), width)), bias)]).save(path)
    if message is None:
        assert Runtime(path).parameters == 13
    else:
        with pytest.raises(WeightsError, match=message):
            Runtime(path)


@pytest.mark.usefixtures("compiler")
def test_an_adapter_of_one_material_accepts_only_its_parameters(tmp_path):
    """The runtime accepts only the parameters in the adapter's record, up to rounding, even beyond the training range.

    `nma.adapter.Adapter.check` in the package accepts the same parameters as the runtime.
    """
    path, vector = tmp_path / "one.safetensors", LAYERED3.sample(np.random.default_rng(0), 1)[0]
    vector[12] = 3.0
    vector = vector.astype(np.float32).astype(np.float64)
    adapter = random_adapter(hidden="1x8", name="direction")
    replace(adapter, training={"params": vector.tolist()}).save(path)
    runtime, mu = Runtime(path), np.float32([0.5])
    np.testing.assert_allclose(runtime.material, vector, rtol=1e-6)
    own = vector[None].astype(np.float32)
    assert np.isfinite(runtime.outputs(own, mu)).all()
    other = own * np.where(np.arange(13) == 9, 1.001, 1)
    for clamp in (False, True):
        with pytest.raises(
            ParamError, match="^row 1: .* trained for a single material, whose albedo is"
        ) as told:
            runtime.prepare(np.concatenate([own, other]), mu.repeat(2), clamp=clamp)
        with pytest.raises(ParamError) as also_told:
            replace(adapter, training={"params": vector.tolist()}).check(np.concatenate([own, other]))
        assert str(told.value) == str(also_told.value)
    for params in ([], [1.0], [[1.0] * 13], ["a"] * 13, [1e300] * 13, *OTHER_PARAMS):
        replace(adapter, training={"params": params}).save(path)
        with pytest.raises(WeightsError, match="the recorded material does not fit the class layered3"):
            Runtime(path)
        with pytest.raises(WeightsError, match="the recorded material does not fit the class layered3"):
            Adapter.load(path)
    for params in (None, "absent"):
        replace(adapter, training={} if params else {"params": None}).save(path)
        assert Runtime(path).material is None and Adapter.load(path).material is None


@pytest.mark.parametrize("name", FILES)
def test_the_generated_headers_are_up_to_date(name):
    assert (ROOT / "runtime" / name).read_text() == printed(name), "run `python -m nma.export`"


def module_of(text, path: Path) -> ModuleType:
    path.write_text(textwrap.dedent(text))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_python_that_cannot_be_exported_is_refused_with_file_and_line(tmp_path, monkeypatch):
    text = """
    def broken(x: float) -> float:
        y = x + 1.0
        return y if x > 0 else x
    """
    path = tmp_path / "broken.py"
    module = module_of(text, path)
    monkeypatch.setitem(sys.modules, "broken", module)
    with pytest.raises(Unsupported, match=r"broken\.py:4: `y if x > 0 else x` cannot be exported"):
        print_function(parsed(module.broken))
