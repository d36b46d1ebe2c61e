"""Plugins compiled for Mitsuba's scalar renderer against the vectorised ones, in processes of their own."""

import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from adapter_cases import random_anisotropic_adapter

import nma
from nma import encoding, native, network
from nma.errors import MissingDependencyError
from nma.image_io import write_exr, write_png

MATERIAL = {
    "alpha_top": 0.08,
    "alpha_bottom": 0.25,
    "eta_top": 1.5,
    "eta_conductor": {"type": "rgb", "value": [0.14, 0.37, 1.44]},
    "k_conductor": {"type": "rgb", "value": [3.98, 2.38, 1.6]},
    "albedo": {"type": "rgb", "value": [0.9, 0.3, 0.2]},
    "sigma_t": 0.5,
}
CHECKS = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.9, 0.2, 0.1]}, "color1": 0.3}
TEXTURED = MATERIAL | {
    "albedo": CHECKS,
    "alpha_bottom": {"type": "checkerboard", "color0": 0.1, "color1": 0.4},
}
# A ball under a bright sky and a lamp, seen so that all of the picture is the ball.
PROGRAM = """
    import json, sys
    import mitsuba as mi
    import numpy as np
    import nma.render

    variant, spp, *rest = json.loads(sys.argv[1])
    nma.render.use(variant)
    for seed, bsdf in enumerate(rest):
        look = mi.ScalarTransform4f().look_at([0, -3, 0], [0, 0, 0], [0, 0, 1])
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {"type": "perspective", "fov": 24, "to_world": look,
                       "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}},
            "sky": {"type": "constant", "radiance": 0.3},
            "lamp": {"type": "sphere", "center": [2, -3, 3], "radius": 1.0,
                     "emitter": {"type": "area", "radiance": 10.0}},
            "ball": {"type": "sphere", "bsdf": bsdf},
        })
        pictures = [np.array(mi.render(scene, spp=spp, seed=10 * seed + k)).mean(axis=(0, 1)) for k in range(6)]
        print(json.dumps(np.array(pictures).tolist()))
        ball, = (shape for shape in scene.shapes() if not shape.is_emitter())
        print(mi.has_flag(ball.bsdf().flags(), mi.BSDFFlags.Anisotropic))
"""


def tool():
    if shutil.which("c++") is None:
        pytest.skip("there is no C++ compiler here")


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Plugins are built once for all tests, not into the user's cache."""
    tool()
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield native.build_mitsuba()
    os.environ.pop("XDG_CACHE_HOME")
    if before is not None:
        os.environ["XDG_CACHE_HOME"] = before


def run(*words):
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM), json.dumps(words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def finished(variant, spp, *bsdfs):
    """The lines that it prints."""
    done = run(variant, spp, *bsdfs)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.splitlines()


def parsed(lines):
    """Mean colours (6, 3) of six renderings of each BSDF."""
    return [np.array(json.loads(line)) for line in lines if line.startswith("[[")]


def pictures(variant, spp, *bsdfs):
    return parsed(finished(variant, spp, *bsdfs))


def agree(a, b):
    """Means of two sets of six within 4.5 standard errors and 0.1 %: a false alarm in some ten thousand."""
    error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 6)
    return (np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4.5 * error + 1e-3 * b.mean(axis=0)).all()


def test_scalar_and_vectorised_plugins_render_the_same():
    bsdfs = [{"type": kind, **material} for material in (MATERIAL, TEXTURED) for kind in ("nma", "layered")]
    online = {"type": "nma", "online": True, "precision": "bfloat16", **MATERIAL}
    scalar = pictures("scalar_rgb", 32, *bsdfs, online)
    vectorised = pictures("llvm_ad_rgb", 128, *bsdfs)
    for mine, other in zip(scalar, vectorised, strict=False):
        assert agree(mine, other), (mine.mean(axis=0), other.mean(axis=0))
    assert agree(scalar[-1], vectorised[0])
    # Materials differ by more than that: the comparison can fail.
    assert not agree(scalar[0], vectorised[2])


def test_anisotropic_adapters_render_the_same_in_both(tmp_path):
    """And otherwise than one that is blind to the azimuth."""
    adapter = random_anisotropic_adapter()
    (matrix, bias), *rest = adapter.layers
    blind = dataclasses.replace(adapter, layers=[(matrix * np.float32([1, 0, 0, 0, 0]), bias), *rest])
    bsdfs = []
    for name, made in (("seeing", adapter), ("blind", blind)):
        made.save(tmp_path / f"{name}.safetensors")
        bsdfs.append({"type": "nma", "adapter": str(tmp_path / f"{name}.safetensors")})
    scalar, vectorised = finished("scalar_rgb", 32, bsdfs[0]), finished("llvm_ad_rgb", 128, *bsdfs)
    assert "True" in scalar and "True" in vectorised
    (mine,), (other, unseeing) = parsed(scalar), parsed(vectorised)
    assert agree(mine, other), (mine.mean(axis=0), other.mean(axis=0))
    assert not agree(mine, unseeing)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"sigma_t": 7.0}, "sigma_t is 7, allowed is 0 .. 1, the range"),
        ({"precision": "half"}, "precision is float32, compact or bfloat16, not 'half'"),
        ({"adapter": "none"}, "none: no such weights file"),
        ({"albedo": None}, "no value for albedo"),
        ({"material": "wet-nickel"}, "`material` is known in vectorised variants only"),
    ],
)
def test_bad_inputs_are_refused_with_their_name(change, message):
    bsdf = {k: v for k, v in {"type": "nma", **MATERIAL, **change}.items() if v is not None}
    done = run("scalar_rgb", 1, bsdf)
    assert done.returncode != 0
    assert message in done.stderr


