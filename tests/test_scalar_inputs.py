"""The compiled plugins for Mitsuba's scalar renderer check inputs, render edits, and return inputs as attributes."""

import dataclasses
import math

import numpy as np
import pytest
from adapter_cases import random_adapter
from material_cases import GREYS
from scalar_cases import CHECKS, MATERIAL, finished, plugins

from nma.images.io import write_exr, write_png

# The tests are slow, because a fixture compiles the plugins, and each test runs Mitsuba in processes of its own.
pytestmark = [pytest.mark.slow]


@pytest.fixture(scope="module", autouse=True)
def cache():
    return plugins()


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
    """An edit of a number, a colour or pixels takes effect at once. A bad value is refused.

    After a refused edit, nothing is rendered until a correct value replaces the wrong value.
    """
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
    assert "the texture of albedo at x=2, y=1: albedo is 3" in refusal(params.update)
    assert "the texture of albedo at x=2, y=1: albedo is 3" in refusal(lambda: look(bsdf))
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
                          "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
                          "ball": {"type": "sphere", "center": [0, 0, 3], "bsdf": bsdf}})
    assert "the texture of albedo at x=2, y=1: albedo is 3" in refusal(lambda: mi.render(scene, spp=1))
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
    """A BSDF sees edits of a texture that two BSDFs share, although Mitsuba notifies only one of the two."""
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
        assert "the texture of albedo: albedo is 3, allowed is 0 .. 1" in refusal(lambda: look(bsdf))
        """,
        "scalar_rgb",
        kind,
        MATERIAL,
        np.linspace(0.1, 0.9, 60).reshape(4, 5, 3).tolist(),
    )


@pytest.mark.parametrize("kind", ["nma", "layered"])
def test_inputs_are_attributes_and_may_come_from_one_channel(kind):
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


def test_the_back_and_lobes_that_nobody_asks_for_are_black():
    """All methods return zeros for the back, and for contexts without glossy reflection or with another component."""
    finished(
        """
    rest, other = mi.BSDFContext(), mi.BSDFContext()
    rest.type_mask = +mi.BSDFFlags.DiffuseReflection
    other.component = 1
    wo, u = [0.0, -0.6, 0.8], (0.01, [0.4, 0.6])

    def numbers(bsdf, ctx, si):
        values = [bsdf.eval(ctx, si, wo), bsdf.pdf(ctx, si, wo), *bsdf.eval_pdf(ctx, si, wo)]
        value, pdf, drawn, weight = bsdf.eval_pdf_sample(ctx, si, wo, *u)
        for bs, w in (bsdf.sample(ctx, si, *u), (drawn, weight)):
            values += [bs.pdf, w]
        return [np.array(x).max() for x in (*values, value, pdf)]

    for kind in ("nma", "layered"):
        bsdf = mi.load_dict({"type": kind, **words[0]})
        front = numbers(bsdf, mi.BSDFContext(), interaction(0.7))
        assert min(front) > 0, (kind, front)
        for ctx, cosine in ((rest, 0.7), (other, 0.7), (mi.BSDFContext(), -0.7)):
            assert not any(numbers(bsdf, ctx, interaction(cosine))), (kind, ctx, cosine)
        """,
        "scalar_rgb",
        MATERIAL,
    )


def test_estimates_at_different_points_are_independent():
    """`layered` derives the random numbers of `eval` from each number of the point, of its uv and of the directions."""
    finished(
        """
    bsdf = mi.load_dict({"type": "layered", **words[0]})
    points = [interaction(0.7) for _ in range(6)]
    for k, si in enumerate(points):
        numbers = 1.0 * (np.arange(5) == k - 1)
        si.p, si.uv = numbers[:3], numbers[3:]
    values = [np.array(bsdf.eval(mi.BSDFContext(), si, [0.0, -0.6, 0.8])).tolist() for si in points * 2]
    assert values[:6] == values[6:]
    assert len(set(map(tuple, values))) == 6, values
        """,
        "scalar_rgb",
        MATERIAL,
    )


PLATE = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float r
property float g
property float b
element face 1
property list uchar int vertex_index
end_header
-9 -9 0 3 3 3
9 -9 0 3 3 3
0 9 0 3 3 3
3 0 1 2
"""


@pytest.mark.parametrize("kind", ["nma", "layered"])
def test_attributes_of_a_mesh_are_clamped_to_the_range(kind, tmp_path):
    """Vertex colours above the range of a parameter render like the constant 1, alone and inside a checkerboard.

    Vertex colours cannot be checked when the BSDF is loaded, because only the mesh has their values.
    """
    (tmp_path / "plate.ply").write_text(PLATE)
    colours = {"type": "mesh_attribute", "name": "vertex_color"}
    finished(
        """
    path, *bsdfs = words
    pictures = []
    for bsdf in bsdfs:
        look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
        film = {"type": "hdrfilm", "width": 4, "height": 4}
        scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"},
                              "sensor": {"type": "perspective", "fov": 10, "to_world": look, "film": film},
                              "plate": {"type": "ply", "filename": path, "bsdf": bsdf}})
        pictures.append(np.array(mi.render(scene, spp=64, seed=1)))
    assert pictures[0].max() > 0
    np.testing.assert_allclose(pictures[0], pictures[1], rtol=1e-3)
    np.testing.assert_allclose(pictures[0], pictures[2], rtol=1e-3)
        """,
        "scalar_rgb",
        str(tmp_path / "plate.ply"),
        *(
            {"type": kind, **MATERIAL, "albedo": albedo} | ({"online": True} if kind == "nma" else {})
            for albedo in (1.0, colours, {"type": "checkerboard", "color0": colours, "color1": colours})
        ),
    )


