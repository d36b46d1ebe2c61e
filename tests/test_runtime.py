"""The target, the network, samples and curves of the C++ runtime equal those of the package."""

import ctypes
import re

import numpy as np
import pytest
from adapter_cases import random_interface_adapter
from density_cases import p_values
from runtime_cases import PRINCIPLED_SIZE, built, facing, in_single_precision, pointer, rows
from target_cases import below_interface, random_blend, random_directions, stacked

import nma
from nma import network, target
from nma.adapter import encoding, weights_file
from nma.native.runtime import INSTRUCTION_SETS, Runtime, available
from nma.ops import Vec3, at_azimuth_0
from nma.params import MEASURED

CASES = 4000

pytestmark = pytest.mark.usefixtures("compiler")


@pytest.fixture(scope="module")
def bridge(compiler, tmp_path_factory):
    return built(compiler, "runtime_bridge.cpp", tmp_path_factory.mktemp("runtime"))


@pytest.fixture(scope="module", params=[*nma.shipped(), "interface"])
def name(request, tmp_path_factory):
    """Returns the name of a shipped adapter, or the path of an adapter whose target lies under an interface."""
    if request.param != "interface":
        return request.param
    path = tmp_path_factory.mktemp("runtime") / "interface.safetensors"
    random_interface_adapter().save(path)
    return path


def flat(blend):
    """Converts a blend to an array (n, columns): the fields of all instances, then the weights."""
    columns = [x for p in blend.instances for x in (*p.base_color, *p[1:])]
    return np.ascontiguousarray(np.stack(np.broadcast_arrays(*columns, *blend.weights), axis=-1))


def interfaces_of(blend):
    """Converts the interfaces of a blend to an array (n, 2), or to None if the blend has none."""
    return blend.interface and np.stack(blend.interface, axis=-1)


def optional(array):
    return pointer(array) if array is not None else None


def cases(seed=0, count=2, interface=False):
    """Returns random blends, wi and wo. In half of the cases wo lies in the specular lobe of the first instance, or of
    any instance and of the interface if the blends lie under an interface."""
    rng = np.random.default_rng(seed)
    blend, wi, wo = (
        random_blend(rng, CASES, count, fades=True),
        random_directions(rng, CASES),
        random_directions(rng, CASES),
    )
    if interface:
        blend = below_interface(rng, blend)
        drawn = stacked(target.sample(blend, wi, *rng.random((3, CASES)))[0])
        return blend, wi, Vec3(*np.where(rng.random(CASES) < 0.5, drawn, stacked(wo)))
    near, alpha = np.arange(CASES) % 2 == 0, blend.instances[0].roughness ** 2
    tilt = alpha * np.tan(0.5 * np.pi * 0.9 * rng.random(CASES))
    turn = 2.0 * np.pi * rng.random(CASES)
    h = np.stack([tilt * np.cos(turn), tilt * np.sin(turn), np.ones(CASES)])
    h /= np.linalg.norm(h, axis=0)
    mirrored = 2.0 * (stacked(wi) * h).sum(axis=0) * h - stacked(wi)
    return blend, wi, Vec3(*np.where(near, mirrored, stacked(wo)))


# Under an interface, the runtime evaluates one or two instances by code of their own.
@pytest.mark.parametrize("count, interface", [(2, False), (1, True), (2, True), (3, True)])
@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-9), (np.float32, 1e-4)])
def test_values_and_densities_are_those_of_the_target(bridge, dtype, tolerance, bounded, count, interface):
    blend, wi, wo = cases(count=count, interface=interface)
    # The runtime and the package get the same inputs, rounded to the precision of the runtime.
    numbers, i, o = (x.astype(dtype) for x in (flat(blend), rows(wi), rows(wo)))
    above = interfaces_of(blend).astype(dtype) if interface else None
    found = np.zeros((CASES, 4), dtype)
    call = bridge.evaluate_float if dtype == np.float32 else bridge.evaluate_double
    call(CASES, count, bounded, pointer(numbers), optional(above), *(pointer(x) for x in (i, o, found)))
    wide = [x.astype(np.float64).T for x in (numbers, i, o)]
    exact = unflat(wide[0], above)
    exact = target.bounded(exact, wide[1][2]) if bounded else exact
    value, pdf = target.eval_pdf(exact, Vec3(*wide[1]), Vec3(*wide[2]))
    wanted = np.stack([*value, pdf], axis=-1)
    assert (wanted[:, 3] > 0).mean() > 0.7
    np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=1e-7)


