"""Networks, encodings and adapters give equal results in all array packages, and decoded parameters stay in range."""

from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import VARIANTS, materials, random_adapter

from nma import network, target
from nma.adapter import encoding
from nma.errors import NmaError, WeightsError
from nma.jit import dr
from nma.ops import at_azimuth_0
from nma.params import LAYERED3
from nma.target import PRINCIPLED_PARAMS


def test_the_paper_s_network_has_7159_parameters():
    """The paper's network has 33 inputs, three hidden layers of 32 neurons, and 23 outputs.

    The inputs are cos(theta_i) and an embedding of 32 numbers. The 7159 parameters include 100 such embeddings.
    """
    assert target.output_size(2) == 23
    layers = network.init(np.random.default_rng(0), [33, *network.hidden("3x32"), target.output_size(2)])
    assert network.parameters(layers) + 100 * 32 == 7159


def test_networks_are_named_by_depth_and_width():
    assert network.hidden("5x64") == [64] * 5
    for name in ("64", "x64", "5x", "0x64", "5x0", "5x-3", "axb", ""):
        with pytest.raises(NmaError, match="DEPTHxWIDTH"):
            network.hidden(name)


@pytest.mark.parametrize("blocks", (False, True))
def test_a_network_is_its_matrices(blocks, monkeypatch):
    """The outputs of a network equal matrix products with ReLU between the layers.

    The code for AVX-512 computes a layer in blocks of neurons, and one layer in this test is larger than a block.
    """
    monkeypatch.setattr(network, "_many_registers", lambda value: blocks)
    rng = np.random.default_rng(3)
    layers = [
        (rng.standard_normal((30, 3)), rng.standard_normal(30)),
        (rng.standard_normal((2, 30)), -np.ones(2)),
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
    """Initial weights have the standard deviation of He et al. 2015.

    With this standard deviation, the outputs of a layer are about as large as its inputs. The weights of the last layer
    have a tenth of this standard deviation. The bias of the last layer is the given array, and equal seeds give equal
    layers.
    """
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
        inputs = encoding.get(name)(columns, at_azimuth_0(np.full(2000, mu)))
        stacked = np.stack(np.broadcast_arrays(*inputs), axis=-1)
        assert np.isfinite(stacked).all()
        assert stacked.shape[1] == encoding.size(name, LAYERED3, True)
        if name == "layered3":
            assert np.abs(stacked).max() <= 1.0 + 1e-6
    assert encoding.size("raw", LAYERED3, True) == 14
    assert encoding.size("raw", LAYERED3, False) == 13


def test_the_raw_encoding_is_the_paper_s_input():
    columns = [float(k) for k in range(13)]
    assert encoding.raw(columns, at_azimuth_0(0.25)) == [*columns, 0.25]
    assert encoding.raw(columns, None) == columns


def test_encodings_agree_on_all_array_packages():
    """The encoding of materials is the same for plain floats, NumPy and Dr.Jit."""
    params, mu = materials(50), np.linspace(0.0, 1.0, 50)
    on_numpy = np.stack(np.broadcast_arrays(*encoding.layered3(list(params.T), at_azimuth_0(mu))), axis=-1)
    columns = [dr.auto.Float(c.astype(np.float32)) for c in params.T]
    on_drjit = encoding.layered3(columns, at_azimuth_0(dr.auto.Float(mu.astype(np.float32))))
    dr.eval(on_drjit)
    np.testing.assert_allclose(np.stack([x.numpy() for x in on_drjit], axis=-1), on_numpy, atol=2e-5)
    plain = encoding.layered3(params[7].tolist(), at_azimuth_0(float(mu[7])))
    assert all(type(x) is float for x in plain)
    np.testing.assert_allclose(plain, on_numpy[7], rtol=1e-12)


def test_an_unknown_encoding_is_refused():
    with pytest.raises(WeightsError, match="unknown input encoding 'fourier'; this version has raw"):
        encoding.get("fourier")


def flat(brdf):
    """Returns the parameters and weights of the BRDF's blend as an array (lanes, size)."""
    numbers = target.numbers(brdf.blend)
    dr.eval(numbers)
    lanes = [np.asarray(x.numpy() if dr.is_array_v(x) else x, np.float64) for x in numbers]
    return np.stack(np.broadcast_arrays(*lanes), axis=-1)


@pytest.mark.parametrize("name", ("raw", "layered3", "direction"))
@pytest.mark.parametrize("form", VARIANTS.values(), ids=VARIANTS)
def test_prepare_agrees_on_numpy_and_dr_jit(form, name):
    adapter = random_adapter(*form, name=name, hidden="2x8")
    params, mu = materials(64), np.random.default_rng(5).random(64)
    on_numpy = flat(adapter.prepare(list(params.T), at_azimuth_0(mu)))
    columns = [dr.auto.Float(c.astype(np.float32)) for c in params.T]
    on_drjit = flat(adapter.prepare(columns, at_azimuth_0(dr.auto.Float(mu.astype(np.float32)))))
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
        # Only rounding may differ: a matrix product may add the terms of different rows in different orders.
        assert np.ptp(curves, axis=1).max() < 1e-6
    assert (np.ptp(curves, axis=0).max() > 1e-3) == (name != "direction")


def test_curves_are_the_prepared_numbers():
    """For each material and cosine, `Adapter.numbers` returns the parameters of the blend that `prepare` makes."""
    adapter, params, mu = random_adapter(), materials(3), np.array([0.0, 0.4, 1.0])
    curves = adapter.numbers(params, mu)
    for m in range(3):
        for k in range(3):
            wi = at_azimuth_0(mu[k : k + 1])
            single = flat(adapter.prepare([np.array([c]) for c in params[m]], wi))
            np.testing.assert_allclose(curves[m, k], single[0], atol=1e-6)


def test_decoded_numbers_lie_in_their_ranges():
    """Decoded parameters are within their ranges even if the network's outputs are huge."""
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