@pytest.fixture(scope="module")
def bitmap(tmp_path_factory):
    """A function that writes an image of ones, with a given pixel at x=1, y=2, and returns its texture."""
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


def test_a_wrong_input_is_refused_with_its_name(bitmap, tmp_path):
    """A wrong input is refused with an error message that names the input, and a correct input is accepted.

    The sRGB byte 128 is .2158605 in linear light (IEC 61966-2-1), and 128 / 255 if the texture is `raw`.
    """
    one = str(tmp_path / "one.safetensors")
    known = [
        x for value in MATERIAL.values() for x in (value["value"] if isinstance(value, dict) else [value])
    ]
    adapter = random_adapter(hidden="1x8", name="direction")
    dataclasses.replace(adapter, training={"params": known}).save(one)
    coloured, shared = bitmap([0.1, 0.2, 0.3]), {"type": "srgb", "color": [0.1, 0.5, 0.9]}
    cases = [
        ({"sigma_t": 7.0}, "sigma_t is 7, allowed is 0 .. 1, the range"),
        ({"sigma_t": math.nan}, "sigma_t is nan, allowed is 0 .. 1"),
        ({"precision": "half"}, "precision must be float32, compact or bfloat16, not 'half'"),
        ({"adapter": "none"}, "none: no such weights file"),
        ({"albedo": None}, "no value for albedo"),
        ({"material": "wet-nickel"}, "only vectorised variants have the property `material`"),
        (
            {"sigma_t": bitmap(7.0)},
            "the texture of sigma_t at x=1, y=2: sigma_t is 7, allowed is 0 .. 1, the range",
        ),
        ({"sigma_t": bitmap(math.nan), "clamp": True}, "the texture of sigma_t at x=1, y=2: sigma_t is nan"),
        ({"sigma_t": coloured}, "the texture of sigma_t is coloured, and sigma_t is one number per pixel"),
        ({"sigma_t": coloured}, "choose a channel: set `sigma_t_channel` to r, g or b"),
        *(
            ({"type": "layered", "sigma_t": bitmap(pixel)}, "sigma_t is coloured" if refused else None)
            for pixel, refused in GREYS
        ),
        ({"sigma_t": coloured, "sigma_t_channel": "g"}, None),
        ({"sigma_t": bitmap([7, 0.5, 0]), "sigma_t_channel": "g"}, None),
        (
            {"sigma_t": bitmap([0, 7, 0]), "sigma_t_channel": "g"},
            "at x=1, y=2: sigma_t is 7, allowed",
        ),
        ({"sigma_t": coloured, "sigma_t_channel": "a"}, "sigma_t_channel is 'a'; choose r, g or b"),
        ({"sigma_t_channel": "g"}, "sigma_t_channel chooses a channel of a texture"),
        ({"albedo_channel": "g"}, "albedo_channel chooses a channel of a texture"),
        ({"albedo": CHECKS | {"color1": 1.5}}, "the texture of albedo: albedo is 1.5, allowed"),
        ({"sigma_t": COLOUR}, "sigma_t needs one number or a texture, got the colour 0.1, 0.5, 0.9"),
        ({"sigma_t": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}, None),
        ({"albedo": [0.1, 0.5, 0.9]}, None),
        ({"albedo": [0.1, 1.5, 0.9]}, "albedo is 0.1, 1.5, 0.9, allowed is 0 .. 1"),
        ({"sigma_t": shared}, "the texture of sigma_t is coloured"),
        ({"sigma_t": shared, "sigma_t_channel": "b"}, None),
        ({"sigma_t": bitmap(7.0), "clamp": True}, None),
        (
            {"sigma_t": bitmap(-1.0), "type": "layered"},
            "the texture of sigma_t at x=1, y=2: sigma_t is -1, allowed is 0 .. 1000; choose a value",
        ),
        ({"sigma_t": bitmap(7.0), "type": "layered"}, None),
        ({"adapter": one, "sigma_t": 0.5}, None),
        ({"adapter": one, **dict.fromkeys(MATERIAL)}, None),
        (
            {"adapter": one, "sigma_t": 0.6},
            "was trained for a single material, whose sigma_t is 0.5, not 0.6",
        ),
        ({"adapter": one, "sigma_t": bitmap(0.5)}, "so sigma_t cannot be textured"),
        (
            {"eta_top": png(tmp_path, False)},
            "the texture of eta_top at x=0, y=0, the first of 4 such pixels: eta_top is 0.21586",
        ),
        (
            {"eta_top": png(tmp_path, True)},
            "the texture of eta_top at x=0, y=0, the first of 4 such pixels: eta_top is 0.5019608",
        ),
        (
            {"eta_top": png(tmp_path, True)},
            'the pixels are stored as bytes, which hold only 0 to 1; with `format` "variant" a bitmap keeps',
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
