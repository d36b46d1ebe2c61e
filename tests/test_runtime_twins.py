"""Compares code that is written by hand in Python with its twin in C++, which is also written by hand.

CONTRIBUTING.md lists all such twins.
"""

import ctypes
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runtime_cases import PRINCIPLED_SIZE, built, in_single_precision, pointer, rows
from target_cases import horizon_pairs, random_directions

import nma
from nma import Runtime, sources
from nma.adapter import encoding
from nma.adapter.adapter import SAME
from nma.lattice import lattice_steps
from nma.native.runtime import _COMPACT, INSTRUCTION_SETS, available
from nma.ops import Color, Vec3
from nma.params import LAYERED3, LIBRARY, MEASURED
from nma.render import curves
from nma.target import Blend, Principled
from nma.target.decode import TARGETS, decode, encode, needs_interface, output_size

ROOT = Path(__file__).parent.parent
CASES = 4000
# Some encodings do not have the name of a class. CLASS_OF maps each of these encodings to the class whose parameters
# the tests encode.
CLASS_OF = {"direction": MEASURED, "azimuth": MEASURED, "raw": LIBRARY, "layered3_bounce": LAYERED3}
# The encodings that always read the direction.
DIRECTIONAL = (*encoding.ANISOTROPIC, "layered3_bounce")

pytestmark = pytest.mark.usefixtures("compiler")


@pytest.fixture(scope="module")
def bridge(compiler, tmp_path_factory):
    return built(compiler, "runtime_bridge.cpp", tmp_path_factory.mktemp("twins"))


def saved(folder, space, name, instances, directional, params, matrix, bias):
    """Saves an adapter with a single linear layer, and returns the path of its file."""
    layers = [(matrix.astype(np.float32), bias.astype(np.float32))]
    path = folder / "linear.safetensors"
    interface = space.interface if needs_interface(params) else None
    nma.Adapter(space, name, layers, instances, directional, params, interface=interface).save(path)
    return path


def class_for(target, usual):
    """Returns a class with an interface if the target needs one, or the class `usual`."""
    return LAYERED3 if needs_interface(TARGETS[target]) else usual


def class_of(name):
    """Returns the class whose parameters the tests encode with the encoding `name`."""
    if name in CLASS_OF:
        return CLASS_OF[name]
    assert name in sources.classes(), (
        f"encoding '{name}': add the class that tests this encoding to CLASS_OF in tests/test_runtime_twins.py"
    )
    return sources.space(name)


def drawn(space, rng):
    return space.sample(rng, CASES).astype(np.float32) if space.size else np.zeros((CASES, 0), np.float32)


def views(rng):
    """Returns random view directions (n, 3). Some directions are the normal itself, and some are near the horizon."""
    wi = rows(random_directions(rng, CASES)).astype(np.float32)
    wi[:100] = (0.0, 0.0, 1.0)
    wi[100:200, 2] = 1e-4
    return wi / np.linalg.norm(wi, axis=1, keepdims=True).astype(np.float32)


