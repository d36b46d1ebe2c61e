"""The C++ runtime against the package that it repeats: the target, the network, and files that make no sense."""

import ctypes
import importlib.util
import json
import struct
import subprocess
import sys
import textwrap
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import chi2
from target_cases import random_blend, random_directions, stacked

import nma
from nma import encoding, network, target
from nma.export.classes import classes
from nma.export.cpp import cpp, print_function
from nma.export.functions import Unsupported, parsed
from nma.ops import Vec3
from nma.params import MEASURED

ROOT = Path(__file__).parent.parent
FLAGS = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
CASES = 4000
# In the order of the C interface.
SETS = ["fastest", "portable", "neon", "avx2", "avx512", "avx512_bf16"]
COMPACT = 0x100
# Floats of an opaque material.
MATERIAL = 168
# Numbers of an instance.
FIELDS = len(target.Principled._fields) + 2


@pytest.fixture(scope="module")
def library(compiler, tmp_path_factory):
    path = tmp_path_factory.mktemp("runtime") / "bridge.so"
    sources = [ROOT / "tests/runtime_bridge.cpp", ROOT / "runtime/nma_c.cpp"]
    command = [compiler, *FLAGS, f"-I{ROOT / 'runtime'}", "-shared", "-fPIC", *sources, "-o", path]
    subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(path))
    for maker in (loaded.nma_from_memory, loaded.nma_load, loaded.nma_curves_new):
        maker.restype = ctypes.c_void_p
    return loaded


def pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


def flat(blend):
    """(n, 14 per instance): fields of all instances, then the weights."""
    columns = [x for p in blend.instances for x in (*p.base_color, *p[1:])]
    return np.ascontiguousarray(np.stack([*columns, *blend.weights], axis=-1))


def cases(seed=0, count=2):
    """Random blends and directions; in half of the pairs wo lies within the specular lobe of the first instance."""
    rng = np.random.default_rng(seed)
    blend, wi, wo = (
        random_blend(rng, CASES, count, fades=True),
        random_directions(rng, CASES),
        random_directions(rng, CASES),
    )
    near, alpha = np.arange(CASES) % 2 == 0, blend.instances[0].roughness ** 2
    tilt = alpha * np.tan(0.5 * np.pi * 0.9 * rng.random(CASES))
    turn = 2.0 * np.pi * rng.random(CASES)
    h = np.stack([tilt * np.cos(turn), tilt * np.sin(turn), np.ones(CASES)])
    h /= np.linalg.norm(h, axis=0)
    mirrored = 2.0 * (stacked(wi) * h).sum(axis=0) * h - stacked(wi)
    return blend, wi, Vec3(*np.where(near, mirrored, stacked(wo)))


def rows(v):
    return np.ascontiguousarray(stacked(v).T)


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-9), (np.float32, 1e-4)])
def test_values_and_densities_are_those_of_the_target(library, dtype, tolerance, bounded):
    blend, wi, wo = cases()
    # Both see the same numbers, rounded to what the runtime works with.
    numbers, i, o = (x.astype(dtype) for x in (flat(blend), rows(wi), rows(wo)))
    found = np.zeros((CASES, 4), dtype)
    call = library.evaluate_float if dtype == np.float32 else library.evaluate_double
    call(CASES, 2, bounded, *(pointer(x) for x in (numbers, i, o, found)))
    wide = [x.astype(np.float64).T for x in (numbers, i, o)]
    exact = unflat(wide[0])
    exact = target.bounded(exact, wide[1][2]) if bounded else exact
    value, pdf = target.eval_pdf(exact, Vec3(*wide[1]), Vec3(*wide[2]))
    wanted = np.stack([*value, pdf], axis=-1)
    assert (wanted[:, 3] > 0).mean() > 0.7
    np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=1e-7)


def unflat(columns):
    """Inverse of `flat`, from its columns."""
    instances = []
    for k in range(2):
        p = columns[FIELDS * k : FIELDS * (k + 1)]
        instances.append(target.Principled(Vec3(*p[:3]), *p[3:]))
    return target.Blend(tuple(instances), tuple(columns[2 * FIELDS :]))


def test_samples_are_those_of_the_target(library):
    blend, wi, _ = cases(1)
    u = np.random.default_rng(2).random((CASES, 3))
    found = np.zeros((CASES, 7))
    numbers, i = flat(blend), rows(wi)
    library.sample_double(CASES, 2, *(pointer(x) for x in (numbers, i, u, found)))
    wo, value, pdf = target.sample(blend, wi, *u.T)
    np.testing.assert_allclose(found, np.stack([*wo, *value, pdf], axis=-1), rtol=1e-6, atol=1e-9)