@pytest.mark.parametrize(
    "pixel, extra, message",
    [
        (
            7.0,
            {},
            "the texture of sigma_t holds 7 at x=1, y=2, one of 3 such values of 36; allowed is 0 .. 1",
        ),
        (math.nan, {"clamp": True}, "the texture of sigma_t holds nan at x=1, y=2"),
        ([0.1, 0.2, 0.3], {}, "the texture of sigma_t is coloured"),
        (0.5, {"albedo": CHECKS | {"color1": 1.5}}, "the texture of albedo holds 1.5 at x=0, y=0"),
        (7.0, {"clamp": True}, None),
        (-1.0, {"type": "layered"}, "the texture of sigma_t holds -1 at x=1, y=2, one of 3"),
        (7.0, {"type": "layered"}, None),
    ],
)
def test_textures_are_checked_when_they_are_loaded(tmp_path, pixel, extra, message):
    image = np.ones((4, 3, 3))
    image[2, 1] = pixel
    texture = {"type": "bitmap", "filename": str(write_exr(tmp_path / "t.exr", image)), "raw": True}
    done = run("scalar_rgb", 1, {"type": "nma", **MATERIAL, "sigma_t": texture, **extra})
    assert message in done.stderr if message else done.returncode == 0


def test_bytes_are_checked_as_what_they_are_decoded_to(tmp_path):
    """sRGB 128 is .2158605 (IEC 61966-2-1), 128 / 255 where the texture is `raw`."""
    write_png(tmp_path / "t.png", np.full((2, 2, 3), 128, np.uint8))
    for raw, value in ((False, "0.21586"), (True, "0.501961")):
        texture = {"type": "bitmap", "filename": str(tmp_path / "t.png"), "raw": raw}
        done = run("scalar_rgb", 1, {"type": "nma", **MATERIAL, "eta_top": texture})
        assert f"the texture of eta_top holds {value}" in done.stderr


def test_the_executable_renders_a_scene(cache, tmp_path):
    executable = Path(sys.executable).parent / "mitsuba"
    inputs = "".join(
        f'<rgb name="{k}" value="{", ".join(map(str, v["value"]))}"/>'
        if isinstance(v, dict)
        else f'<float name="{k}" value="{v}"/>'
        for k, v in MATERIAL.items()
    )
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f"""<scene version="3.0.0">
            <integrator type="path"/>
            <sensor type="perspective">
                <transform name="to_world"><lookat origin="0,-3,0" target="0,0,0" up="0,0,1"/></transform>
                <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
                <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
            </sensor>
            <emitter type="constant"/>
            <shape type="sphere"><bsdf type="nma">{inputs}</bsdf></shape>
        </scene>"""
    )
    command = [executable, "-a", cache, "-m", "scalar_rgb", "-o", tmp_path / "out.exr", scene]
    done = subprocess.run([str(w) for w in command], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "out.exr").stat().st_size > 1000


def test_what_is_built_is_not_built_again(cache):
    said = []
    assert native.build_mitsuba(said.append) == cache
    assert "up to date" in said[0]
    assert {path.stem for path in (cache / "adapters").glob("*.safetensors")} == set(nma.shipped())


def test_without_a_compiler_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(MissingDependencyError, match="sudo apt-get install g"):
        native.compiler()


def test_what_the_compiler_says_is_passed_on(tmp_path):
    source = tmp_path / "broken.cpp"
    source.write_text("int main() { return nothing; }\n")
    with pytest.raises(native.BuildError, match="error: .nothing. was not declared|error: use of undeclared"):
        native._compile([source, "-o", tmp_path / "broken"], [])


def test_a_failed_build_leaves_nothing(tmp_path):
    def make(folder):
        (folder / "half").touch()
        raise native.BuildError("no")

    with pytest.raises(native.BuildError):
        native._whole(tmp_path / "made", make)
    assert not list(tmp_path.iterdir())


def test_python_reaches_the_batched_kernel(tmp_path):
    from nma.runtime import Runtime, available

    rng = np.random.default_rng(0)
    params, cosines = nma.LAYERED3.sample(rng, 500), rng.uniform(0.05, 1, 500)
    adapter = nma.Adapter.load("layered3-3x32")
    inputs = encoding.get(adapter.encoding)(list(params.T), cosines)
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
    again, density = runtime.eval(materials, wi, wo)
    np.testing.assert_allclose(again[pdf > 0], value[pdf > 0], rtol=1e-6)
    np.testing.assert_allclose(density[pdf > 0], pdf[pdf > 0], rtol=1e-6)
    # Rows that lie on no boundary of 16 bytes.
    shifted = np.empty(materials.size + 1, np.float32)[1:].reshape(materials.shape)
    shifted[:] = materials
    np.testing.assert_array_equal(runtime.eval(shifted, wi, wo)[0], again)

    with pytest.raises(nma.errors.WeightsError, match="no such weights file"):
        Runtime(tmp_path / "none.safetensors")
    with pytest.raises(nma.errors.ParamError, match="no instruction set 'mmx'"):
        Runtime("layered3-3x32", "mmx")
    with pytest.raises(nma.errors.ParamError, match=r"params wants shape \(n, 13\), got \(13,\)"):
        runtime.prepare(params[0], cosines[:1])
    with pytest.raises(nma.errors.ParamError, match="500 rows of params for 499 cosines"):
        runtime.prepare(params, cosines[1:])
