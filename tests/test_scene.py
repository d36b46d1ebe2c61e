"""The preview scene (geometry, framing, parameter names, lights, textures), and statistics of rendered pictures."""

from pathlib import Path

import numpy as np
import pytest

from nma.errors import ParamError, TextureError
from nma.images.io import ImageError, write_exr
from nma.llvm import ensure_llvm

ensure_llvm()
import mitsuba as mi  # noqa: E402

mi.set_variant("llvm_ad_rgb")

from nma.render import statistics  # noqa: E402
from nma.render.lighting import LIGHTINGS  # noqa: E402
from nma.render.scene import CAMERAS, Camera, material_coverage, preview_scene  # noqa: E402
from nma.render.shaderball import shader_ball, shader_ball_file  # noqa: E402
from nma.render.textures import bitmap_texture, procedural_textures  # noqa: E402

GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}


@pytest.fixture(scope="module")
def ball():
    return shader_ball()


@pytest.fixture(scope="module")
def textures():
    return procedural_textures(128)


def test_shader_ball_is_closed(ball):
    """Every edge belongs to exactly two triangles, after vertices along the seam of the texture are merged."""
    _, index = np.unique(np.round(ball.vertices, 6), axis=0, return_inverse=True)
    corners = index.reshape(-1)[ball.faces]
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert 20_000 < len(ball.faces) < 80_000


def test_shader_ball_normals_are_unit_and_face_outward(ball):
    a, b, c = (ball.vertices[ball.faces[:, corner]] for corner in range(3))
    face = np.cross(b - a, c - a)
    area = np.linalg.norm(face, axis=1)
    assert area.min() > 0.0
    assert np.abs(np.linalg.norm(ball.normals, axis=1) - 1.0).max() < 1e-12
    cosine = (face[:, None] / area[:, None, None] * ball.normals[ball.faces]).sum(axis=2)
    assert cosine.min() > 0.95
    assert (a * face).sum() / 6.0 > 0.0  # the signed volume is positive if the triangles face outwards


def test_shader_ball_stands_on_the_floor_within_unit_bounds(ball):
    assert ball.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(ball.vertices[:, :2]).max() < 1.0 + 1e-9


def test_shader_ball_file_is_written_once():
    assert shader_ball_file() is shader_ball_file()
    assert shader_ball_file().stat().st_size > 500_000


@pytest.mark.parametrize("name", CAMERAS)
def test_material_covers_forty_percent(name):
    """The material covers at least 40 % of the picture, at any resolution.

    The material covers .446 of the picture in the view `hero`, .86 in `close` and .63 in `top`.
    """
    coverage = material_coverage((256, 256), name)
    assert coverage >= 0.40
    assert material_coverage((64, 64), name) == pytest.approx(coverage, abs=0.01)


def test_parameters_keep_their_names():
    keys = mi.traverse(
        mi.load_dict(preview_scene(GREY | {"id": "mine"}, size=(8, 8), lighting="outdoors"))
    ).keys()
    assert "material.reflectance.value" in keys
    assert {
        "sky.data",
        "lamp.emitter.radiance.value",
        "floor.bsdf.reflectance.data",
        "ball.vertex_positions",
    } <= set(keys)


@pytest.mark.parametrize("lighting", LIGHTINGS)
def test_picture_is_well_exposed(lighting):
    """The mean pixel is near middle grey, few pixels are brighter than white, and no pixel is NaN or negative."""
    image = render(preview_scene(GREY, size=(64, 64), lighting=lighting), 32)
    assert np.isfinite(image).all()
    assert image.min() >= 0.0
    assert 0.15 < image.mean() < 0.45
    assert (image.max(axis=2) > 1.0).mean() < 0.03


def test_horizon_is_soft_and_the_sun_can_be_hidden():
    outdoors = {"size": (8, 8), "lighting": "outdoors"}
    scenes = [mi.load_dict(preview_scene(GREY, **outdoors, hide_sun=hide)) for hide in (False, True)]
    peaks = [float(np.array(mi.traverse(scene)["sky.data"]).max()) for scene in scenes]
    assert peaks[0] > 50.0 * peaks[1]
    sky = np.array(mi.traverse(scenes[1])["sky.data"])[..., :3].mean(axis=1)
    near = sky[235:260]  # the rows of the sky at elevations from +8 to -1.5 degrees
    assert np.abs(np.diff(near, axis=0)).max() < 0.05 * near.max()


