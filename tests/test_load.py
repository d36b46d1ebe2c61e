"""Loading of scenes and materials into Mitsuba, and rendering in passes."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import nma.render
from nma import materials
from nma.adapter import weights_file
from nma.errors import MissingDependencyError, ParamError, WeightsError
from nma.render.load import SceneError, load_dict, load_scene, material_bsdf
from nma.render.mesh import needs_coordinates
from nma.render.progressive import SAMPLES_PER_PASS, pass_sizes, render_passes
from nma.render.scene import preview_scene

nma.render.use("llvm_ad_rgb")
EMPTY = {"type": "scene", "sky": {"type": "constant"}, "camera": {"type": "perspective"}}


@pytest.mark.parametrize(
    ("spp", "pixels"), [(1, 64), (64, 256**2), (1000, 512**2), (7, 4096**2), (5, 3 << 18)]
)
def test_passes_add_up_and_stay_small(spp, pixels):
    sizes = pass_sizes(spp, pixels)
    assert sum(sizes) == spp
    assert len(set(sizes)) <= 2
    assert max(sizes) == 1 or max(sizes) * pixels <= SAMPLES_PER_PASS


def test_passes_average_to_one_picture_and_equal_seeds_repeat_it(monkeypatch):
    monkeypatch.setattr("nma.render.progressive.SAMPLES_PER_PASS", 12 * 12 * 2)
    scene = load_dict(preview_scene({"type": "diffuse"}, size=(12, 12), spp=1))
    done = []
    image = render_passes(scene, 5, seed=3, progress=done.append)
    assert done == [2, 2, 1]
    assert image.shape == (12, 12, 3) and image.dtype == np.float32
    np.testing.assert_array_equal(image, render_passes(scene, 5, seed=3))
    # No pass of a rendering with seed 4 has the same random numbers as a pass of a rendering with seed 3.
    other = render_passes(scene, 5, seed=4)
    assert (image != other).all(axis=2).mean() > 0.9


def test_errors_of_mitsuba_during_rendering_become_one_line(monkeypatch):
    def fails(*args, **kwargs):
        raise RuntimeError("[integrator.cpp:12] the film\nhas no pixels")

    monkeypatch.setattr(mi, "render", fails)
    with pytest.raises(SceneError, match="cannot render the scene: the film has no pixels"):
        render_passes(load_dict(EMPTY | {"integrator": {"type": "path"}}), 1)


def test_a_scene_without_an_integrator_is_not_rendered():
    with pytest.raises(SceneError, match="no integrator; add one"):
        render_passes(load_dict(EMPTY), 1)


def test_zero_samples_are_refused():
    with pytest.raises(ParamError, match="at least 1"):
        render_passes(load_dict(EMPTY), 0)


def test_errors_of_plugins_are_one_line_with_place_and_cause():
    bsdf = material_bsdf(materials.load("wet-nickel"), "layered") | {"alpha_top": 7.0}
    with pytest.raises(SceneError) as error:
        load_dict(preview_scene(bsdf, size=(4, 4)))
    message = str(error.value)
    assert "material" in message and "alpha_top is 7" in message
    assert "\n" not in message and "Traceback" not in message and ".py" not in message


def test_a_scene_file_may_use_material_files_beside_it(tmp_path):
    material = materials.FOLDER / "wet-nickel.toml"
    (tmp_path / "mine.toml").write_text(material.read_text())
    text = '<bsdf type="layered"><string name="material" value="mine.toml"/></bsdf>'
    text = f'<sensor type="perspective"/><shape type="sphere">{text}</shape>'
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{text}</scene>')
    scene = load_scene(tmp_path / "scene.xml", size=(6, 4))
    assert list(scene.sensors()[0].film().size()) == [6, 4]
    assert "alpha_top = " in str(scene.shapes()[0].bsdf())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "there is no scene file"),
        ("<scene", "Parsing"),
        ('<bsdf version="3.0.0" type="diffuse"/>', "no scene"),
        ('<scene version="3.0.0"><bsdf type="velvet"/></scene>', "velvet"),
        ('<scene version="3.0.0"><integrator type="path"/></scene>', "no sensor"),
    ],
)
def test_faulty_scene_files_are_refused(tmp_path, text, message):
    if text:
        (tmp_path / "scene.xml").write_text(text)
    with pytest.raises(SceneError, match=message):
        load_scene(tmp_path / "scene.xml")


def test_a_material_becomes_a_dictionary_for_either_bsdf():
    material = materials.load("gold-red-lacquer")
    adapter = material_bsdf(material, adapter="layered3-3x32", clamp=True)
    assert (adapter["type"], adapter["adapter"], adapter["clamp"]) == ("nma", "layered3-3x32", True)
    reference = material_bsdf(material, "layered")
    assert set(reference) == {"type", *material.values}
    assert reference["albedo"] == {"type": "rgb", "value": [0.95, 0.08, 0.03]}
    with pytest.raises(ParamError, match="unknown model"):
        material_bsdf(material, "principled")


def test_adapters_are_found_in_the_folders_of_mitsubas_file_resolver(tmp_path, monkeypatch):
    """`material_bsdf`, `needs_coordinates` and the BSDF `nma` find an adapter in the same folders."""
    (tmp_path / "adapters").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "adapters" / "mine.safetensors").write_bytes(weights_file("layered3-3x32").read_bytes())
    monkeypatch.chdir(tmp_path / "elsewhere")
    material, resolver = materials.load("gold-red-lacquer"), mi.file_resolver()
    with pytest.raises(WeightsError, match="mine.safetensors: no such weights file"):
        material_bsdf(material, adapter="mine.safetensors")
    resolver.append(str(tmp_path / "adapters"))
    try:
        bsdf = material_bsdf(material, adapter="mine.safetensors")
        assert bsdf["adapter"] == "mine.safetensors"
        assert not needs_coordinates(bsdf)
        assert "class = layered3" in str(load_dict(bsdf))
    finally:
        del resolver[len(resolver) - 1]


@pytest.mark.parametrize("model", ["nma", "layered"])
def test_images_of_a_material_repeat_as_often_as_its_file_says(model, tmp_path):
    """With `uv_scale = 3`, an image repeats three times along u.

    The scene gives the material by the name of its file, or as a dictionary.
    """
    pixels = np.zeros((1, 8, 3), np.uint8)
    pixels[:, 2:4, 0] = 255
    Image.fromarray(pixels).save(tmp_path / "image.png")
    text = (materials.FOLDER / "wet-nickel.toml").read_text()
    image = "sigma_t = { texture = 'image.png', channel = 'r', uv_scale = 3 }"
    (tmp_path / "mine.toml").write_text(text.replace("sigma_t = 0.0", image))
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.uv = mi.Point2f([0.125, 0.375, 0.125 + 1 / 3], 0.5)
    by_name = {"type": model, "material": str(tmp_path / "mine.toml")}
    for description in (by_name, material_bsdf(materials.load(tmp_path / "mine.toml"), model)):
        sigma_t = load_dict(description).inputs.columns(si)[-1]
        np.testing.assert_allclose(sigma_t, [1.0, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("model", ["nma", "layered"])
def test_textures_of_eight_bits_are_checked_by_the_values_they_evaluate_to(model, tmp_path):
    """A pixel of byte 20 has the value .078 if the texture is `raw`, and .007 in linear light otherwise.

    The adapter accepts `alpha_top` from .001 to .316, so that byte 20 is accepted and byte 0 is refused.
    """
    Image.fromarray(np.full((4, 4), 20, np.uint8)).save(tmp_path / "grey.png")
    bsdf = material_bsdf(materials.load("wet-nickel"), model)
    bitmap = {"type": "bitmap", "filename": str(tmp_path / "grey.png")}
    for raw in (True, False):
        load_dict(bsdf | {"alpha_top": bitmap | {"raw": raw}, "albedo": bitmap | {"raw": raw}})
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "grey.png")
    with pytest.raises(SceneError, match="texture of alpha_top.* at x=0, y=0.*: alpha_top is 0,"):
        load_dict(bsdf | {"alpha_top": bitmap})


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="there is an NVIDIA GPU")
def test_variants_for_a_missing_device_are_refused():
    with pytest.raises(
        MissingDependencyError, match="cuda_ad_rgb needs an NVIDIA GPU.*or choose llvm_ad_rgb"
    ):
        nma.render.use("cuda_ad_rgb")


def test_unknown_variants_are_refused():
    with pytest.raises(ParamError, match="metal_ad_rgb"):
        nma.render.use("metal_ad_rgb")
