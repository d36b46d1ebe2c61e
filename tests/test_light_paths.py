"""Paths from the light and paths from the camera evaluate the same BSDF, although `nma` is not reciprocal."""

import json

import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import random_adapter
from scalar_cases import MATERIAL as NUMBERS
from scalar_cases import finished, plugins

import nma.render
from nma import target
from nma.adapter import Adapter
from nma.jit import dr
from nma.render.textures import bitmap_texture

nma.render.use("llvm_ad_rgb")
MATERIAL = {"type": "nma", "adapter": "layered3-3x32", "material": "frosted-silver"}
# An adapter that is so far from reciprocal that pictures show it.
LOPSIDED = {**MATERIAL, "adapter": "layered3-principled-5x64"}
STRETCHED = {**MATERIAL, "adapter": "stretched.safetensors"}
TEXTURED = {**STRETCHED, "sigma_t": bitmap_texture(np.full((2, 2, 1), 0.3))}
PLAIN = {"type": "nma", **NUMBERS}
CONSTANT = {**MATERIAL, "adapter": "constant.safetensors"}


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("adapters")
    random_adapter(hidden="1x8", params=target.STRETCHED_PARAMS).save(made / "stretched.safetensors")
    random_adapter(hidden="1x8", directional=False).save(made / "constant.safetensors")
    return made


def context(mode):
    made = mi.BSDFContext()
    made.mode = mode
    return made


CAMERA, LIGHT = context(mi.TransportMode.Radiance), context(mi.TransportMode.Importance)


def interaction(wi):
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi, si.uv = wi, mi.Point2f(0.5)
    return si


@pytest.mark.parametrize("material", [MATERIAL, TEXTURED, STRETCHED, CONSTANT])
def test_light_paths_have_the_values_of_camera_paths(folder, material, monkeypatch):
    """With the roles of `wi` and `wo` swapped, light paths evaluate the same f(view, light) as camera paths do.

    Samples of light paths have the pdf and the value that `eval_pdf` returns. A failure means that light tracing and
    path tracing render different materials.
    """
    monkeypatch.chdir(folder)
    bsdf, rng = mi.load_dict(material), mi.PCG32(2000)
    drawn = lambda: mi.Point2f(rng.next_float32(), rng.next_float32())
    camera, light = (mi.warp.square_to_cosine_hemisphere(drawn()) for _ in range(2))
    seen = bsdf.eval(CAMERA, interaction(camera), light) / light.z
    found = bsdf.eval(LIGHT, interaction(light), camera) / camera.z
    np.testing.assert_allclose(found, seen, rtol=2e-3, atol=1e-5)
    forward = bsdf.eval(CAMERA, interaction(light), camera) / camera.z
    differs = not Adapter.load(material["adapter"]).reciprocal
    assert (np.abs(np.array(forward) - np.array(seen)).mean() > 0.01 * np.array(seen).mean()) == differs

    bs, weight = bsdf.sample(LIGHT, interaction(light), rng.next_float32(), drawn())
    value, pdf = bsdf.eval_pdf(LIGHT, interaction(light), bs.wo, bs.pdf > 0)
    np.testing.assert_allclose(bs.pdf, pdf, rtol=2e-3)
    np.testing.assert_allclose(weight * bs.pdf, value, rtol=2e-3, atol=1e-5)


def test_light_from_below_or_to_below_the_surface_is_black():
    bsdf, up, down = mi.load_dict(MATERIAL), mi.Vector3f(0.6, 0.0, 0.8), mi.Vector3f(0.0, 0.6, -0.8)
    for wi, wo in (
        (up, down),
        (down, up),
        (down, down),
        (up, mi.Vector3f(1, 0, 0)),
        (mi.Vector3f(1, 0, 0), up),
    ):
        assert dr.all(bsdf.eval(LIGHT, interaction(wi), wo) == 0)