def test_gradient_reaches_the_material_under_prb():
    import drjit as dr

    scene = mi.load_dict(preview_scene(GREY, size=(16, 16), integrator="prb"))
    params = mi.traverse(scene)
    key = "material.reflectance.value"
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, spp=4), axis=None))
    assert (np.array(dr.grad(params[key])) > 0.01).all()


def test_envmap_replaces_all_lights_and_stands_upright(tmp_path: Path):
    """Under an environment map that is blue above and red below the horizon, the bare floor is blue.

    A red floor would mean that the environment map is upside down.
    """
    sky = np.zeros((16, 32, 3), dtype=np.float32)
    sky[:8, :, 2] = 1.0
    sky[8:, :, 0] = 1.0
    scene = preview_scene(GREY, size=(16, 16), envmap=write_exr(tmp_path / "sky.exr", sky))
    assert "lamp" not in scene
    scene.pop("ball")
    red, _, blue = render(scene, 64).mean(axis=(0, 1))
    assert blue > 0.2
    assert red < 0.03 * blue


def test_envmap_scale_multiplies():
    path = Path(shader_ball_file()).with_name("grey.exr")
    write_exr(path, np.full((8, 16, 3), 0.5, dtype=np.float32))
    one, two = (render(preview_scene(GREY, size=(8, 8), envmap=path, envmap_scale=s), 4) for s in (1.0, 2.0))
    assert two == pytest.approx(2.0 * one, rel=1e-4)


@pytest.mark.parametrize(
    "options",
    [
        {"camera": "nowhere"},
        {"size": (0, 8)},
        {"spp": 0},
        {"envmap": "no/such/file.exr"},
    ],
)
def test_wrong_options_are_refused(options):
    with pytest.raises(ParamError):
        preview_scene(GREY, **options)


def test_unreadable_environment_maps_are_refused_by_name(tmp_path):
    """An environment map that is not an image or contains NaN is refused before rendering."""
    sky = np.ones((4, 8, 3), np.float32)
    sky[1, 2] = np.nan
    (tmp_path / "text.exr").write_text("sky")
    for path, fault in (
        (tmp_path / "text.exr", "cannot be read"),
        (write_exr(tmp_path / "nan.exr", sky), "NaN or infinite"),
    ):
        with pytest.raises(ParamError, match=f"environment map .*{path.name} .*{fault}"):
            preview_scene(GREY, envmap=path)


def test_camera_and_integrator_may_be_given_as_objects():
    camera = Camera((0.0, -3.0, 1.0), (0.0, 0.0, 1.0), 20.0)
    scene = preview_scene(GREY, camera=camera, integrator={"type": "direct"}, size=(4, 4))
    assert scene["sensor"]["fov"] == 20.0
    assert scene["integrator"] == {"type": "direct"}
    assert np.isfinite(render(scene, 1)).all()


def test_textures_stay_in_range(textures):
    assert textures["alpha_bottom"].shape == textures["sigma_t"].shape == (128, 128)
    assert textures["albedo"].shape == (128, 128, 3)
    for name, low in (("alpha_bottom", 1e-3), ("sigma_t", 0.0), ("albedo", 0.0)):
        assert low <= textures[name].min() < textures[name].max() <= 1.0
    assert textures["alpha_bottom"].max() > 5.0 * textures["alpha_bottom"].min()
    assert (textures["sigma_t"] == 0.0).any() and (textures["sigma_t"] > 0.8).any()


def test_textures_depend_on_the_seed_alone(textures):
    again, other = procedural_textures(128), procedural_textures(128, seed=1)
    for name, texture in textures.items():
        np.testing.assert_array_equal(texture, again[name])
        assert np.abs(texture - other[name]).mean() > 0.01


def test_textures_tile(textures):
    """Pixels on opposite borders of a texture differ at most 1.5 times as much as neighbouring pixels in the middle."""
    for texture in textures.values():
        for axis in (0, 1):
            inside = np.abs(np.diff(texture, axis=axis)).mean(axis=1 - axis)
            border = np.abs(texture.take(0, axis) - texture.take(-1, axis)).mean(axis=0)
            assert (border <= 1.5 * inside.max(axis=0)).all()