class Loaded:
    """An adapter of the runtime, through its C interface."""

    def __init__(self, library, data: bytes, instruction_set="fastest", compact=False):
        message = ctypes.create_string_buffer(500)
        number = SETS.index(instruction_set) + (COMPACT if compact else 0)
        handle = library.nma_from_memory(
            data, ctypes.c_size_t(len(data)), number, message, ctypes.c_size_t(500)
        )
        self.library, self.handle = library, ctypes.c_void_p(handle)
        self.message = message.value.decode()

    def __enter__(self):
        return self

    def __exit__(self, *args):
        self.library.nma_free(self.handle)

    def outputs(self, params, cosines):
        found = np.zeros((len(params), self.library.nma_output_count(self.handle)), np.float32)
        arguments = (pointer(x) for x in (params, cosines, found))
        self.library.nma_outputs_many(self.handle, len(params), *arguments)
        return found

    def prepare(self, params, cosines):
        """Opaque materials."""
        made = np.zeros((len(params), MATERIAL), np.float32)
        self.library.nma_prepare_many(
            self.handle, len(params), *(pointer(x) for x in (params, cosines, made))
        )
        return made

    def prepare_each(self, params, cosines):
        made = np.zeros((len(params), MATERIAL), np.float32)
        for k, cosine in enumerate(cosines):
            self.library.nma_prepare(
                self.handle, pointer(params[k]), ctypes.c_float(cosine), pointer(made[k])
            )
        return made

    def eval(self, materials, wi, wo):
        found = np.zeros((len(wi), 4), np.float32)
        self.library.nma_eval(len(wi), *(pointer(x) for x in (materials, wi, wo, found)))
        return found

    def sample(self, materials, wi, u):
        found = np.zeros((len(wi), 7), np.float32)
        self.library.nma_sample(len(wi), *(pointer(x) for x in (materials, wi, u, found)))
        return found


def available(library, names=SETS[1:]):
    """Instruction sets of this CPU."""
    return [name for name in names if library.nma_supported(SETS.index(name))]


def stored(name):
    return (ROOT / "nma/adapters" / f"{name}.safetensors").read_bytes()


def rounded(layers):
    """Matrices rounded to bfloat16: the upper halves, to nearest, ties to even."""
    bits = [np.asarray(matrix, np.float32).view(np.uint32) for matrix, _ in layers]
    halves = [((b + 0x7FFF + (b >> 16 & 1)) & 0xFFFF0000).astype(np.uint32).view(np.float32) for b in bits]
    return [(matrix, bias) for matrix, (_, bias) in zip(halves, layers, strict=True)]


def queries(seed):
    rng = np.random.default_rng(seed)
    return nma.LAYERED3.sample(rng, CASES).astype(np.float32), 0.02 + 0.98 * rng.random(CASES, np.float32)


@pytest.mark.parametrize("compact", [False, True])
@pytest.mark.parametrize("name", nma.shipped())
def test_network_outputs_agree_on_every_instruction_set(library, name, compact):
    adapter = nma.Adapter.load(name)
    params, cosines = queries(3)
    inputs = encoding.get(adapter.encoding)(list(params.T.astype(np.float64)), cosines.astype(np.float64))
    layers = rounded(adapter.layers) if compact else adapter.layers
    wanted = network.forward(layers, np.stack(inputs, axis=-1))
    found = {}
    for instruction_set in available(library):
        with Loaded(library, stored(name), instruction_set, compact) as loaded:
            assert library.nma_instruction_set(loaded.handle) == SETS.index(instruction_set)
            found[instruction_set] = loaded.outputs(params, cosines)
    for instruction_set, outputs in found.items():
        error = np.abs(outputs - wanted) / (1.0 + np.abs(wanted))
        if instruction_set == "avx512_bf16":
            # Eight bits of every activation.
            assert np.sqrt((error**2).mean()) < 0.02
            continue
        # Inputs where the conductor's Fresnel term cancels are off by more than the network's own rounding.
        assert np.quantile(error, 0.999) < 1e-5
        assert error.max() < 2e-4
        assert np.abs(outputs - found["portable"]).max() < 1e-4


@pytest.mark.parametrize("name", nma.shipped())
def test_single_queries_and_batches_make_the_same_materials(library, name):
    params, cosines = queries(6)
    wi = np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)
    wo = rows(random_directions(np.random.default_rng(7), CASES)).astype(np.float32)
    for instruction_set in available(library):
        with Loaded(library, stored(name), instruction_set) as loaded:
            many = loaded.eval(loaded.prepare(params, cosines), wi, wo)
            each = loaded.eval(loaded.prepare_each(params, cosines), wi, wo)
        tolerance = 1e-2 if instruction_set == "avx512_bf16" else 1e-3
        np.testing.assert_allclose(many, each, rtol=tolerance, atol=1e-5)


