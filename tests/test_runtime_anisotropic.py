"""Anisotropic adapters, whose input is the whole view direction, give equal results in C++ and in the package."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest
from adapter_cases import materials, random_anisotropic_adapter
from runtime_cases import facing, pointer, rows
from target_cases import random_directions

import nma
from nma import network
from nma.adapter import encoding
from nma.errors import ParamError
from nma.native.runtime import Runtime, available
from nma.ops import Vec3

RUNTIME = Path(__file__).parent.parent / "runtime"
CASES = 4000
# With AVX-512, the activations of the first network stay in registers, and those of the second network do not. The
# third network has more inputs (after padding) than neurons per layer.
NETWORKS = ("3x32", "2x64", "1x4")

pytestmark = pytest.mark.usefixtures("compiler")


@pytest.fixture(scope="module", params=NETWORKS)
def case(request, tmp_path_factory):
    """An adapter and the path of its file."""
    adapter = random_anisotropic_adapter(request.param)
    path = tmp_path_factory.mktemp("anisotropic") / "brushed.safetensors"
    adapter.save(path)
    return adapter, path


def directions(seed):
    """Returns CASES random directions over the hemisphere, (n, 3)."""
    return rows(random_directions(np.random.default_rng(seed), CASES)).astype(np.float32)


def outputs(adapter, wi):
    """Returns the outputs (n, size) of the network, computed by the package."""
    inputs = encoding.get(adapter.encoding)([], Vec3(*wi.T.astype(np.float64)))
    return network.forward(adapter.layers, np.stack(inputs, axis=-1))


def none():
    """Returns parameters (n, 0), for materials without parameters."""
    return np.zeros((CASES, 0))


def close(a, b, instruction_set):
    """Returns the share of rows in which `a` and `b` agree within a tolerance.

    The tolerance is larger for the instruction set avx512_bf16, which rounds activations.
    """
    rounded = instruction_set == "avx512_bf16"
    return np.isclose(a, b, rtol=0.1 if rounded else 2e-3, atol=2e-2 if rounded else 1e-4).all(axis=1).mean()


def test_network_outputs_are_those_of_the_package(case):
    adapter, path = case
    wi = directions(1)
    wanted = outputs(adapter, wi)
    turned = outputs(adapter, wi[:, [1, 0, 2]])
    for instruction_set in available():
        runtime = Runtime(path, instruction_set)
        assert runtime.anisotropic and runtime.parameters == 0
        error = np.abs(runtime.outputs(none(), wi) - wanted) / (1 + np.abs(wanted))
        if instruction_set == "avx512_bf16":
            assert np.sqrt((error**2).mean()) < 0.02
        else:
            assert error.max() < 1e-5
    # A wrong azimuth would change the outputs far more than rounding does.
    assert np.abs(turned - wanted).mean() > 0.3


def test_values_densities_and_samples_are_those_of_the_package(case):
    adapter, path = case
    wi, wo = directions(2), directions(3)
    u = np.random.default_rng(4).random((CASES, 3), np.float32)
    own = adapter.prepare([], Vec3(*wi.T))
    value, pdf = own.eval_pdf(Vec3(*wi.T), Vec3(*wo.T))
    drawn = own.sample(Vec3(*wi.T), *u.T)
    values = np.stack([*value, pdf], axis=-1)
    samples = np.stack([*drawn[0], *drawn[1], drawn[2]], axis=-1)
    for instruction_set in available():
        runtime = Runtime(path, instruction_set)
        prepared = runtime.prepare(none(), wi)
        found = np.column_stack(runtime.eval_pdf(prepared, wi, wo))
        assert close(found, values, instruction_set) > 0.998
        # Near the border between two lobes, rounding may choose the other lobe.
        found = np.column_stack(runtime.sample(prepared, wi, u))
        assert close(found, samples, instruction_set) > 0.998


def test_single_queries_and_batches_make_the_same_materials(case):
    wi, wo = directions(5), directions(6)
    for instruction_set in available():
        runtime = Runtime(case[1], instruction_set)
        many = runtime.prepare(none(), wi)
        each = np.zeros_like(many)
        for material, row in zip(each, wi, strict=True):
            runtime._c.nma_prepare_direction(runtime._handle, None, pointer(row), pointer(material))
        many, each = (np.column_stack(runtime.eval_pdf(m, wi, wo)) for m in (many, each))
        tolerance = 1e-2 if instruction_set == "avx512_bf16" else 1e-3
        np.testing.assert_allclose(many, each, rtol=tolerance, atol=1e-5)


def test_a_cosine_alone_stands_for_azimuth_zero(case):
    runtime = Runtime(case[1])
    cosines = np.random.default_rng(7).uniform(0.02, 1, CASES).astype(np.float32)
    many, one = np.zeros((CASES, runtime.size), np.float32), np.zeros((1, runtime._brdf), np.float32)
    library, handle = runtime._c, runtime._handle
    library.nma_outputs_many(handle, CASES, None, pointer(cosines), pointer(many))
    np.testing.assert_allclose(many, runtime.outputs(none(), facing(cosines)), rtol=1e-4, atol=1e-4)
    library.nma_prepare(handle, None, ctypes.c_float(cosines[0]), pointer(one))
    wi, wo = facing(cosines[:1]), directions(8)[:1]
    again = runtime.prepare(np.zeros((1, 0)), wi)
    np.testing.assert_allclose(
        runtime.eval_pdf(one, wi, wo)[0], runtime.eval_pdf(again, wi, wo)[0], rtol=1e-3
    )


def test_isotropic_adapters_read_the_cosine_of_a_direction():
    params, wi = materials(CASES).astype(np.float32), directions(9)
    for name in nma.shipped():
        runtime = Runtime(name)
        assert not runtime.anisotropic
        np.testing.assert_array_equal(runtime.outputs(params, wi), runtime.outputs(params, wi[:, 2]))
        by_direction, by_cosine = (runtime.prepare(params, v) for v in (wi, wi[:, 2]))
        wo = directions(10)
        for a, b in zip(
            runtime.eval_pdf(by_direction, wi, wo), runtime.eval_pdf(by_cosine, wi, wo), strict=True
        ):
            np.testing.assert_array_equal(a, b)


def test_cosines_and_other_shapes_are_refused(case):
    runtime, wi = Runtime(case[1]), directions(11)
    for call in (runtime.prepare, runtime.outputs):
        with pytest.raises(ParamError, match=r"give wi of shape \(n, 3\), not cosines \(4000,\)"):
            call(none(), wi[:, 2])
        with pytest.raises(ParamError, match=r"wi must have shape \(n, 3\), got \(4000, 2\)"):
            call(none(), wi[:, :2])
        with pytest.raises(ParamError, match="params has 4000 rows, but wi has 3999 directions"):
            call(none(), wi[1:])


@pytest.fixture(scope="module")
def curves(compiler, tmp_path_factory):
    """A program that prints why it cannot make curves of an adapter."""
    folder = tmp_path_factory.mktemp("curves")
    source = folder / "curves.cpp"
    source.write_text(
        """
        #include "nma.h"
        #include <cstdio>
        int main(int, char** words) {
            const nma::Adapter adapter = nma::Adapter::load(words[1]);
            try {
                const nma::Curves curves(adapter, nullptr);
            } catch (const nma::Error& e) {
                std::puts(e.what());
            }
        }
        """
    )
    program = folder / "curves"
    subprocess.run([compiler, "-std=c++17", f"-I{RUNTIME}", source, "-o", program], check=True)
    return program


def test_anisotropic_adapters_have_no_curves(case, curves):
    """A request for curves of an anisotropic adapter throws an error in C++, and returns a null pointer in C.

    The error says that the adapter is anisotropic, and that `prepare` needs directions.
    """
    done = subprocess.run([curves, case[1]], capture_output=True, text=True, check=True)
    assert "anisotropic" in done.stdout and "pass directions to `prepare`" in done.stdout
    runtime = Runtime(case[1])
    runtime._c.nma_curves_new.restype = ctypes.c_void_p
    assert runtime._c.nma_curves_new(runtime._handle, None) is None