def test_textures_of_too_few_pixels_are_refused():
    with pytest.raises(TextureError):
        procedural_textures(8)


def test_bitmap_texture_keeps_values(textures):
    texture = mi.load_dict(bitmap_texture(textures["alpha_bottom"]))
    np.testing.assert_array_equal(np.array(mi.traverse(texture)["data"])[..., 0], textures["alpha_bottom"])


def test_measure_returns_mean_and_variance_over_seeds():
    scene = mi.load_dict(preview_scene(GREY, size=(12, 12)))
    result = statistics.measure(scene, 4, [3, 5, 9], warmup=False)
    runs = np.stack([statistics.render_seconds(scene, 4, seed)[0] for seed in (3, 5, 9)])
    np.testing.assert_allclose(result.mean, runs.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(result.variance, runs.var(axis=0, ddof=1), rtol=1e-5, atol=1e-9)
    assert (runs[0] != runs[1]).mean() > 0.99
    assert result.seconds == np.median(result.times) > 0.0
    assert result.compile_seconds == 0.0
    assert result.efficiency == pytest.approx(1.0 / (result.mean_variance * result.seconds))


@pytest.mark.parametrize("seeds", [1, [4], [2, 2]])
def test_measure_wants_different_seeds(seeds):
    with pytest.raises(ParamError):
        statistics.measure(None, 1, seeds)


def test_ztest_false_alarms_are_as_stated():
    """At a false-alarm rate of 5 %, the Z-test rejects about 20 of 400 pairs of images with equal means.

    With random seeds, the number of rejected pairs would be between 6 and 38 in 99.98 % of all runs.
    """
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(400):
        a, b = rng.normal(1.0, 0.1, size=(2, 8, 6, 6, 3))
        args = [part for runs in (a, b) for part in (runs.mean(axis=0), runs.var(axis=0, ddof=1), 8)]
        alarms += not statistics.zscore_images(*args, false_alarm=0.05, block=2).passed
    assert 6 <= alarms <= 38


def test_ztest_of_renders_accepts_equal_and_rejects_two_percent_of_energy():
    """The Z-test accepts two sets of 12 renders of one scene as equal, and rejects them if one set is 2 % brighter.

    Each render has 24 x 24 pixels and 32 samples per pixel. The false-alarm rate is 1 %; seeds are fixed.
    """
    scene = mi.load_dict(preview_scene(GREY, size=(24, 24)))
    one = statistics.measure(scene, 32, range(12), warmup=False)
    two = statistics.measure(scene, 32, range(100, 112), warmup=False)
    for block in (1, 8):
        equal = statistics.zscore_images(
            one.mean, one.variance, one.runs, two.mean, two.variance, two.runs, block=block
        )
        assert equal.passed, (equal.worst, equal.p_values.min(), equal.level)
    brighter = statistics.zscore_images(
        one.mean, one.variance, one.runs, 1.02 * two.mean, 1.02**2 * two.variance, two.runs, block=8
    )
    assert not brighter.passed
    assert brighter.p_values[brighter.worst] < brighter.level


def test_ztest_handles_images_without_noise():
    image, none = np.ones((4, 4, 3)), np.zeros((4, 4, 3))
    assert statistics.zscore_images(image, none, 1, image * (1.0 + 1e-6), none, 1).passed
    assert not statistics.zscore_images(image, none, 1, image * 1.001, none, 1).passed


@pytest.mark.parametrize("fault", ["shape", "nan", "block"])
def test_ztest_refuses_images_that_cannot_be_compared(fault):
    image, block = np.ones((4, 4, 3)), 8 if fault == "block" else 1
    other = {"shape": np.ones((4, 5, 3)), "nan": np.full((4, 4, 3), np.nan)}.get(fault, image)
    with pytest.raises(ImageError):
        statistics.zscore_images(image, image, 2, other, image, 2, block=block)


def render(scene: dict, spp: int) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(scene), spp=spp, seed=0))


def test_the_scene_without_a_variant_says_what_to_call(monkeypatch):
    monkeypatch.setattr(mi, "variant", lambda: None)
    with pytest.raises(ParamError, match=r"nma\.render\.use\(\)"):
        preview_scene(GREY)
