"""Plugins compiled for Mitsuba's scalar renderer: pictures, alone and in composites, inputs, edits, attributes."""

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from adapter_cases import random_adapter, random_anisotropic_adapter
from scalar_cases import MATERIAL, finished, own_cache

from nma.image_io import write_exr, write_png

CHECKS = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.9, 0.2, 0.1]}, "color1": 0.3}
TEXTURED = MATERIAL | {
    "albedo": CHECKS,
    "alpha_bottom": {"type": "checkerboard", "color0": 0.1, "color1": 0.4},
}
# A ball, or a plate, under a bright sky and a lamp, which fills the picture. Prints the mean colours of renderings
# of each BSDF.
PICTURES = """
    spp, count, shape, *bsdfs = words
    for seed, bsdf in enumerate(bsdfs):
        look = mi.ScalarTransform4f().look_at([0, -3, 0], [0, 0, 0], [0, 0, 1])
        tilted = mi.ScalarTransform4f().rotate([1, 0, 0], 50).scale(50)
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {"type": "perspective", "fov": 24, "to_world": look,
                       "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}},
            "sky": {"type": "constant", "radiance": 0.3},
            "lamp": {"type": "sphere", "center": [2, -3, 3], "radius": 1.0,
                     "emitter": {"type": "area", "radiance": 10.0}},
            "seen": {"type": shape, "bsdf": bsdf} | ({"to_world": tilted} if shape == "rectangle" else {}),
        })
        pictures = [np.array(mi.render(scene, spp=spp, seed=count * seed + k)).mean(axis=(0, 1)) for k in range(count)]
        print(json.dumps(np.array(pictures).tolist()))
        seen, = (shape for shape in scene.shapes() if not shape.is_emitter())
        print(mi.has_flag(seen.bsdf().flags(), mi.BSDFFlags.Anisotropic))
"""


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with own_cache(tmp_path_factory) as folder:
        yield folder


def parsed(lines):
    """Mean colours (renderings, 3) of each BSDF."""
    return [np.array(json.loads(line)) for line in lines if line.startswith("[[")]


def pictures(variant, spp, *bsdfs):
    return parsed(finished(PICTURES, variant, spp, 6, "sphere", *bsdfs))


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
    scalar = finished(PICTURES, "scalar_rgb", 32, 6, "sphere", bsdfs[0])
    vectorised = finished(PICTURES, "llvm_ad_rgb", 128, 6, "sphere", *bsdfs)
    assert "True" in scalar and "True" in vectorised
    (mine,), (other, unseeing) = parsed(scalar), parsed(vectorised)
    assert agree(mine, other), (mine.mean(axis=0), other.mean(axis=0))
    assert not agree(mine, unseeing)


def blend(weight, first, second):
    return {"type": "blendbsdf", "weight": weight, "first": first, "second": second}


def mask(opacity, bsdf):
    return {"type": "mask", "opacity": opacity, "inside": bsdf}


def test_composites_are_the_linear_combinations_of_what_they_hold():
    """Of a plate before the sky. Z-tests of 24 means within 5 standard errors, estimated from 32 renderings: a false
    alarm in two thousand."""
    layered, nma, diffuse = {"type": "layered", **MATERIAL}, {"type": "nma", **MATERIAL}, {"type": "diffuse"}
    flat = {"type": "normalmap", "normalmap": {"type": "srgb", "color": [0.5, 0.5, 1.0]}}
    # Each with what it holds of layered, nma, diffuse and the sky.
    composites = {
        "blend": (blend(0.3, layered, diffuse), (0.7, 0, 0.3, 0)),
        "mask": (mask(0.6, layered), (0.6, 0, 0, 0.4)),
        "twosided": ({"type": "twosided", "inside": layered}, (1, 0, 0, 0)),
        "two of ours": ({"type": "twosided", "inside": blend(0.5, nma, layered)}, (0.5, 0.5, 0, 0)),
        "nested": (blend(0.5, mask(0.6, layered), blend(0.4, diffuse, layered)), (0.5, 0, 0.3, 0.2)),
        "nma": (mask(0.6, blend(0.5, nma, diffuse)), (0, 0.3, 0.3, 0.4)),
        "alone": (layered, (1, 0, 0, 0)),
        "normalmap": ({**flat, "inside": layered}, (1, 0, 0, 0)),
    }
    bsdfs = [layered, nma, diffuse, *(bsdf for bsdf, _ in composites.values())]
    found = parsed(finished(PICTURES, "scalar_rgb", 8, 32, "rectangle", *bsdfs))
    means = np.array([x.mean(axis=0) for x in found])
    variances = np.array([x.var(axis=0, ddof=1) / len(x) for x in found])
    sky = np.full((1, 3), 0.3)
    parts, noise = np.concatenate([means[:3], sky]), np.concatenate([variances[:3], 0 * sky])
    for (name, (_, shares)), mean, variance in zip(composites.items(), means[3:], variances[3:], strict=True):
        wanted, error = np.dot(shares, parts), np.sqrt(variance + np.dot(np.square(shares), noise))
        assert (np.abs(mean - wanted) < 5 * error).all(), (name, mean / wanted - 1, error / wanted)
        assert (error < 0.01 * wanted).all(), name


