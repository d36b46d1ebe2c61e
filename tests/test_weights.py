"""Networks, encodings, weights files and adapters: what is written comes back, what is wrong is said in one line."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save

from nma import adapter as adapters
from nma import encoding, network, target
from nma.adapter import Adapter
from nma.errors import NmaError, WeightsError
from nma.jit import dr
from nma.params import LAYERED3
from nma.target import PRINCIPLED_PARAMS

VARIANTS = {"single": (1, False), "blended": (2, False), "omega_i": (1, True), "blended + omega_i": (2, True)}


def random_adapter(
    instances=2, directional=True, name="layered3", hidden="3x32", seed=0, params=PRINCIPLED_PARAMS
):
    """An adapter that was not trained, with outputs that vary over the class."""
    rng = np.random.default_rng(seed)
    sizes = [
        encoding.size(name, LAYERED3, directional),
        *network.hidden(hidden),
        target.output_size(instances, params),
    ]
    layers = [(m, 0.3 * rng.standard_normal(b.shape).astype(np.float32)) for m, b in network.init(rng, sizes)]
    layers[-1] = (10.0 * layers[-1][0], layers[-1][1])
    record = {"data": "none", "seed": seed}
    return Adapter(LAYERED3, name, layers, instances, directional, params, record)


def materials(n, seed=1):
    return LAYERED3.sample(np.random.default_rng(seed), n)


@pytest.fixture
def path(tmp_path):
    """A good weights file."""
    file = tmp_path / "good.safetensors"
    random_adapter().save(file)
    return file


def parts(path):
    """(metadata, tensors) of a weights file."""
    with safe_open(path, framework="numpy") as f:
        return f.metadata(), {name: f.get_tensor(name) for name in f.keys()}  # noqa: SIM118


def refusal(path):
    """The message with which a file is refused: one line, which names the file."""
    with pytest.raises(WeightsError) as caught:
        Adapter.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", ("raw", "layered3", "direction"))
@pytest.mark.parametrize(("variant", "form"), VARIANTS.items())
def test_an_adapter_comes_back_from_its_file(tmp_path, name, variant, form):
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


def test_stretched_targets_follow_the_direction(tmp_path):
    """A plane of incidence needs one; files that say otherwise are refused."""
    path = tmp_path / "a.safetensors"
    random_adapter(params=target.STRETCHED_PARAMS).save(path)
    assert Adapter.load(path).in_plane
    random_adapter(directional=False, params=target.STRETCHED_PARAMS).save(path)
    assert "plane of incidence" in refusal(path)


def test_the_file_describes_itself(path):
    """Everything that another language needs stands in the JSON of the header."""
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
    assert header["parameters"][-1]["valid_high"] is None
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


HEADERS = {
    "another format": (lambda h: _with(h, format=2), "format 2, this version reads 1; upgrade"),
    "another class": (
        lambda h: _with(h, class_name="velvet"),
        "class 'velvet'; this version knows layered3",
    ),
    "other parameters": (lambda h: _parameters(h, 1, name="gloss"), "differs .* parameter 1, alpha_bottom"),
    "another range": (lambda h: _parameters(h, 6, high=2.0), "differs .* parameter 6, sigma_t"),
    "another law": (lambda h: _parameters(h, 0, law="uniform"), "differs .* parameter 0, alpha_top"),
    "fewer parameters": (lambda h: _with(h, parameters=h["parameters"][:-1]), "parameter 6, sigma_t"),
    "more parameters": (lambda h: _with(h, parameters=[*h["parameters"], {}]), "more parameters"),
    "no parameters": (lambda h: _with(h, parameters=[None] * 7), "parameter 0, alpha_top"),
    "another encoding": (lambda h: _with(h, encoding="fourier"), "unknown input encoding 'fourier'"),
    "another dialect": (lambda h: _with(h, dialect="openpbr"), "dialect 'openpbr', this version evaluates"),
    "another direction": (
        lambda h: _with(h, directional=False, reciprocal=True),
        r"maps \d+ inputs to 23 .*says",
    ),
    "other instances": (lambda h: _with(h, instances=3), "23 outputs, its description says .* to 35"),
    "no instances": (lambda h: _with(h, instances=0), "blend of 0 instances"),
    "other hidden layers": (lambda h: _with(h, hidden=[32, 32, 64]), r"not the \[32, 32, 64\]"),
    "more hidden layers": (lambda h: _with(h, hidden=[32] * 4), "'layer4.weight' is missing"),
    "hidden no list": (lambda h: _with(h, hidden=None), "None as 'hidden'"),
    "instances no number": (lambda h: _with(h, instances="two"), "'two' as 'instances'"),
    "a field more": (lambda h: _with(h, colour=1), "metadata of another version.*colour"),
    "a field less": (lambda h: _with(h, dialect="absent"), "metadata of another version.*dialect"),
    "other target": (
        lambda h: _with(h, target=[{**h["target"][0], "name": "glow"}, *h["target"][1:]]),
        "glow",
    ),
    "target of words": (lambda h: _with(h, target=[{**h["target"][1], "low": "little"}]), ""),
    "target no table": (lambda h: _with(h, target=["roughness"]), "malformed"),
    "a list": (lambda h: [h], "metadata of another version"),
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
    assert "metadata of another version" in refusal(path)


TENSORS = {
    "missing weight": (lambda t: t.pop("layer2.weight"), "'layer2.weight' is missing"),
    "missing bias": (lambda t: t.pop("layer0.bias"), "'layer0.bias' is missing"),
    "all missing": (lambda t: t.clear(), "'layer0.weight' is missing"),
    "transposed": (lambda t: t.update({"layer3.weight": t["layer3.weight"].T.copy()}), "layer 3 has shapes"),
    "short bias": (lambda t: t.update({"layer1.bias": t["layer1.bias"][:-1].copy()}), "layer 1 has shapes"),
    "flat": (lambda t: t.update({"layer0.weight": t["layer0.weight"].ravel()}), "layer 0 has shapes"),
    "a number": (lambda t: t.update({"layer0.weight": np.ones((), np.float32)}), "layer 0 has shapes"),
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


def test_other_precisions_are_read_as_single(path):
    metadata, tensors = parts(path)
    path.write_bytes(save({k: v.astype(np.float64) for k, v in tensors.items()}, metadata=metadata))
    assert Adapter.load(path).layers[0][0].dtype == np.float32


def test_the_paper_s_network_has_7159_parameters():
    """A library of 100 learnt embeddings of 32 numbers; 33 inputs (with cos theta_i) to 3x32 to 23 outputs."""
    assert target.output_size(2) == 23
    layers = network.init(np.random.default_rng(0), [33, *network.hidden("3x32"), target.output_size(2)])
    assert network.parameters(layers) + 100 * 32 == 7159


def test_networks_are_named_by_depth_and_width():
    assert network.hidden("5x64") == [64] * 5
    for name in ("64", "x64", "5x", "0x64", "5x0", "5x-3", "axb", ""):
        with pytest.raises(NmaError, match="DEPTHxWIDTH"):
            network.hidden(name)


def test_a_network_is_its_matrices():
    """Against the sum written out: ReLU between the layers, none after the last."""
    rng = np.random.default_rng(3)
    layers = [
        (rng.standard_normal((4, 3)), rng.standard_normal(4)),
        (rng.standard_normal((2, 4)), -np.ones(2)),
    ]
    x = rng.standard_normal((5, 3))
    (w0, b0), (w1, b1) = layers
    expected = np.array([w1 @ np.maximum(w0 @ row + b0, 0.0) + b1 for row in x])
    np.testing.assert_allclose(network.forward(layers, x), expected)
    assert (expected < 0).any()
    inputs = [dr.auto.Float(c.astype(np.float32)) for c in x.T]
    for active in (True, dr.arange(dr.auto.UInt32, 5) < 3):
        lanes = network.forward_lanes(layers, inputs, active)
        dr.eval(lanes)
        found = np.stack([lane.numpy() for lane in lanes], axis=-1)
        known = slice(None) if active is True else slice(3)
        np.testing.assert_allclose(found[known], expected[known], rtol=1e-5, atol=1e-5)
    nowhere = network.forward_lanes(layers, inputs, dr.auto.Bool(False) & (inputs[0] > 0.0))
    assert not any(lane.numpy().any() for lane in nowhere)


def test_initial_layers_have_the_spread_of_their_law():
    """He 2015: outputs as large as inputs; the output's bias as asked for; the same seed, the same layers."""
    layers = network.init(np.random.default_rng(0), [200, 300, 100], np.arange(100))
    assert layers[0][0].std() == pytest.approx(np.sqrt(2.0 / 200), rel=0.02)
    assert layers[1][0].std() == pytest.approx(0.1 * np.sqrt(2.0 / 300), rel=0.02)
    np.testing.assert_array_equal(layers[1][1], np.arange(100))
    again = network.init(np.random.default_rng(0), [200, 300, 100], np.arange(100))
    np.testing.assert_array_equal(again[0][0], layers[0][0])
    deep = network.init(np.random.default_rng(1), [14, 64, 64, 64, 64, 64, 23])
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (100, 14))
    spread = network.forward(deep, x).std()
    assert 0.01 < spread < 1.0