def scene(integrator):
    """Loads a scene of a plate that is seen from above and lit by a small lamp at a grazing angle.

    The picture has 4 x 4 pixels.
    """
    look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 3},
            "sensor": {
                "type": "perspective",
                "fov": 28,
                "to_world": look,
                "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
            },
            "lamp": {
                "type": "sphere",
                "center": [3.0, 0.0, 0.9],
                "radius": 0.3,
                "emitter": {"type": "area", "radiance": 50.0},
            },
            "plate": {"type": "rectangle", "bsdf": LOPSIDED},
        }
    )


def mean(integrator, spp, runs=8):
    """Returns the mean colour (3,) of the picture, and its standard error over independent runs."""
    loaded = scene(integrator)
    each = [np.array(mi.render(loaded, spp=spp, seed=k)).mean(axis=(0, 1)) for k in range(runs)]
    return np.mean(each, axis=0), np.std(each, axis=0, ddof=1) / runs**0.5


def test_light_tracing_renders_what_path_tracing_does(monkeypatch):
    """The mean colours of both integrators agree within 4.5 standard errors.

    The standard errors are estimated from eight runs, so about one test in a hundred would be a false alarm with random
    seeds; seeds are fixed.
    """
    wanted, doubt = mean("path", 1024)
    found, error = mean("ptracer", 16384)
    assert (error < 0.01 * wanted).all()
    assert (np.abs(found - wanted) < 4.5 * np.hypot(error, doubt)).all(), (found, wanted)
    # If the adapter gets the light direction in place of the view direction, the colours of the two integrators differ
    # significantly.
    monkeypatch.setattr(Adapter, "reciprocal", True)
    found, error = mean("ptracer", 16384)
    assert (np.abs(found - wanted) > 4.5 * np.hypot(error, doubt)).all(), (found, wanted)


# A program that prints five colours for each random pair of directions. The first three colours are values of f: for a
# camera path, for a light path, and for a camera path with swapped directions. The last two colours belong to a sampled
# direction: the sample weight times the pdf, and the value that `eval_pdf` returns for this direction.
SCALAR = """
    rng = np.random.default_rng(0)
    light = mi.BSDFContext(mi.TransportMode.Importance)

    def direction():
        z, phi = rng.uniform(0.1, 1), rng.uniform(0, 6.28)
        return [float(np.sqrt(1 - z * z) * np.cos(phi)), float(np.sqrt(1 - z * z) * np.sin(phi)), z]

    def at(wi):
        si = interaction(1.0)
        si.wi = wi
        return si

    for bsdf in map(mi.load_dict, words):
        for _ in range(50):
            a, b = direction(), direction()
            seen = np.array(bsdf.eval(mi.BSDFContext(), at(a), b)) / b[2]
            found = np.array(bsdf.eval(light, at(b), a)) / a[2]
            swapped = np.array(bsdf.eval(mi.BSDFContext(), at(b), a)) / a[2]
            sample, weight = bsdf.sample(light, at(b), rng.random(), rng.random(2).tolist())
            value, pdf = bsdf.eval_pdf(light, at(b), sample.wo) if sample.pdf > 0 else ([0.0] * 3, 0.0)
            print(json.dumps([[*map(float, x)] for x in (seen, found, swapped, weight * sample.pdf, value)]))
"""


@pytest.mark.slow
def test_the_scalar_plugin_has_the_same_values_for_light_paths(folder):
    plugins()
    bsdfs = [{**PLAIN, "adapter": str(folder / "stretched.safetensors")}, {**PLAIN, "online": True}]
    rows = np.array([json.loads(line) for line in finished(SCALAR, "scalar_rgb", *bsdfs)])
    assert rows.shape == (100, 5, 3)
    seen, found, swapped, weighed, value = rows.transpose(1, 0, 2)
    np.testing.assert_allclose(found, seen, rtol=5e-3, atol=1e-5)
    np.testing.assert_allclose(weighed, value, rtol=5e-3, atol=1e-5)
    assert np.abs(swapped - seen).mean() > 0.02 * seen.mean()
