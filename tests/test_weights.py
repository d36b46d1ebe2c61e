"""Weights files: an adapter is the same after saving and loading, and a faulty file raises an error of one line."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import VARIANTS, materials, random_adapter
from safetensors import safe_open
from safetensors.numpy import save

from nma import adapter as adapters
from nma import target
from nma.adapter import Adapter, weights
from nma.errors import WeightsError
from nma.params import LAYERED3, ParamSpace


@pytest.fixture
def path(tmp_path):
    """The path of a correct weights file."""
    file = tmp_path / "good.safetensors"
    random_adapter().save(file)
    return file


def parts(path):
    """Returns (metadata, tensors) of a weights file."""
    with safe_open(path, framework="numpy") as f:
        return f.metadata(), {name: f.get_tensor(name) for name in f.keys()}  # noqa: SIM118


def refusal(path):
    """Returns the error message with which `Adapter.load` refuses a file.

    Asserts that the message is one line and names the file.
    """
    with pytest.raises(WeightsError) as caught:
        Adapter.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", ("raw", "layered3", "direction"))
@pytest.mark.parametrize(("variant", "form"), VARIANTS.items())
def test_an_adapter_is_the_same_after_saving_and_loading(tmp_path, name, variant, form):
    before = replace(random_adapter(*form, name=name), bounded=form[1])
    assert before.variant == variant
    before.save(tmp_path / "new" / "a.safetensors")
    after = Adapter.load(tmp_path / "new" / "a.safetensors")
    for field in ("space", "encoding", "instances", "directional", "target", "training", "bounded"):
        assert getattr(after, field) == getattr(before, field)
    for (m, b), (m2, b2) in zip(before.layers, after.layers, strict=True):
        np.testing.assert_array_equal(m, m2)
        np.testing.assert_array_equal(b, b2)
    mu = np.array([0.1, 0.9])
    np.testing.assert_array_equal(after.numbers(materials(3), mu), before.numbers(materials(3), mu))
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.safetensors"]


def test_stretched_targets_must_depend_on_the_direction(tmp_path):
    """A weights file is refused if its target has stretched lobes, but its network does not depend on the direction.

    Lobes are stretched in the plane of incidence, which depends on the direction.
    """
    path = tmp_path / "a.safetensors"
    random_adapter(params=target.STRETCHED_PARAMS).save(path)
    assert Adapter.load(path).in_plane
    random_adapter(directional=False, params=target.STRETCHED_PARAMS).save(path)
    assert "plane of incidence" in refusal(path)


def test_the_file_describes_itself(path):
    """The JSON header holds everything that a reader in another language needs."""
    metadata, tensors = parts(path)
    header = json.loads(metadata["nma"])
    assert header["class_name"] == "layered3"
    assert [p["name"] for p in header["parameters"]] == [p.name for p in LAYERED3.params]
    assert header["parameters"][0] == {
        "name": "alpha_top",
        "symbol": "alpha_1",
        "law": "log10",
        "low": 1e-3,
        "high": 10**-0.5,
        "valid_low": 1e-4,
        "valid_high": 1.0,
        "description": LAYERED3["alpha_top"].description,
        "size": 1,
    }
    assert header["parameters"][-1]["valid_high"] == 1e3
    unbounded = ParamSpace("open", (replace(LAYERED3["sigma_t"], valid_high=float("inf")),))
    # JSON has no infinity, so null means that there is no bound.
    assert weights.describe(unbounded)[0]["valid_high"] is None
    assert header["hidden"] == [32, 32, 32]
    assert (header["instances"], header["directional"], header["reciprocal"]) == (2, True, False)
    assert header["dialect"] == "mitsuba-principled-reflection"
    assert sum(p["size"] for p in header["target"]) == 11
    assert header["training"] == {"data": "none", "seed": 0}
    shapes = {name: t.shape for name, t in tensors.items()}
    assert shapes["layer0.bias"] == (32,)
    assert shapes["layer3.weight"] == (23, 32)
    assert {t.dtype for t in tensors.values()} == {np.dtype(np.float32)}
    assert len(tensors) == 8


def test_records_of_training_may_have_numbers_that_are_not_finite(path):
    """JSON has no NaN, so the file has null in place of NaN. The C++ runtime could not read NaN."""
    training = {"losses": [1.0, float("nan")], "rate": float("inf")}
    replace(Adapter.load(path), training=training).save(path)
    assert Adapter.load(path).training == {"losses": [1.0, None], "rate": None}


def test_constant_variants_are_reciprocal(tmp_path):
    for instances, directional in VARIANTS.values():
        random_adapter(instances, directional).save(tmp_path / "a.safetensors")
        assert json.loads(parts(tmp_path / "a.safetensors")[0]["nma"])["reciprocal"] == (not directional)


def test_a_missing_file_is_refused(tmp_path):
    assert "no such weights file; `nma train`" in refusal(tmp_path / "none.safetensors")
    with pytest.raises(WeightsError, match="'gold' is neither a file nor a shipped adapter"):
        Adapter.load("gold")
    refusal(tmp_path)


@pytest.mark.parametrize("length", (0, 4, 8, 100, 2000, -1))
def test_a_truncated_file_is_refused(path, length):
    path.write_bytes(path.read_bytes()[:length])
    assert "truncated" in refusal(path)


def test_another_kind_of_file_is_refused(path, tmp_path):
    path.write_bytes(b"PK\x03\x04" + bytes(1000))
    refusal(path)
    path.write_text("alpha_top = 0.2\n" * 50)
    refusal(path)
    path.write_bytes(save({"layer0.weight": np.zeros((2, 2), np.float32)}))
    assert "without NMA metadata" in refusal(path)
    path.write_bytes(save({"layer0.weight": np.zeros((2, 2), np.float32)}, metadata={"format": "pt"}))
    assert "without NMA metadata" in refusal(path)


def _with(header, **changes):
    return {k: v for k, v in (header | changes).items() if v != "absent"}


def _parameters(header, number, **changes):
    rows = [dict(p) for p in header["parameters"]]
    rows[number] |= changes
    return {**header, "parameters": rows}


def _target(header, **changes):
    """Returns the header with changes to the declaration of `roughness`."""
    rows = [dict(p) for p in header["target"]]
    rows[1] |= changes
    return {**header, "target": rows}


def _nested(depth):
    value = []
    for _ in range(depth - 1):
        value = [value]
    return value


HEADERS = {
    "another format": (lambda h: _with(h, format=2), "format 2, but this version reads format 1; upgrade"),
    "another class": (
        lambda h: _with(h, class_name="velvet"),
        "class 'velvet' is unknown; this version has layered3",
    ),
    "other parameters": (lambda h: _parameters(h, 1, name="gloss"), "differs .* parameter 1, alpha_bottom"),
    "another range": (lambda h: _parameters(h, 6, high=2.0), "differs .* parameter 6, sigma_t"),
    "another law": (lambda h: _parameters(h, 0, law="uniform"), "differs .* parameter 0, alpha_top"),
    "fewer parameters": (lambda h: _with(h, parameters=h["parameters"][:-1]), "parameter 6, sigma_t"),
    "more parameters": (lambda h: _with(h, parameters=[*h["parameters"], {}]), "more parameters"),
    "no parameters": (lambda h: _with(h, parameters=[None] * 7), "parameter 0, alpha_top"),
    "another encoding": (lambda h: _with(h, encoding="fourier"), "unknown input encoding 'fourier'"),
    "another dialect": (lambda h: _with(h, dialect="openpbr"), "dialect 'openpbr', but this version has"),
    "another direction": (
        lambda h: _with(h, directional=False, reciprocal=True),
        r"maps \d+ inputs to 23 .*says",
    ),
    "other instances": (lambda h: _with(h, instances=3), "23 outputs, but the metadata says .* to 35"),
    "no instances": (lambda h: _with(h, instances=0), "blend has 0 instances"),
    "other hidden layers": (lambda h: _with(h, hidden=[32, 32, 64]), r"not have the widths \[32, 32, 64\]"),
    "more hidden layers": (lambda h: _with(h, hidden=[32] * 4), "'layer4.weight' is missing"),
    "hidden no list": (lambda h: _with(h, hidden=None), "'hidden' has the wrong type, None"),
    "instances no number": (lambda h: _with(h, instances="two"), "'instances' has the wrong type, 'two'"),
    "a later format": (
        lambda h: _with(h, format=2, colour=1),
        "format 2, but this version reads format 1; upgrade",
    ),
    "a field more": (lambda h: _with(h, colour=1), "metadata comes from another version.*colour"),
    "a field less": (lambda h: _with(h, dialect="absent"), "metadata comes from another version.*dialect"),
    "other target": (
        lambda h: _with(h, target=[{**h["target"][0], "name": "glow"}, *h["target"][1:]]),
        "glow",
    ),
    "target of words": (lambda h: _with(h, target=[{**h["target"][1], "low": "little"}]), ""),
    "target of integers too long": (lambda h: _target(h, high=10**400), "no valid range within"),
    "target beyond all bounds": (lambda h: _target(h, high=1e300), r"no valid range within 0 \.\. 1"),
    "target infinite": (lambda h: _target(h, high=float("inf")), "the number 'Infinity' is not finite"),
    "target not a number": (lambda h: _target(h, low=float("nan")), "the number 'NaN' is not finite"),
    "target negative": (lambda h: _target(h, low=-1.0), "no valid range"),
    "target of truths": (lambda h: _target(h, low=False), "ends are not numbers"),
    "target of broken size": (lambda h: _target(h, size=1.0), "a wrong name or size"),
    "target in a plane of words": (
        lambda h: _target(h, in_plane="no"),
        "cannot be `in_plane`",
    ),
    "target twice": (lambda h: _with(h, target=[*h["target"][:3], *h["target"][1:]]), "no name twice"),
    "target without a colour": (lambda h: _with(h, target=h["target"][1:]), "must have a base_color"),
    "nested without end": (lambda h: _with(h, training={"a": _nested(900)}), "nest 902 deep, but at most 32"),
    "target no table": (lambda h: _with(h, target=["roughness"]), "malformed"),
    "a list": (lambda h: [h], "metadata comes from another version"),
}


@pytest.mark.parametrize("change", HEADERS)
def test_metadata_that_does_not_fit_is_refused(path, change):
    edit, message = HEADERS[change]
    metadata, tensors = parts(path)
    path.write_bytes(save(tensors, metadata={"nma": json.dumps(edit(json.loads(metadata["nma"])))}))
    assert re.search(message, refusal(path))


def test_metadata_that_is_no_json_is_refused(path):
    _, tensors = parts(path)
    path.write_bytes(save(tensors, metadata={"nma": "{"}))
    assert "metadata comes from another version" in refusal(path)


TENSORS = {
    "missing weight": (lambda t: t.pop("layer2.weight"), "'layer2.weight' is missing"),
    "missing bias": (lambda t: t.pop("layer0.bias"), "'layer0.bias' is missing"),
    "all missing": (lambda t: t.clear(), "'layer0.weight' is missing"),
    "transposed": (
        lambda t: t.update({"layer3.weight": t["layer3.weight"].T.copy()}),
        "layer 3 has weights of shape",
    ),
    "short bias": (
        lambda t: t.update({"layer1.bias": t["layer1.bias"][:-1].copy()}),
        "layer 1 has weights of shape",
    ),
    "flat": (
        lambda t: t.update({"layer0.weight": t["layer0.weight"].ravel()}),
        "layer 0 has weights of shape",
    ),
    "a number": (
        lambda t: t.update({"layer0.weight": np.ones((), np.float32)}),
        "layer 0 has weights of shape",
    ),
    "NaN": (lambda t: t["layer2.weight"].__setitem__((3, 5), np.nan), "layer 2 holds numbers that are not"),
    "infinity": (lambda t: t["layer0.bias"].__setitem__(0, np.inf), "layer 0 holds numbers that are not"),
    "narrow": (
        lambda t: t.update({"layer0.weight": t["layer0.weight"][:, 1:].copy()}),
        "maps .* inputs to 23",
    ),
}


@pytest.mark.parametrize("change", TENSORS)
def test_tensors_that_do_not_fit_are_refused(path, change):
    edit, message = TENSORS[change]
    metadata, tensors = parts(path)
    edit(tensors)
    path.write_bytes(save(tensors, metadata=metadata))
    assert re.search(message, refusal(path))


@pytest.mark.parametrize("depth", (40, 2000, 100_000))
@pytest.mark.parametrize("brackets", ("[]", "{}"))
def test_metadata_nested_without_end_is_refused(path, depth, brackets):
    """Deeply nested JSON, complete or cut off, is refused before a recursive parser reads it."""
    opening = brackets[0] if brackets == "[]" else '{"a":'
    _, tensors = parts(path)
    for text in (opening * depth, opening * depth + "0" + brackets[1] * depth):
        path.write_bytes(save(tensors, metadata={"nma": text}))
        assert f"nest {depth} deep" in refusal(path)


def test_brackets_in_strings_do_not_count_as_nesting(path, tmp_path):
    adapter = Adapter.load(path)
    replace(adapter, training={"data": '[{"\\' * 100}).save(tmp_path / "words.safetensors")
    assert Adapter.load(tmp_path / "words.safetensors").training["data"].count("[") == 100


@pytest.mark.parametrize("kind", (np.int32, np.int64, np.uint8, np.float16, np.float64))
def test_weights_of_another_number_type_are_refused(path, kind):
    metadata, tensors = parts(path)
    for name in ("layer0.weight", "layer2.bias"):
        path.write_bytes(save(tensors | {name: tensors[name].astype(kind)}, metadata=metadata))
        assert f"tensor '{name}' holds numbers of type {np.dtype(kind).kind.upper()}" in refusal(path)
    path.write_bytes(save(tensors | {"codes": np.zeros((2, 32), kind)}, metadata=metadata))
    assert "tensor 'codes'" in refusal(path)


def test_every_shipped_adapter_loads_and_works():
    for name in adapters.shipped():
        adapter = Adapter.load(name)
        assert adapter.training, name
        assert np.isfinite(adapter.numbers(materials(20), np.linspace(0.0, 1.0, 9))).all()


def test_loading_an_adapter_needs_neither_mitsuba_nor_jax(path):
    code = (
        "import sys, numpy as np; from nma.adapter import Adapter; "
        "Adapter.load(sys.argv[1]).numbers(np.full((1, 13), 0.5), np.ones(1)); "
        "print({'mitsuba', 'drjit', 'jax', 'zarr'} & set(sys.modules))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=60
    )
    assert result.stdout == "set()\n", result.stderr