def test_an_adapter_evaluates_like_the_package(library):
    adapter, rng = nma.Adapter.load("layered3-3x32"), np.random.default_rng(4)
    params = nma.LAYERED3.sample(rng, CASES).astype(np.float32)
    wi, wo = (rows(random_directions(rng, CASES)).astype(np.float32) for _ in range(2))
    value, pdf = target.eval_pdf(adapter.prepare(list(params.T), wi.T[2]), Vec3(*wi.T), Vec3(*wo.T))
    for instruction_set in available(library, SETS[1:-1]):
        with Loaded(library, stored("layered3-3x32"), instruction_set) as loaded:
            found = loaded.eval(loaded.prepare(params, np.ascontiguousarray(wi.T[2])), wi, wo)
        # Errors of the network's outputs, 1e-5, are multiplied by sharp lobes.
        np.testing.assert_allclose(found, np.stack([*value, pdf], axis=-1), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("hidden", ([32, 32, 32], [8]))
def test_an_adapter_of_a_single_material_evaluates_like_the_package(library, tmp_path, hidden):
    """No parameters, one input, and lobes that are stretched in the plane of incidence, flattened and faded."""
    rng, size = np.random.default_rng(14), target.output_size(2, target.MEASURED_PARAMS)
    layers = network.init(rng, [1, *hidden, size], rng.normal(size=size))
    adapter = nma.Adapter(MEASURED, "direction", layers, 2, True, target.MEASURED_PARAMS)
    adapter.save(tmp_path / "single.safetensors")
    wi, wo = (rows(random_directions(rng, CASES)).astype(np.float32) for _ in range(2))
    plane = target.Plane.of(Vec3(*wi.T))
    blend = adapter.prepare([], wi.T[2])
    value, pdf = target.eval_pdf(blend, *(plane.enter(Vec3(*w.T)) for w in (wi, wo)))
    assert 0.05 < (value.x == 0).mean() < 0.95
    for instruction_set in available(library, SETS[1:-1]):
        with Loaded(library, (tmp_path / "single.safetensors").read_bytes(), instruction_set) as loaded:
            assert library.nma_parameter_count(loaded.handle) == 0
            materials = loaded.prepare(np.zeros((CASES, 0), np.float32), np.ascontiguousarray(wi.T[2]))
            found = loaded.eval(materials, wi, wo)
        np.testing.assert_allclose(found, np.stack([*value, pdf], axis=-1), rtol=2e-3, atol=1e-5)


def test_curves_follow_the_network(library):
    """About to the error that nma/render/curves.py states of as many nodes, 1e-4 of a value."""
    params, cosines = queries(8)
    wi = np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)
    u = np.random.default_rng(9).random((CASES, 3), np.float32)
    with Loaded(library, stored("layered3-5x64")) as loaded:
        for material in params[:5]:
            curves = ctypes.c_void_p(library.nma_curves_new(loaded.handle, pointer(material)))
            followed = np.zeros((CASES, MATERIAL), np.float32)
            for k, cosine in enumerate(cosines):
                library.nma_curves_at(curves, ctypes.c_float(cosine), pointer(followed[k]))
            library.nma_curves_free(curves)
            exact = loaded.prepare(np.tile(material, (CASES, 1)), cosines)
            drawn = loaded.sample(exact, wi, u)
            wo = np.ascontiguousarray(drawn[:, :3])
            a, b = (loaded.eval(m, wi, wo)[drawn[:, 6] > 0] for m in (followed, exact))
            error = np.abs(a - b) / (1e-3 + b)
            assert np.median(error) < 5e-4
            assert error.mean() < 5e-3


def test_samples_have_the_values_and_densities_of_eval(library):
    params, cosines = queries(10)
    wi = np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)
    u = np.random.default_rng(11).random((CASES, 3), np.float32)
    with Loaded(library, stored("layered3-5x64")) as loaded:
        materials = loaded.prepare(params, cosines)
        drawn = loaded.sample(materials, wi, u)
        valid = drawn[:, 6] > 0
        assert valid.mean() > 0.9
        assert np.abs(np.linalg.norm(drawn[:, :3], axis=1) - 1)[valid].max() < 1e-5
        again = loaded.eval(materials, wi, np.ascontiguousarray(drawn[:, :3]))
    np.testing.assert_allclose(drawn[valid, 3:], again[valid], rtol=1e-6)