@pytest.mark.parametrize("instances", [1, 2, 3, 4, 5, 8])
@pytest.mark.parametrize("name", TARGETS)
def test_outputs_are_decoded_to_the_same_parameters(bridge, tmp_path, name, instances):
    """C++ decodes the outputs of a network to the same parameters as Python, within 1e-6.

    The test covers every target and several counts of instances. The outputs are random, and some are so large that a
    sigmoid rounds to its limit.
    """
    rng, size = np.random.default_rng(instances), output_size(instances, TARGETS[name])
    space = class_for(name, LIBRARY)
    matrix = rng.normal(size=(size, space.size + 1)) * np.where(np.arange(size)[:, None] % 9 == 4, 20.0, 0.5)
    path = saved(tmp_path, space, "raw", instances, True, TARGETS[name], matrix, rng.normal(size=size))
    params, wi = drawn(space, rng), views(rng)
    above = params[:, list(space.interface_columns)] if space.interface else np.zeros((CASES, 2), np.float32)
    for instruction_set in in_single_precision():
        runtime = Runtime(path, instruction_set)
        raw = runtime.outputs(params, wi).astype(np.float64)
        assert (np.abs(raw) > 20).any() and (np.abs(raw) < 1).any()
        blend = decode(list(raw.T), instances, TARGETS[name], wi[:, 2].astype(np.float64))
        columns = [x for p in blend.instances for x in (*p.base_color, *p[1:])]
        wanted = np.stack([np.broadcast_to(x, CASES) for x in (*columns, *blend.weights)], axis=-1)
        found, interfaces = np.zeros(wanted.shape, np.float32), np.zeros((CASES, 2), np.float32)
        brdfs = runtime.prepare(params, wi)
        bridge.brdf_interfaces(CASES, pointer(brdfs), pointer(interfaces))
        np.testing.assert_array_equal(interfaces, above)
        bridge.brdf_numbers(CASES, instances, pointer(brdfs), pointer(found))
        # The error is relative to the largest number in the computation, which is the width of the range.
        error = np.abs(found - wanted) / (np.abs(wanted) + np.maximum(np.ptp(wanted, axis=0), 1.0))
        assert error.max() < 1e-6, instruction_set


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("name", TARGETS)
def test_at_the_horizon_and_below_all_is_zero(tmp_path, name, bounded):
    """In C++, values and densities are 0 at and below the horizon.

    tests/test_brdf.py tests the same rule in Python.
    """
    kind, rng = "azimuth" if name == "anisotropic" else "direction", np.random.default_rng(3)
    space = class_for(name, MEASURED)
    size, inputs = output_size(2, TARGETS[name]), encoding.size(kind, space, True)
    path = saved(
        tmp_path,
        space,
        kind,
        2,
        True,
        TARGETS[name],
        rng.normal(size=(size, inputs)),
        rng.normal(size=size),
    )
    replace(nma.Adapter.load(path), bounded=bounded).save(path)
    wi, wo = (w.astype(np.float32) for w in horizon_pairs())
    hidden, u = wi[:, 2] <= 0, rng.random((len(wi), 3))
    for instruction_set in in_single_precision():
        runtime = Runtime(path, instruction_set)
        brdfs = runtime.prepare(np.tile(space.sample(rng, 1), (len(wi), 1)), wi)
        assert not np.any(np.column_stack(runtime.eval_pdf(brdfs, wi, wo)))
        sampled = np.column_stack(runtime.sample(brdfs, wi, u))
        assert np.isfinite(sampled).all() and not sampled[hidden, 3:].any()
        albedo = runtime.albedo(brdfs, wi)
        assert np.isfinite(albedo).all() and not albedo[hidden].any()


@pytest.mark.parametrize(
    "name, directional",
    [(name, d) for name in encoding.ENCODERS for d in (True, False) if d or name not in DIRECTIONAL],
)
def test_networks_have_the_same_inputs(tmp_path, name, directional):
    """Every encoding computes the same inputs of the network in C++ as in Python.

    The network in this test is the identity, so that its outputs are its inputs.
    """
    rng, space, params = np.random.default_rng(5), class_of(name), TARGETS["principled"]
    inputs, size = encoding.size(name, space, directional), output_size(4, params)
    path = saved(tmp_path, space, name, 4, directional, params, np.eye(size, inputs), np.zeros(size))
    numbers, wi = drawn(space, rng), views(rng)
    columns = list(numbers.astype(np.float64).T)
    wanted = encoding.get(name)(columns, Vec3(*wi.astype(np.float64).T) if directional else None)
    wanted = np.stack([np.broadcast_to(column, CASES) for column in wanted], axis=-1)
    for instruction_set in in_single_precision():
        found = Runtime(path, instruction_set).outputs(numbers, wi)
        error = np.abs(found[:, :inputs] - wanted)
        # The formula of the conductor's Fresnel term loses digits by cancellation for a few metals, mostly at grazing
        # angles.
        assert np.quantile(error, 0.999) < 2e-6
        assert error.max() < 2e-4
        assert not found[:, inputs:].any()