def unflat(columns, interfaces=None):
    """Inverts `flat` and `interfaces_of`: makes a blend from the columns of the arrays."""
    instances = []
    count = len(columns) // (PRINCIPLED_SIZE + 1)
    for k in range(count):
        p = columns[PRINCIPLED_SIZE * k : PRINCIPLED_SIZE * (k + 1)]
        instances.append(target.Principled(Vec3(*p[:3]), *p[3:]))
    interface = None if interfaces is None else target.Interface(*interfaces.astype(np.float64).T)
    return target.Blend(tuple(instances), tuple(columns[count * PRINCIPLED_SIZE :]), interface=interface)


@pytest.mark.parametrize("interface", [False, True])
def test_samples_are_those_of_the_target(bridge, interface):
    blend, wi, _ = cases(1, interface=interface)
    u = np.random.default_rng(2).random((CASES, 3))
    found = np.zeros((CASES, 7))
    numbers, above, i = flat(blend), interfaces_of(blend), rows(wi)
    bridge.sample_double(CASES, 2, pointer(numbers), optional(above), *(pointer(x) for x in (i, u, found)))
    wo, value, pdf = target.sample(blend, wi, *u.T)
    np.testing.assert_allclose(found, np.stack([*wo, *value, pdf], axis=-1), rtol=1e-6, atol=1e-9)


def rounded(layers):
    """Rounds the matrices of layers to bfloat16, to the nearest value and with ties to even."""
    bits = [np.asarray(matrix, np.float32).view(np.uint32) for matrix, _ in layers]
    halves = [((b + 0x7FFF + (b >> 16 & 1)) & 0xFFFF0000).astype(np.uint32).view(np.float32) for b in bits]
    return [(matrix, bias) for matrix, (_, bias) in zip(halves, layers, strict=True)]


def queries(seed):
    rng = np.random.default_rng(seed)
    return nma.LAYERED3.sample(rng, CASES).astype(np.float32), 0.02 + 0.98 * rng.random(CASES, np.float32)


@pytest.mark.parametrize("compact", [False, True])
def test_network_outputs_agree_on_every_instruction_set(name, compact):
    adapter = nma.Adapter.load(name)
    params, cosines = queries(3)
    inputs = encoding.get(adapter.encoding)(
        list(params.T.astype(np.float64)), at_azimuth_0(cosines.astype(np.float64))
    )
    layers = rounded(adapter.layers) if compact else adapter.layers
    wanted = network.forward(layers, np.stack(inputs, axis=-1))
    found = {}
    for instruction_set in available():
        loaded = Runtime(name, instruction_set, compact=compact)
        assert loaded.instruction_set == instruction_set
        found[instruction_set] = loaded.outputs(params, cosines)
    for instruction_set, outputs in found.items():
        error = np.abs(outputs - wanted) / (1.0 + np.abs(wanted))
        if instruction_set == "avx512_bf16":
            # The instruction set avx512_bf16 rounds activations to the 8 significant bits of bfloat16.
            assert np.sqrt((error**2).mean()) < 0.02
            continue
        # A few inputs have larger errors, because the formula of the conductor's Fresnel term loses digits by
        # cancellation.
        assert np.quantile(error, 0.999) < 1e-5
        assert error.max() < 2e-4
        assert np.abs(outputs - found["portable"]).max() < 1e-4


def test_single_queries_and_batches_make_the_same_materials(name):
    params, cosines = queries(6)
    wi = facing(cosines)
    wo = rows(random_directions(np.random.default_rng(7), CASES)).astype(np.float32)
    for instruction_set in available():
        loaded = Runtime(name, instruction_set)
        many = loaded.prepare(params, cosines)
        each = np.zeros_like(many)
        for material, numbers, cosine in zip(each, params, cosines, strict=True):
            loaded._c.nma_prepare(loaded._handle, pointer(numbers), ctypes.c_float(cosine), pointer(material))
        many, each = (np.column_stack(loaded.eval_pdf(materials, wi, wo)) for materials in (many, each))
        tolerance = 1e-2 if instruction_set == "avx512_bf16" else 1e-3
        np.testing.assert_allclose(many, each, rtol=tolerance, atol=1e-5)