def test_samples_follow_the_density(library):
    """Chi-square tests of six materials in 24 x 48 bins of cos(theta) and azimuth, directions below the horizon in one
    of their own; a correct sampler fails one of them with a chance of 1e-3. For lobes of any width, and in double
    precision, tests/test_target_sampling.py tests the functions that this runtime repeats."""
    tests, parts = 6, 64
    params, cosines = queries(12)
    params, cosines = params[:tests], cosines[:tests]
    params[:, :2] = np.random.default_rng(13).uniform(0.1, 0.3, (tests, 2))
    wi = np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1).astype(np.float32)
    z, phi = ((np.arange(n * parts) + 0.5) / (n * parts) for n in (24, 48))
    z, phi = (x.ravel() for x in np.meshgrid(z, 2 * np.pi * phi, indexing="ij"))
    r = np.sqrt(1 - z * z)
    grid = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32)
    rng, samples = np.random.default_rng(14), len(grid) // 24
    with Loaded(library, stored("layered3-5x64")) as loaded:
        materials = loaded.prepare(params, cosines)
        for k in range(tests):
            material, own_wi = (np.repeat(x[k : k + 1], len(grid) // 24, 0) for x in (materials, wi))
            drawn = loaded.sample(material, own_wi, rng.random((samples, 3), np.float32))
            valid = drawn[:, 6] > 0
            azimuth = np.arctan2(drawn[:, 1], drawn[:, 0]) % (2 * np.pi)
            counts, *_ = np.histogram2d(drawn[valid, 2], azimuth[valid], (24, 48), ((0, 1), (0, 2 * np.pi)))
            parts_of_grid = (loaded.eval(material, own_wi, part)[:, 3] for part in np.split(grid, 24))
            density = np.concatenate(list(parts_of_grid))
            expected = density.astype(np.float64).reshape(24, parts, 48, parts).sum(axis=(1, 3))
            expected *= samples * 2 * np.pi / len(grid)
            found = np.append(counts.ravel(), (~valid).sum())
            wanted = np.append(expected.ravel(), samples - expected.sum())
            assert chi_square(found, wanted) > 1 - (1 - 1e-3) ** (1 / tests), k
            # With a density that is a tenth off at both ends it is not content.
            assert chi_square(found, wanted * np.linspace(0.9, 1.1, wanted.size)) < 1e-6


def chi_square(found, wanted):
    """The p-value; bins that expect fewer than ten are taken together."""
    few = wanted < 10
    found = np.append(found[~few], found[few].sum())
    wanted = np.append(wanted[~few], max(wanted[few].sum(), 1e-3))
    keep = wanted > 5
    statistic = ((found[keep] - wanted[keep]) ** 2 / wanted[keep]).sum()
    return chi2.sf(statistic, keep.sum() - 1)


def test_an_instruction_set_that_this_cpu_lacks_falls_back(library):
    absent = [name for name in SETS[1:] if name not in available(library)]
    assert absent, "no CPU has both NEON and AVX"
    with Loaded(library, stored("layered3-3x32"), absent[0]) as loaded:
        assert library.nma_instruction_set(loaded.handle) == 1
    message = ctypes.create_string_buffer(100)
    assert not library.nma_load(b"none", 6, message, ctypes.c_size_t(100))
    assert message.value == b"no such instruction set"


def changed(name, **fields):
    """A weights file whose metadata differ."""
    data = stored(name)
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    about = json.loads(header["__metadata__"]["nma"]) | fields
    header["__metadata__"]["nma"] = json.dumps(about)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


@pytest.mark.parametrize(
    "data, message",
    [
        (b"", "too short"),
        (stored("layered3-3x32")[:1000], "truncated"),
        (stored("layered3-3x32")[:-4], "does not lie within the file"),
        (b"\xff" * 100, "truncated"),
        (struct.pack("<Q", 2) + b"{}", "__metadata__"),
        (struct.pack("<Q", 3) + b'{"a', "open string"),
        (struct.pack("<Q", 60) + b"[" * 60, "nested too deep"),
        (changed("layered3-3x32", format=2), "format"),
        (changed("layered3-3x32", encoding="new"), "unknown input encoding 'new'"),
        (changed("layered3-3x32", dialect="cycles"), "dialect 'cycles'"),
        (changed("layered3-3x32", instances=1), "does not fit its description"),
        (changed("layered3-3x32", hidden=[32, 32, 31]), "hidden layers"),
        (changed("layered3-3x32", hidden="many"), "'hidden'"),
        (changed("layered3-3x32", target=[]), "does not fit its description"),
    ],
)
def test_files_that_make_no_sense_are_refused(library, data, message):
    with Loaded(library, data) as loaded:
        assert not loaded.handle.value
        assert message in loaded.message


def test_the_generated_headers_are_those_of_the_present_package():
    assert (ROOT / "runtime/nma/target.h").read_text() == cpp(), "run `python -m nma.export`"
    assert (ROOT / "runtime/nma/classes.h").read_text() == classes(), "run `python -m nma.export`"


def module_of(text, path: Path) -> ModuleType:
    path.write_text(textwrap.dedent(text))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_constructs_beyond_the_subset_are_refused_with_their_place(tmp_path, monkeypatch):
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