def test_a_single_material_is_accepted_within_the_same_tolerance(tmp_path):
    known = LAYERED3.sample(np.random.default_rng(7), 1)[0]
    known[9] = 0.0
    adapter = nma.Adapter.load("layered3-3x32")
    size = output_size(2, adapter.target)
    layers = [(np.zeros((size, 1), np.float32), np.zeros(size, np.float32))]
    adapter = replace(adapter, encoding="direction", layers=layers, training={"params": known.tolist()})
    adapter.save(tmp_path / "single.safetensors")
    runtime = Runtime(tmp_path / "single.safetensors")
    for column, scale in ((0, known[0]), (9, 1e-3)):
        for factor, accepted in ((0.9, True), (1.1, False)):
            given = known.copy()
            given[column] += factor * SAME * scale
            numbers = given.astype(np.float32)
            known_to_c = runtime._c.nma_check(runtime._handle, pointer(numbers)) == -1
            assert known_to_c == accepted
            for call in (lambda x=given: adapter.check(x), lambda x=given: runtime.prepare([x], [0.5])):
                if accepted:
                    call()
                else:
                    with pytest.raises(nma.errors.ParamError):
                        call()


def test_curves_have_the_same_nodes(bridge):
    bridge.curve_min_cos.restype = ctypes.c_float
    assert bridge.curve_nodes() == curves.NODES
    assert bridge.curve_min_cos() == np.float32(curves.MIN_COS)