def test_diffuse_reflectance_is_the_directional_albedo(tmp_path):
    """Against means of 20,000 samples; the same for equal arguments, at most 1, and none from behind."""
    random_anisotropic_adapter().save(tmp_path / "brushed.safetensors")
    finished(
        """
        rng = np.random.default_rng(0)
        for kind, tolerance, bsdf in zip(("nma", "layered", "nma"), (0.02, 0.1, 0.05), words):
            bsdf = mi.load_dict(bsdf)
            for cosine, azimuth in ((1.0, 0.0), (0.5, 0.0), (0.3, 1.0)):
                si = interaction(cosine, azimuth)
                found = np.array(bsdf.eval_diffuse_reflectance(si))
                drawn = [bsdf.sample(mi.BSDFContext(), si, u[0], u[1:])[1] for u in rng.random((20_000, 3))]
                assert (np.abs(np.mean(drawn, axis=0) - found) < tolerance).all(), (kind, cosine, found)
                assert (found == bsdf.eval_diffuse_reflectance(si)).all() and found.max() <= 1
            assert np.array(bsdf.eval_diffuse_reflectance(interaction(-0.5))).max() == 0
        """,
        "scalar_rgb",
        {"type": "nma", **MATERIAL},
        {"type": "layered", **MATERIAL},
        {"type": "nma", "adapter": str(tmp_path / "brushed.safetensors")},
    )


EDITS = """
    wo = [0.0, -0.6, 0.8]

    def look(bsdf):
        return np.array(bsdf.eval(mi.BSDFContext(), interaction(0.7), wo))

    kind, material, pixels = words
    material = {"type": kind, **material}
    image = np.array(pixels, np.float32)
    texture = lambda: {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True}
"""


@pytest.mark.parametrize("kind", ["nma", "layered"])
def test_edits_are_rendered_at_once_or_refused(kind):
    """Numbers, colours, pixels; after a refused edit nothing is rendered until it is mended."""
    finished(
        EDITS
        + """
    bsdf = mi.load_dict(material)
    params = mi.traverse(bsdf)
    assert set(params.keys()) == set(material) - {"type"}, params
    for key, value, other in (("sigma_t", 0.9, {"sigma_t": 0.9}),
                              ("albedo", [0.2, 0.4, 0.6], {"albedo": {"type": "rgb", "value": [0.2, 0.4, 0.6]}})):
        params[key] = value
        params.update()
        material |= other
        assert (look(bsdf) == look(mi.load_dict(material))).all(), key
    before = look(bsdf)
    for key, bad, good in (("albedo", [0.2, 3.0, 0.6], [0.2, 0.4, 0.6]), ("sigma_t", float("nan"), 0.9)):
        params[key] = bad
        assert (look(bsdf) == before).all(), "rendered before it was checked"
        assert f"{key} is " in refusal(params.update)
        assert f"{key} is " in refusal(lambda: look(bsdf))
        params[key] = good
        params.update()
        assert (look(bsdf) == before).all(), key

    bsdf = mi.load_dict(material | {"albedo": texture()})
    params = mi.traverse(bsdf)
    assert "albedo.data" in params, params
    params["albedo.data"] = mi.TensorXf(0.5 * np.ones_like(image))
    params.update()
    np.testing.assert_allclose(look(bsdf), look(mi.load_dict(material | {"albedo": 0.5})), rtol=0.02)
    params["albedo.data"] = mi.TensorXf(np.where(image == image[1, 2], 3.0, image))
    assert "the texture of albedo holds 3 at x=2, y=1" in refusal(params.update)
    assert "the texture of albedo holds 3" in refusal(lambda: look(bsdf))
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
                          "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
                          "ball": {"type": "sphere", "center": [0, 0, 3], "bsdf": bsdf}})
    assert "the texture of albedo holds 3" in refusal(lambda: mi.render(scene, spp=1))
    params["albedo.data"] = mi.TensorXf(image)
    params.update()
    assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
        """,
        "scalar_rgb",
        kind,
        MATERIAL,
        np.linspace(0.1, 0.9, 60).reshape(4, 5, 3).tolist(),
    )