def test_an_adapter_evaluates_like_the_package(name):
    adapter, rng = nma.Adapter.load(name), np.random.default_rng(4)
    params = nma.LAYERED3.sample(rng, CASES).astype(np.float32)
    wi, wo = (rows(random_directions(rng, CASES)).astype(np.float32) for _ in range(2))
    i, o = Vec3(*wi.T), Vec3(*wo.T)
    value, pdf = adapter.prepare(list(params.T), i).eval_pdf(i, o)
    for instruction_set in in_single_precision():
        loaded = Runtime(name, instruction_set)
        found = np.column_stack(loaded.eval_pdf(loaded.prepare(params, wi.T[2]), wi, wo))
        # The errors of the network's outputs are about 1e-5. The values of a narrow lobe change much if an output
        # changes a little, so the relative errors of the values are larger.
        np.testing.assert_allclose(found, np.stack([*value, pdf], axis=-1), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("hidden", ([32, 32, 32], [8]))
def test_an_adapter_of_a_single_material_evaluates_like_the_package(tmp_path, hidden):
    """The runtime and the package compute the same values of a measured material, within 2e-3.

    The class has no parameters, so that cos(theta_i) is the only input of the network. The target has all parameters of
    a measured material, including `anisotropic`, `flatness` and `fade`.
    """
    rng, size = np.random.default_rng(14), target.output_size(2, target.MEASURED_PARAMS)
    layers = network.init(rng, [1, *hidden, size], rng.normal(size=size))
    adapter = nma.Adapter(MEASURED, "direction", layers, 2, True, target.MEASURED_PARAMS)
    adapter.save(tmp_path / "single.safetensors")
    wi, wo = (rows(random_directions(rng, CASES)).astype(np.float32) for _ in range(2))
    i, o = Vec3(*wi.T), Vec3(*wo.T)
    value, pdf = adapter.prepare([], i).eval_pdf(i, o)
    assert 0.05 < (value.x == 0).mean() < 0.95
    for instruction_set in in_single_precision():
        loaded = Runtime(tmp_path / "single.safetensors", instruction_set)
        assert loaded.parameters == 0
        found = np.column_stack(loaded.eval_pdf(loaded.prepare(np.zeros((CASES, 0)), wi.T[2]), wi, wo))
        np.testing.assert_allclose(found, np.stack([*value, pdf], axis=-1), rtol=2e-3, atol=1e-5)


def test_curves_have_the_values_of_the_network(name):
    """Values from curves agree with values from the network: the median error is below 5e-4 of a value.

    The docstring of nma/render/curves.py states a mean error of about 1e-4 for curves with the same count of nodes.
    """
    params, cosines = queries(8)
    wi = facing(cosines)
    u = np.random.default_rng(9).random((CASES, 3), np.float32)
    loaded = Runtime(name)
    library = loaded._c
    library.nma_curves_new.restype = ctypes.c_void_p
    for material in params[:5]:
        exact = loaded.prepare(np.tile(material, (CASES, 1)), cosines)
        followed = np.zeros_like(exact)
        curves = ctypes.c_void_p(library.nma_curves_new(loaded._handle, pointer(material)))
        for row, cosine in zip(followed, cosines, strict=True):
            library.nma_curves_at(curves, ctypes.c_float(cosine), pointer(row))
        library.nma_curves_free(curves)
        wo, _, pdf = loaded.sample(exact, wi, u)
        a, b = (np.column_stack(loaded.eval_pdf(m, wi, wo))[pdf > 0] for m in (followed, exact))
        error = np.abs(a - b) / (1e-3 + b)
        assert np.median(error) < 5e-4
        assert error.mean() < 5e-3


def test_curves_at_nan_and_out_of_range_have_the_values_of_the_ends():
    loaded = Runtime("layered3-3x32")
    library = loaded._c
    library.nma_curves_new.restype = ctypes.c_void_p
    curves = ctypes.c_void_p(library.nma_curves_new(loaded._handle, pointer(queries(8)[0][0])))
    cosines = (0.0, np.nan, -np.inf, -2.0, 1.0, 2.0, np.inf)
    rows = np.zeros_like(loaded.prepare(np.tile(queries(8)[0][0], (len(cosines), 1)), np.ones(len(cosines))))
    for row, cosine in zip(rows, cosines, strict=True):
        library.nma_curves_at(curves, ctypes.c_float(cosine), pointer(row))
    library.nma_curves_free(curves)
    wi = np.tile([0.6, 0.0, 0.8], (len(cosines), 1)).astype(np.float32)
    values = loaded.eval(rows, wi, wi)
    np.testing.assert_array_equal(values, values[[0, 0, 0, 0, 4, 4, 4]])


def test_samples_have_the_values_and_densities_of_eval(name):
    params, cosines = queries(10)
    wi = facing(cosines)
    u = np.random.default_rng(11).random((CASES, 3), np.float32)
    loaded = Runtime(name)
    materials = loaded.prepare(params, cosines)
    wo, value, pdf = loaded.sample(materials, wi, u)
    valid = pdf > 0
    # An interface reflects some samples back down.
    assert valid.mean() > (0.85 if nma.Adapter.load(name).interface else 0.9)
    assert np.abs(np.linalg.norm(wo, axis=1) - 1)[valid].max() < 1e-5
    again, density = loaded.eval_pdf(materials, wi, wo)
    np.testing.assert_allclose(value[valid], again[valid], rtol=1e-6)
    np.testing.assert_allclose(pdf[valid], density[valid], rtol=1e-6)


@pytest.mark.slow
def test_samples_follow_the_density(name):
    """Samples of six materials follow their density (chi-square tests, false-alarm rate 1e-3 in all).

    The lobes in this test are not narrow. tests/test_target_sampling.py tests the package's sampling in double
    precision and for lobes of any width.
    """
    tests = 6
    params, cosines = queries(12)
    params, cosines = params[:tests], cosines[:tests]
    params[:, :2] = np.random.default_rng(13).uniform(0.1, 0.3, (tests, 2))
    wi = facing(cosines).astype(np.float32)
    rng, loaded = np.random.default_rng(14), Runtime(name)
    materials = loaded.prepare(params, cosines)
    for k in range(tests):

        def alike(n, k=k):
            """Returns n copies of the material and of its view direction."""
            return (np.repeat(x[k : k + 1], n, 0) for x in (materials, wi))

        def sample(n):
            wo, _, pdf = loaded.sample(*alike(n), rng.random((n, 3), np.float32))
            return wo, pdf

        right, wrong = p_values(sample, lambda wo: loaded.eval_pdf(*alike(len(wo)), wo)[1])
        assert right > 1 - (1 - 1e-3) ** (1 / tests), k
        assert wrong < 1e-6


def test_albedos_are_the_means_of_sample_weights_and_have_no_noise(name):
    params, cosines = queries(17)
    params, cosines, many = params[:10], np.linspace(0.02, 1.0, 10, dtype=np.float32), 1 << 15
    wi = facing(cosines)
    loaded = Runtime(name)
    materials = loaded.prepare(params, cosines)
    found = loaded.albedo(materials, wi)
    np.testing.assert_array_equal(found, loaded.albedo(materials, wi))
    assert found.max() <= 1.0
    for material, view, albedo in zip(materials, wi, found, strict=True):
        u = np.random.default_rng(18).random((many, 3), np.float32)
        _, value, pdf = loaded.sample(np.tile(material, (many, 1)), np.tile(view, (many, 1)), u)
        weights = np.where(pdf[:, None] > 0, value / np.maximum(pdf, 1e-20)[:, None], 0.0)
        np.testing.assert_allclose(albedo, weights.mean(axis=0, dtype=np.float64), atol=0.02)


def test_parameters_beyond_the_training_range_are_refused_or_clamped():
    loaded = Runtime("layered3-3x32")
    params, cosines = queries(16)
    low, high = (x.astype(np.float32) for x in nma.LAYERED3.columns("training"))
    assert loaded.names[:4] == ["alpha_top", "alpha_bottom", "eta_top", "eta_conductor"]
    np.testing.assert_array_equal((loaded.low, loaded.high), (low, high))
    for column, value in ((0, 0.5), (2, -np.inf), (9, np.nan), (12, 1.01)):
        beyond = params.copy()
        beyond[7, column] = value
        wanted = f"row 7: {loaded.names[column]} is {value:g}, allowed is {low[column]:g} "
        with pytest.raises(nma.errors.ParamError, match=re.escape(wanted)):
            loaded.prepare(beyond, cosines)
        assert loaded._c.nma_check(loaded._handle, pointer(beyond[7])) == column
        moved = params.copy()
        moved[7, column] = high[column] if value > high[column] else low[column]
        if np.isfinite(value):
            found = loaded.outputs(beyond, cosines, clamp=True)
            np.testing.assert_array_equal(found, loaded.outputs(moved, cosines))
        loaded._c.nma_clamp(loaded._handle, pointer(beyond[7]))
        np.testing.assert_array_equal(beyond, moved)
    with pytest.raises(nma.errors.ParamError, match="row 0: albedo is nan"):
        loaded.prepare(params * np.where(np.arange(13) == 9, np.nan, 1), cosines, clamp=True)
    assert loaded._c.nma_check(loaded._handle, pointer(params[0])) == -1


def test_an_instruction_set_that_this_cpu_lacks_falls_back():
    absent = [name for name in INSTRUCTION_SETS[1:] if name not in available()]
    assert absent, "no CPU has both NEON and AVX"
    loaded = Runtime("layered3-3x32", absent[0])
    assert loaded.instruction_set == "portable"
    message = ctypes.create_string_buffer(100)
    assert not loaded._c.nma_load(b"none", len(INSTRUCTION_SETS), message, 100)
    assert message.value == b"no such instruction set"


def test_an_adapter_loaded_from_memory_equals_that_from_its_file():
    loaded, data = Runtime("layered3-3x32"), weights_file("layered3-3x32").read_bytes()
    params, cosines = queries(15)
    library = loaded._c
    library.nma_from_memory.restype = ctypes.c_void_p
    handle = ctypes.c_void_p(library.nma_from_memory(data, ctypes.c_size_t(len(data)), 0, None, 0))
    found = np.zeros((CASES, loaded.size), np.float32)
    library.nma_outputs_many(handle, CASES, *(pointer(x) for x in (params, cosines, found)))
    library.nma_free(handle)
    np.testing.assert_array_equal(found, loaded.outputs(params, cosines))