@pytest.mark.parametrize("name", ("raw", "layered3"))
def test_encodings_are_about_unit_sized_and_finite(name):
    columns = list(materials(2000).T)
    for mu in (0.0, 1e-6, 0.3, 1.0):
        inputs = encoding.get(name)(columns, np.full(2000, mu))
        stacked = np.stack(np.broadcast_arrays(*inputs), axis=-1)
        assert np.isfinite(stacked).all()
        assert stacked.shape[1] == encoding.size(name, LAYERED3, True)
        if name == "layered3":
            assert np.abs(stacked).max() <= 1.0 + 1e-6
    assert encoding.size("raw", LAYERED3, True) == 14
    assert encoding.size("raw", LAYERED3, False) == 13


def test_the_raw_encoding_is_the_paper_s_input():
    columns = [float(k) for k in range(13)]
    assert encoding.raw(columns, 0.25) == [*columns, 0.25]
    assert encoding.raw(columns, None) == columns


def test_encodings_agree_on_all_libraries():
    """The same numbers from plain floats, NumPy and Dr.Jit."""
    params, mu = materials(50), np.linspace(0.0, 1.0, 50)
    on_numpy = np.stack(np.broadcast_arrays(*encoding.layered3(list(params.T), mu)), axis=-1)
    columns = [dr.auto.Float(c.astype(np.float32)) for c in params.T]
    on_drjit = encoding.layered3(columns, dr.auto.Float(mu.astype(np.float32)))
    dr.eval(on_drjit)
    np.testing.assert_allclose(np.stack([x.numpy() for x in on_drjit], axis=-1), on_numpy, atol=2e-5)
    plain = encoding.layered3(params[7].tolist(), float(mu[7]))
    assert all(type(x) is float for x in plain)
    np.testing.assert_allclose(plain, on_numpy[7], rtol=1e-12)