@pytest.mark.parametrize("kind", ["nma", "layered"])
def test_edits_of_shared_textures_are_seen(kind):
    """Mitsuba does not tell the second of two owners."""
    finished(
        EDITS
        + """
    shared = {"type": "ref", "id": "shared"}
    for about, leaf, bad in (({"type": "srgb", "color": [0.1, 0.5, 0.9]}, ".value", mi.Color3f(3.0)),
                             (texture(), ".data", mi.TensorXf(3 * np.ones_like(image)))):
        scene = mi.load_dict({"type": "scene", "shared": about,
                              "far": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": shared}},
                              "ball": {"type": "sphere", "bsdf": material | {"albedo": shared}}})
        bsdf = scene.shapes()[1].bsdf()
        assert "albedo" in str(bsdf)
        params = mi.traverse(scene)
        key, = (k for k in params.keys() if k.endswith(leaf))
        params[key] = mi.Color3f(0.3) if leaf == ".value" else mi.TensorXf(0.3 * np.ones_like(image))
        params.update()
        np.testing.assert_allclose(look(bsdf), look(mi.load_dict(material | {"albedo": 0.3})), rtol=0.02)
        params[key] = bad
        try:
            params.update()
        except RuntimeError:
            pass
        assert "the texture of albedo holds 3, allowed is 0 .. 1" in refusal(lambda: look(bsdf))
        """,
        "scalar_rgb",
        kind,
        MATERIAL,
        np.linspace(0.1, 0.9, 60).reshape(4, 5, 3).tolist(),
    )


@pytest.mark.parametrize("kind", ["nma", "layered"])
def test_attributes_and_channels_of_inputs(kind):
    finished(
        EDITS
        + """
    packed = mi.load_dict(material | {"sigma_t": texture(), "sigma_t_channel": "g", "albedo": texture()})
    si = interaction(0.7)
    si.uv = [2.5 / 5, 1.5 / 4]
    pixel = image[1, 2]
    assert packed.has_attribute("sigma_t") and not packed.has_attribute("roughness")
    for name, wanted in (("sigma_t", [pixel[1]] * 3), ("albedo", pixel), ("alpha_top", [material["alpha_top"]] * 3)):
        for found in (packed.eval_attribute(name, si), packed.eval_attribute_3(name, si)):
            np.testing.assert_allclose(np.array(found), wanted, rtol=1e-5)
        np.testing.assert_allclose(packed.eval_attribute_1(name, si), np.mean(wanted), rtol=1e-5)
    assert "Invalid attribute requested roughness" in refusal(lambda: packed.eval_attribute("roughness", si))
    grey = material | {"sigma_t": float(pixel[1]), "albedo": {"type": "rgb", "value": [float(c) for c in pixel]}}
    grey = mi.load_dict(grey | ({"online": True} if kind == "nma" else {}))
    look = lambda bsdf: np.array(bsdf.eval(mi.BSDFContext(), si, wo))
    np.testing.assert_allclose(look(packed), look(grey), rtol=1e-4)
        """,
        "scalar_rgb",
        kind,
        MATERIAL,
        np.linspace(0.1, 0.9, 60).reshape(4, 5, 3).tolist(),
    )


@pytest.fixture(scope="module")
def bitmap(tmp_path_factory):
    """Textures of ones by the value of their pixel at x=1, y=2."""
    folder = tmp_path_factory.mktemp("textures")

    def made(pixel):
        image = np.ones((4, 3, 3))
        image[2, 1] = pixel
        path = write_exr(folder / f"{len(list(folder.iterdir()))}.exr", image)
        return {"type": "bitmap", "filename": str(path), "raw": True}

    return made


def png(folder, raw):
    path = folder / f"{raw}.png"
    write_png(path, np.full((2, 2, 3), 128, np.uint8))
    return {"type": "bitmap", "filename": str(path), "raw": raw}


COLOUR = {"type": "rgb", "value": [0.1, 0.5, 0.9]}


