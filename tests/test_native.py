"""Compiling the runtime: plugins and shared library are built once and atomically, and errors say what is missing."""

from types import SimpleNamespace

import numpy as np
import pytest
from scalar_cases import plugins

import nma.render
from nma import network
from nma.adapter import encoding
from nma.errors import MissingDependencyError, ParamError
from nma.native import build
from nma.ops import at_azimuth_0
from nma.render import register


@pytest.fixture(scope="module")
def cache():
    return plugins()


@pytest.mark.slow
def test_what_is_built_is_not_built_again(cache):
    said = []
    assert build.build_mitsuba(said.append) == cache
    assert "up to date" in said[0]
    assert {path.stem for path in (cache / "adapters").glob("*.safetensors")} == set(nma.shipped())


def test_without_a_compiler_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(MissingDependencyError, match="sudo apt-get install g"):
        build.compiler()


@pytest.mark.parametrize(
    "platform, suffix, flag",
    [("linux", ".so", "-Wl,--allow-shlib-undefined"), ("darwin", ".dylib", "-Wl,-undefined,dynamic_lookup")],
)
def test_plugins_are_named_and_linked_as_the_platform_wants(monkeypatch, tmp_path, platform, suffix, flag):
    compiled = []
    monkeypatch.setattr(build.sys, "platform", platform)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(build, "_compile", lambda words, flags: compiled.append((words[-1].name, flags[-1])))
    build.build_mitsuba()
    assert compiled == [(f"nma{suffix}", flag), (f"layered{suffix}", flag)]
    assert build.shared_library().name == f"nma_c{suffix}"


def test_windows_is_refused_in_one_line(monkeypatch, tmp_path):
    monkeypatch.setattr(build.sys, "platform", "win32")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for compiles in (build.build_mitsuba, build.shared_library):
        with pytest.raises(build.BuildError, match="cannot be compiled on Windows, .* WSL") as e:
            compiles()
        assert "\n" not in str(e.value)


def test_what_the_compiler_says_is_passed_on(tmp_path):
    source = tmp_path / "broken.cpp"
    source.write_text("int main() { return nothing; }\n")
    with pytest.raises(build.BuildError, match="error: .nothing. was not declared|error: use of undeclared"):
        build._compile([source, "-o", tmp_path / "broken"], [])


@pytest.mark.slow
def test_python_reaches_the_functions_for_batches(tmp_path):
    from nma.native.runtime import Runtime, available

    rng = np.random.default_rng(0)
    params, cosines = nma.LAYERED3.sample(rng, 500), rng.uniform(0.05, 1, 500)
    adapter = nma.Adapter.load("layered3-3x32")
    inputs = encoding.get(adapter.encoding)(list(params.T), at_azimuth_0(cosines))
    wanted = network.forward(adapter.layers, np.stack(inputs, axis=-1))
    for name in available():
        runtime = Runtime("layered3-3x32", name)
        assert runtime.instruction_set == name
        error = np.abs(runtime.outputs(params, cosines) - wanted)
        assert np.median(error) < (0.05 if name == "avx512_bf16" else 1e-5)
    runtime = Runtime("layered3-3x32")
    materials = runtime.prepare(params, cosines)
    wi = np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)
    wo, value, pdf = runtime.sample(materials, wi, rng.random((500, 3)))
    again, density = runtime.eval_pdf(materials, wi, wo)
    np.testing.assert_allclose(again[pdf > 0], value[pdf > 0], rtol=1e-6)
    np.testing.assert_allclose(density[pdf > 0], pdf[pdf > 0], rtol=1e-6)
    # The rows of `shifted` are not aligned to 16 bytes.
    shifted = np.empty(materials.size + 1, np.float32)[1:].reshape(materials.shape)
    shifted[:] = materials
    np.testing.assert_array_equal(runtime.eval_pdf(shifted, wi, wo)[0], again)

    with pytest.raises(nma.errors.WeightsError, match="no such weights file"):
        Runtime(tmp_path / "none.safetensors")
    with pytest.raises(nma.errors.ParamError, match="unknown instruction set 'mmx'; known are fastest, "):
        Runtime("layered3-3x32", "mmx")
    with pytest.raises(nma.errors.ParamError, match=r"params must have shape \(n, 13\), got \(13,\)"):
        runtime.prepare(params[0], cosines[:1])
    with pytest.raises(nma.errors.ParamError, match="params has 500 rows, but wi has 499 cosines"):
        runtime.prepare(params, cosines[1:])


def test_beside_compiled_plugins_the_other_bsdfs_are_refused_with_advice(monkeypatch, tmp_path):
    """In scalar_rgb, `nma` and `layered` are compiled, and `values` says which variant it needs."""
    registered = {}
    nma.render.use("llvm_ad_rgb")  # without a variant, Mitsuba has no `register_bsdf`
    monkeypatch.setattr("mitsuba.register_bsdf", registered.__setitem__)
    monkeypatch.setattr(register, "_add_resource", lambda folder: None)
    monkeypatch.setattr(build, "has_mitsuba_plugins", lambda: True)
    register._on_variant(None, "scalar_rgb")
    assert set(registered) == set(register.PLUGINS) - set(build.PLUGINS) == {"values"}
    with pytest.raises(
        ParamError, match="BSDF 'values' runs in .*not in scalar_rgb.*mi.set_variant"
    ) as caught:
        registered["values"](SimpleNamespace(plugin_name=lambda: "values"))
    assert "mitsuba build" not in str(caught.value)
    monkeypatch.setattr(build, "has_mitsuba_plugins", lambda: False)
    register._on_variant(None, "scalar_rgb")
    assert set(registered) == set(register.PLUGINS)
    with pytest.raises(ParamError, match="`nma mitsuba build`"):
        registered["nma"](SimpleNamespace(plugin_name=lambda: "nma"))