def test_an_unknown_encoding_is_refused():
    with pytest.raises(WeightsError, match="unknown input encoding 'fourier'; this version knows raw"):
        encoding.get("fourier")


def flat(blend):
    """The numbers of a blend as an array (lanes, size)."""
    numbers = target.numbers(blend)
    dr.eval(numbers)
    lanes = [np.asarray(x.numpy() if dr.is_array_v(x) else x, np.float64) for x in numbers]
    return np.stack(np.broadcast_arrays(*lanes), axis=-1)


@pytest.mark.parametrize("name", ("raw", "layered3", "direction"))
@pytest.mark.parametrize("form", VARIANTS.values(), ids=VARIANTS)
def test_prepare_agrees_on_numpy_and_dr_jit(form, name):
    adapter = random_adapter(*form, name=name, hidden="2x8")
    params, mu = materials(64), np.random.default_rng(5).random(64)
    on_numpy = flat(adapter.prepare(list(params.T), mu))
    columns = [dr.auto.Float(c.astype(np.float32)) for c in params.T]
    on_drjit = flat(adapter.prepare(columns, dr.auto.Float(mu.astype(np.float32))))
    assert np.isfinite(on_numpy).all()
    shape = (64, adapter.size)
    np.testing.assert_allclose(np.broadcast_to(on_drjit, shape), np.broadcast_to(on_numpy, shape), atol=2e-5)


@pytest.mark.parametrize("name", ("raw", "layered3", "direction"))
@pytest.mark.parametrize("form", VARIANTS.values(), ids=VARIANTS)
def test_only_directional_adapters_depend_on_the_direction(form, name):
    adapter = random_adapter(*form, name=name)
    curves = adapter.numbers(materials(4), np.linspace(0.0, 1.0, 7))
    assert curves.shape == (4, 7, adapter.size)
    assert curves.dtype == np.float32
    varies = np.ptp(curves, axis=1).max() > 1e-3
    assert varies == adapter.directional
    if not adapter.directional:
        # Rounding alone: a product of matrices may sum the last rows in another order than the first.
        assert np.ptp(curves, axis=1).max() < 1e-6
    assert (np.ptp(curves, axis=0).max() > 1e-3) == (name != "direction")


def test_curves_are_the_prepared_numbers():
    """`numbers` for each material and cosine is what `prepare` says there."""
    adapter, params, mu = random_adapter(), materials(3), np.array([0.0, 0.4, 1.0])
    curves = adapter.numbers(params, mu)
    for m in range(3):
        for k in range(3):
            single = flat(adapter.prepare([np.array([c]) for c in params[m]], mu[k : k + 1]))
            np.testing.assert_allclose(curves[m, k], single[0], atol=1e-6)


def test_decoded_numbers_lie_in_their_ranges():
    """However wild the network."""
    wild = random_adapter()
    wild = replace(wild, layers=[(100.0 * m, 100.0 * b) for m, b in wild.layers])
    curves = wild.numbers(materials(50), np.linspace(0.0, 1.0, 5))
    ranges = [p for p in PRINCIPLED_PARAMS for _ in range(p.size)] * 2
    assert np.isfinite(curves).all()
    for k, p in enumerate(ranges):
        assert curves[..., k].min() >= p.low * (1 - 1e-5)
        assert curves[..., k].max() <= p.high * (1 + 1e-5)
    assert curves[..., -1].min() >= 0.0
    assert curves[..., -1].max() <= 1.0


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