def test_what_an_input_may_not_be_is_refused_with_its_name(bitmap, tmp_path):
    """Numbers of sRGB 128: .2158605 (IEC 61966-2-1), 128 / 255 where the texture is `raw`."""
    one = str(tmp_path / "one.safetensors")
    known = [
        x for value in MATERIAL.values() for x in (value["value"] if isinstance(value, dict) else [value])
    ]
    adapter = random_adapter(hidden="1x8", name="direction")
    dataclasses.replace(adapter, training={"params": known}).save(one)
    coloured, shared = bitmap([0.1, 0.2, 0.3]), {"type": "srgb", "color": [0.1, 0.5, 0.9]}
    cases = [
        ({"sigma_t": 7.0}, "sigma_t is 7, allowed is 0 .. 1, the range"),
        ({"precision": "half"}, "precision is float32, compact or bfloat16, not 'half'"),
        ({"adapter": "none"}, "none: no such weights file"),
        ({"albedo": None}, "no value for albedo"),
        ({"material": "wet-nickel"}, "`material` is known in vectorised variants only"),
        (
            {"sigma_t": bitmap(7.0)},
            "sigma_t holds 7 at x=1, y=2, one of 3 such values of 36; allowed is 0 .. 1",
        ),
        ({"sigma_t": bitmap(math.nan), "clamp": True}, "the texture of sigma_t holds nan at x=1, y=2"),
        ({"sigma_t": coloured}, "the texture of sigma_t is coloured, and sigma_t is one number per pixel"),
        ({"sigma_t": coloured}, "choose a channel: set `sigma_t_channel` to r, g or b"),
        ({"sigma_t": coloured, "sigma_t_channel": "g"}, None),
        ({"sigma_t": bitmap([7, 0.5, 0]), "sigma_t_channel": "g"}, None),
        (
            {"sigma_t": bitmap([0, 7, 0]), "sigma_t_channel": "g"},
            "holds 7 at x=1, y=2, one of 1 such values of 12",
        ),
        ({"sigma_t": coloured, "sigma_t_channel": "a"}, "sigma_t_channel is 'a'; take r, g or b"),
        ({"sigma_t_channel": "g"}, "sigma_t_channel chooses a channel of a texture"),
        ({"albedo_channel": "g"}, "albedo_channel chooses a channel of a texture"),
        ({"albedo": CHECKS | {"color1": 1.5}}, "the texture of albedo holds 1.5, one of 1"),
        ({"sigma_t": COLOUR}, "sigma_t wants one number or a texture, got the colour 0.1, 0.5, 0.9"),
        ({"sigma_t": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}, None),
        ({"sigma_t": shared}, "the texture of sigma_t is coloured"),
        ({"sigma_t": shared, "sigma_t_channel": "b"}, None),
        ({"sigma_t": bitmap(7.0), "clamp": True}, None),
        (
            {"sigma_t": bitmap(-1.0), "type": "layered"},
            "the texture of sigma_t holds -1 at x=1, y=2, one of 3",
        ),
        ({"sigma_t": bitmap(7.0), "type": "layered"}, None),
        ({"adapter": one, "sigma_t": 0.5}, None),
        ({"adapter": one, **dict.fromkeys(MATERIAL)}, None),
        ({"adapter": one, "sigma_t": 0.6}, "knows a single material, whose sigma_t is 0.5, not 0.6"),
        ({"adapter": one, "sigma_t": bitmap(0.5)}, "so that no texture can drive sigma_t"),
        ({"eta_top": png(tmp_path, False)}, "the texture of eta_top holds 0.21586 at x=0, y=0"),
        ({"eta_top": png(tmp_path, True)}, "the texture of eta_top holds 0.501961"),
        (
            {"eta_top": png(tmp_path, True)},
            'its pixels are bytes, 0 to 1; with `format` "variant" a bitmap keeps',
        ),
    ]
    bsdfs = [
        {k: v for k, v in {"type": "nma", **MATERIAL, **change}.items() if v is not None}
        for change, _ in cases
    ]
    said = finished(
        """
        for bsdf in words:
            try:
                mi.load_dict(bsdf)
                print("loads")
            except RuntimeError as error:
                print(" ".join(str(error).split()))
        """,
        "scalar_rgb",
        *bsdfs,
    )
    for (change, message), line in zip(cases, said, strict=True):
        assert (message or "loads") in line, change


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
