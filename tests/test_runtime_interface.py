"""The C++ runtime runs networks whose last layer reads the inputs, and knows the interface of a single material."""

import ctypes
from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import materials, random_adapter, random_interface_adapter
from runtime_cases import facing, in_single_precision, pointer, rows
from target_cases import random_directions

from nma import network
from nma.adapter import encoding
from nma.errors import WeightsError
from nma.native.runtime import Runtime, available
from nma.ops import Vec3, at_azimuth_0
from nma.params import LAYERED3, MEASURED
from nma.target import ANISOTROPIC_PARAMS, INTERFACE_PARAMS

CASES = 500

pytestmark = pytest.mark.usefixtures("compiler")


def skipping(name):
    """Returns an adapter whose last layer reads the inputs: 16 of them, or with other encodings 14, 5 or 1."""
    if "x" in name:
        return random_interface_adapter(name)
    if name == "raw":
        return random_adapter(name=name, hidden="2x32", skip=True)
    return random_adapter(name=name, hidden="2x24", params=ANISOTROPIC_PARAMS, space=MEASURED, skip=True)


@pytest.mark.parametrize("name", ["1x8", "2x20", "3x32", "2x100", "raw", "azimuth", "direction"])
def test_a_last_layer_reads_the_inputs_on_every_instruction_set(tmp_path, name):
    """The outputs are those of the package, for single queries and in batches."""
    adapter = skipping(name)
    adapter.save(tmp_path / "skip.safetensors")
    params = materials(CASES).astype(np.float32)[:, : adapter.space.size]
    wi = rows(random_directions(np.random.default_rng(1), CASES)).astype(np.float32)
    view = Vec3(*wi.astype(np.float64).T)
    inputs = encoding.get(adapter.encoding)(list(params.T.astype(np.float64)), view)
    wanted = network.forward(adapter.layers, np.stack(inputs, axis=-1))
    blind = [*adapter.layers[:-1], (adapter.layers[-1][0].copy(), adapter.layers[-1][1])]
    blind[-1][0][:, -len(inputs) :] = 0.0
    assert np.abs(network.forward(blind, np.stack(inputs, axis=-1)) - wanted).mean() > 0.1
    for instruction_set in available():
        for compact in (False, True):
            runtime = Runtime(tmp_path / "skip.safetensors", instruction_set, compact=compact)
            many = runtime.outputs(params, wi)
            single = np.concatenate([runtime.outputs(params[k : k + 1], wi[k : k + 1]) for k in range(50)])
            error = np.abs(many - wanted) / (1.0 + np.abs(wanted))
            rounds = compact or instruction_set == "avx512_bf16"
            assert np.quantile(error, 0.99) < (0.05 if rounds else 1e-5), (instruction_set, compact)
            np.testing.assert_allclose(single, many[:50], atol=0.05 if rounds else 1e-4)


def test_a_last_layer_is_refused_if_its_neurons_and_inputs_are_too_many(tmp_path):
    """At most 512 numbers are the inputs of a layer. The neurons and the inputs are padded to multiples of 16."""
    for width, fits in ((496, True), (497, False)):
        random_interface_adapter(f"1x{width}").save(tmp_path / "wide.safetensors")
        if fits:
            Runtime(tmp_path / "wide.safetensors")
        else:
            with pytest.raises(WeightsError, match="the network is too wide: this version runs at most 512"):
                Runtime(tmp_path / "wide.safetensors")


def test_a_single_material_lies_under_its_own_interface(tmp_path):
    """`prepare` reads no parameters of a single material, not even those of the interface."""
    known = materials(1)[0]
    adapter = random_adapter(
        name="direction", hidden="1x8", params=INTERFACE_PARAMS, interface=LAYERED3.interface, bounded=True
    )
    adapter = replace(adapter, training={"params": known.tolist()})
    adapter.save(tmp_path / "single.safetensors")
    rng = np.random.default_rng(2)
    wi = facing(0.02 + 0.98 * rng.random(CASES)).astype(np.float32)
    wo = rows(random_directions(rng, CASES)).astype(np.float32)
    view, light = (Vec3(*v.T.astype(np.float64)) for v in (wi, wo))
    value, pdf = adapter.prepare([], view).eval_pdf(view, light)
    other = adapter.prepare(list(materials(1, seed=7)[0]), view).eval_pdf(view, light)[0]
    assert np.abs(other.x - value.x).mean() > 0.01
    nothing = np.full(LAYERED3.size, np.nan, np.float32)
    for instruction_set in in_single_precision():
        runtime = Runtime(tmp_path / "single.safetensors", instruction_set)
        many = runtime.prepare(np.tile(known, (CASES, 1)), wi)
        each = np.zeros_like(many)
        for brdf, cosine in zip(each, wi[:, 2], strict=True):
            runtime._c.nma_prepare(runtime._handle, pointer(nothing), ctypes.c_float(cosine), pointer(brdf))
        for brdfs in (many, each):
            found = np.column_stack(runtime.eval_pdf(brdfs, wi, wo))
            np.testing.assert_allclose(found, np.stack([*value, pdf], axis=-1), rtol=2e-3, atol=1e-5)


def test_the_estimates_are_clipped(tmp_path):
    """Under dark and bright, smooth and rough coats, the inputs of C++ are those of the package."""
    params = materials(4).astype(np.float32)
    named = {name: columns.start for name, columns in LAYERED3.slices.items()}
    params[0, named["eta_conductor"] : named["albedo"]] = (*(1.0, 1.0, 1.0), *(0.0, 0.0, 0.0))
    params[1, named["eta_conductor"] : named["albedo"]] = (*(0.03, 0.03, 0.03), *(9.5, 9.5, 9.5))
    params[2, :2] = (1e-3, 1e-3)
    params[3, :2] = (10**-0.5, 1.0)
    params[:, named["sigma_t"]] = (1.0, 0.0, 0.5, 0.5)
    inputs = encoding.size("layered3_bounce", LAYERED3, True)
    adapter = random_interface_adapter("1x16")
    identity = [(np.eye(16, dtype=np.float32), np.zeros(16, np.float32))]
    matrix, bias = adapter.layers[-1]
    matrix = np.zeros_like(matrix)
    matrix[:inputs, 16 : 16 + inputs] = np.eye(inputs)
    replace(adapter, layers=[*identity, (matrix, 0.0 * bias)]).save(tmp_path / "inputs.safetensors")
    cosines = np.array([0.9, 0.9, 0.5, 0.5])
    wanted = encoding.get("layered3_bounce")(list(params.T.astype(np.float64)), at_azimuth_0(cosines))
    wanted = np.stack(wanted, axis=-1)
    limit = abs(np.log(0.01 / 0.99) / 2.5)
    assert np.isclose(np.abs(wanted[:, -4:]), limit).any(axis=1).tolist() == [True, True, True, True]
    for instruction_set in in_single_precision():
        found = Runtime(tmp_path / "inputs.safetensors", instruction_set).outputs(params, cosines)
        np.testing.assert_allclose(found[:, :inputs], wanted, atol=1e-5)