def test_curves_interpolate_every_number_between_two_nodes(bridge, tmp_path):
    """At a quarter of the distance between two nodes, all numbers and scales of a BRDF have changed by a quarter.

    A cosine outside of 0 .. 1, as rounding may give, has the BRDF of the nearest end.

    The scales vary, because the adapter would reflect more light than it receives if its target were not bounded.
    """
    params, rng = TARGETS["stretched"], np.random.default_rng(8)
    bright = Principled(Color(0.98, 0.95, 0.9), 0.9, 0.05, 1.0, 0.1, 0.9, 0.1, 0.5, 0.5)
    bias, last = np.array(encode(Blend((bright, bright), (0.6, 0.4)), params)), curves.NODES - 1
    slope = 0.1 * rng.normal(size=(len(bias), 1))
    path = saved(tmp_path, MEASURED, "direction", 2, True, params, slope, bias)
    replace(nma.Adapter.load(path), bounded=True).save(path)
    runtime, left = Runtime(path, "portable"), np.arange(1, last)
    nothing = pointer(np.zeros(1, np.float32))
    runtime._c.nma_curves_new.restype = ctypes.c_void_p
    made = ctypes.c_void_p(runtime._c.nma_curves_new(runtime._handle, nothing))

    def at(cosines):
        brdfs = runtime.prepare(np.zeros((len(cosines), 0)), np.ones(len(cosines)))
        for brdf, cosine in zip(brdfs, cosines, strict=True):
            runtime._c.nma_curves_at(made, ctypes.c_float(cosine), pointer(brdf))
        return numbers_of(brdfs)

    def numbers_of(brdfs):
        found = np.zeros((len(brdfs), 2 * (PRINCIPLED_SIZE + 1)), np.float32)
        scales = np.zeros((len(brdfs), 3), np.float32)
        bridge.brdf_numbers(len(brdfs), 2, pointer(brdfs), pointer(found))
        bridge.brdf_scales(len(brdfs), pointer(brdfs), pointer(scales))
        return np.column_stack([found, scales])

    nodes = numbers_of(runtime.prepare(np.zeros((last - 1, 0)), left / last))
    following = numbers_of(runtime.prepare(np.zeros((last - 1, 0)), (left + 1) / last))
    assert (np.abs(following - nodes)[:, -3:] > 1e-3).any(axis=0).all()
    quarter = at((left + 0.25) / last)
    ends, beyond = at([0.0, 0.0, 1.0, 1.0]), at([-1e-3, -0.5, 1.001, 1.5])
    runtime._c.nma_curves_free(made)
    np.testing.assert_allclose(quarter, nodes + 0.25 * (following - nodes), rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(beyond, ends)


@pytest.mark.parametrize("instruction_set", available())
def test_weights_are_rounded_to_the_nearest_bfloat16_and_ties_to_even(tmp_path, instruction_set):
    """Each output of the network in this test is one weight.

    The significand of a bfloat16 has 7 bits after the leading one.
    """
    step, size = 2.0**-7, output_size(2, TARGETS["principled"])
    given = 1.0 + step * np.array([0.5, 1.5, 2.5, 3.5, 0.499, 0.501, 1.499, 1.501, 1.0])
    wanted = 1.0 + step * np.array([0.0, 2.0, 2.0, 4.0, 0.0, 1.0, 1.0, 2.0, 1.0])
    weights = np.resize(np.concatenate([given, -given, 2.0**-20 * given]), size)
    path = saved(
        tmp_path, MEASURED, "direction", 2, False, TARGETS["principled"], weights[:, None], np.zeros(size)
    )
    found = Runtime(path, instruction_set, compact=True).outputs(np.zeros((1, 0)), [0.5])[0]
    expected = np.resize(np.concatenate([wanted, -wanted, 2.0**-20 * wanted]), size)
    np.testing.assert_array_equal(found, expected.astype(np.float32))


def test_the_albedo_is_the_mean_over_the_points_of_a_lattice():
    """C++ contains the steps of the lattice as constants, and Python computes the same steps."""
    points, runtime, rng = 128, Runtime("layered3-3x32"), np.random.default_rng(9)
    params, wi = LAYERED3.sample(rng, 20), rows(random_directions(rng, 20)).astype(np.float32)
    brdfs, n = runtime.prepare(params, wi), np.arange(points) + 0.5
    u = np.column_stack([n / points, n[:, None] * np.array(lattice_steps(2)) % 1.0])
    for brdf, view, albedo in zip(brdfs, wi, runtime.albedo(brdfs, wi), strict=True):
        _, value, pdf = runtime.sample(np.tile(brdf, (points, 1)), np.tile(view, (points, 1)), u)
        weights = value[pdf > 0] / pdf[pdf > 0, None]
        np.testing.assert_allclose(albedo, np.minimum(weights.sum(axis=0) / points, 1.0), rtol=1e-4)


def test_a_brdf_has_the_size_that_the_readme_says(bridge):
    readme = (ROOT / "runtime/README.md").read_text()
    assert bridge.brdf_size() == int(re.search(r"a plain value of (\d+) bytes", readme)[1])


def test_a_brdf_for_c_is_hardly_larger_than_a_brdf(bridge):
    """The C type of a BRDF is at most 16 bytes larger than the C++ type.

    The compiler checks that the C type is not smaller than the C++ type.
    """
    runtime = Runtime("layered3-3x32")
    assert 0 <= runtime._c.nma_brdf_size() - bridge.brdf_size() <= 16


def test_instruction_sets_have_the_values_of_the_c_header():
    header = (ROOT / "runtime/nma_c.h").read_text()
    names = re.search(r"enum \{ (.*) \};", header)[1].split(", ")
    assert tuple(name.removeprefix("NMA_").lower() for name in names[:-1]) == INSTRUCTION_SETS
    assert names[-1] == f"NMA_COMPACT = {_COMPACT:#x}"


def test_cmake_installs_the_version_of_the_package():
    version = re.search(r"project\(nma VERSION (\S+)", (ROOT / "runtime/CMakeLists.txt").read_text())[1]
    assert version == nma.__version__
