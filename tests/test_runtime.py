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
from target_cases import random_blend, random_directions, stacked

import nma
from nma import encoding, network, target
from nma.export.cpp import cpp, print_function
from nma.export.functions import Unsupported, parsed
from nma.ops import Vec3

ROOT = Path(__file__).parent.parent
FLAGS = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
CASES = 4000


@pytest.fixture(scope="module")
def library(compiler, tmp_path_factory):
    path = tmp_path_factory.mktemp("runtime") / "bridge.so"
    source = ROOT / "tests/runtime_bridge.cpp"
    command = [compiler, *FLAGS, f"-I{ROOT / 'runtime'}", "-shared", "-fPIC", source, "-o", path]
    subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(path))
    loaded.adapter_new.restype = ctypes.c_void_p
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
        random_blend(rng, CASES, count),
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
        p = columns[13 * k : 13 * k + 13]
        instances.append(target.Principled(Vec3(*p[:3]), *p[3:]))
    return target.Blend(tuple(instances), tuple(columns[26:]))


def test_samples_are_those_of_the_target(library):
    blend, wi, _ = cases(1)
    u = np.random.default_rng(2).random((CASES, 3))
    found = np.zeros((CASES, 7))
    numbers, i = flat(blend), rows(wi)
    library.sample_double(CASES, 2, *(pointer(x) for x in (numbers, i, u, found)))
    wo, value, pdf = target.sample(blend, wi, *u.T)
    np.testing.assert_allclose(found, np.stack([*wo, *value, pdf], axis=-1), rtol=1e-6, atol=1e-9)


class Loaded:
    """An adapter of the runtime."""

    def __init__(self, library, data: bytes):
        message = ctypes.create_string_buffer(500)
        self.library, self.handle = library, library.adapter_new(data, len(data), message, 500)
        self.message = message.value.decode()

    def __enter__(self):
        return self

    def __exit__(self, *args):
        if self.handle:
            self.library.adapter_delete(ctypes.c_void_p(self.handle))

    def outputs(self, params, cosines, size):
        found = np.zeros((len(params), size), np.float32)
        arguments = (pointer(x) for x in (params, cosines, found))
        self.library.adapter_outputs(ctypes.c_void_p(self.handle), len(params), size, *arguments)
        return found


def stored(name):
    return (ROOT / "nma/adapters" / f"{name}.safetensors").read_bytes()


@pytest.mark.parametrize("name", nma.shipped())
def test_network_outputs_agree(library, name):
    adapter, rng = nma.Adapter.load(name), np.random.default_rng(3)
    params = nma.LAYERED3.sample(rng, CASES).astype(np.float32)
    cosines = rng.random(CASES, np.float32)
    with Loaded(library, stored(name)) as loaded:
        found = loaded.outputs(params, cosines, adapter.size)
    inputs = encoding.get(adapter.encoding)(list(params.T.astype(np.float64)), cosines.astype(np.float64))
    wanted = network.forward(adapter.layers, np.stack(inputs, axis=-1))
    error = np.abs(found - wanted) / (1.0 + np.abs(wanted))
    # Some inputs, where the conductor's Fresnel term cancels, are off by more than the rounding of the network itself.
    assert np.quantile(error, 0.999) < 1e-5
    assert error.max() < 2e-4


def test_an_adapter_evaluates_like_the_package(library):
    adapter, rng = nma.Adapter.load("layered3-3x32"), np.random.default_rng(4)
    params = nma.LAYERED3.sample(rng, CASES).astype(np.float32)
    wi, wo = (rows(random_directions(rng, CASES)).astype(np.float32) for _ in range(2))
    found = np.zeros((CASES, 4), np.float32)
    with Loaded(library, stored("layered3-3x32")) as loaded:
        arguments = (pointer(x) for x in (params, wi, wo, found))
        library.adapter_evaluate(ctypes.c_void_p(loaded.handle), CASES, *arguments)
    value, pdf = target.eval_pdf(adapter.prepare(list(params.T), wi.T[2]), Vec3(*wi.T), Vec3(*wo.T))
    # Errors of the network's outputs, 1e-5, are multiplied by sharp lobes.
    np.testing.assert_allclose(found, np.stack([*value, pdf], axis=-1), rtol=2e-3, atol=1e-5)


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
        assert not loaded.handle
        assert message in loaded.message


def test_the_generated_header_is_that_of_the_present_target():
    assert (ROOT / "runtime/nma/target.h").read_text() == cpp(), "run `python -m nma.export`"


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


def test_the_example_compiles_and_runs(compiler, tmp_path):
    program = tmp_path / "example"
    source, include = ROOT / "runtime/example.cpp", f"-I{ROOT / 'runtime'}"
    assert len(source.read_text().splitlines()) < 100
    subprocess.run([compiler, *FLAGS, include, source, "-o", program], check=True)
    run = subprocess.run(
        [program, ROOT / "nma/adapters/layered3-5x64.safetensors"], capture_output=True, text=True
    )
    albedos = [[float(x) for x in line.split()[1:]] for line in run.stdout.splitlines()[1:]]
    assert np.shape(albedos) == (5, 3)
    assert 0.1 < np.min(albedos) < np.max(albedos) < 1.0
    missing = subprocess.run([program, tmp_path / "none"], capture_output=True, text=True)
    assert missing.returncode == 1
    assert missing.stderr == f"{tmp_path / 'none'}: no such weights file, or it cannot be read\n"
