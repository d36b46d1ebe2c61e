"""The Mitsuba BSDF `layered`: its methods agree with each other, it checks its inputs, and its images are unbiased."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_cases import load_error, texture

import nma.render
from nma.jit import dr
from nma.materials import names
from nma.render.bsdf import blended
from nma.render.statistics import measure, zscore_images
from nma.render.textures import bitmap_texture
from nma.sources import layered_eval

nma.render.use("llvm_ad_rgb")


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")
    yield
    nma.render.use("llvm_ad_rgb")


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


LACQUER = {
    "type": "layered",
    "alpha_top": 0.1,
    "alpha_bottom": 0.3,
    "eta_top": 1.5,
    "eta_conductor": rgb(0.14, 0.37, 1.44),
    "k_conductor": rgb(3.98, 2.38, 7.6),
    "albedo": rgb(0.9, 0.3, 0.2),
    "sigma_t": 0.7,
}
WHITE = {"eta_conductor": 0.0, "k_conductor": 1.0, "albedo": 1.0}


def interactions(n, seed=0, cos_theta=None):
    """Returns n surface interactions at random places with random wi, or with wi at the given cosine."""
    rng = mi.PCG32(n, seed)
    u = [rng.next_float32() for _ in range(6)]
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    z = u[0] if cos_theta is None else mi.Float(cos_theta) + 0.0 * u[0]
    r, phi = dr.sqrt(1.0 - z * z), 2.0 * dr.pi * u[1]
    si.wi = mi.Vector3f(r * dr.cos(phi), r * dr.sin(phi), z)
    si.p, si.uv = mi.Point3f(u[2], u[3], u[4]), mi.Point2f(u[5], u[2])
    return si, rng


def samples(bsdf, si, rng):
    u = [rng.next_float32() for _ in range(3)]
    return bsdf.sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))


def test_the_methods_of_the_bsdf_agree():
    bsdf, ctx = mi.load_dict(LACQUER), mi.BSDFContext()
    si, rng = interactions(1000)
    bs, weight = samples(bsdf, si, rng)
    u = [rng.next_float32() for _ in range(3)]
    wo = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[0], u[1]))
    value, pdf = bsdf.eval_pdf(ctx, si, wo)
    drawn = (u[0], mi.Point2f(u[1], u[2]))
    joint_value, joint_pdf, joint_bs, joint_weight = bsdf.eval_pdf_sample(ctx, si, wo, *drawn)
    bs2, weight2 = bsdf.sample(ctx, si, *drawn)

    left = bs.pdf > 0
    assert dr.count(left)[0] > 400
    assert dr.all(~left | (dr.abs(bsdf.pdf(ctx, si, bs.wo) - bs.pdf) <= 1e-5 * bs.pdf))
    assert dr.all(left | dr.all(weight == 0))
    assert dr.all(~left | ((bs.wo.z > 0) & (bs.eta == 1) & (dr.abs(dr.norm(bs.wo) - 1) < 1e-4)))
    # Values are random estimates, but all methods compute the same estimate from the same arguments.
    for a, b in ((bsdf.eval(ctx, si, wo), value), (joint_value, value), (joint_weight, weight2)):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-4, atol=1e-6)
    for a, b in ((bsdf.pdf(ctx, si, wo), pdf), (joint_pdf, pdf), (joint_bs.pdf, bs2.pdf)):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-4, atol=1e-6)
    assert mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection)


def test_estimates_at_different_points_are_independent():
    """`eval` derives its random numbers from each number of the point and of its uv, too."""
    bsdf, si = mi.load_dict(LACQUER), dr.zeros(mi.SurfaceInteraction3f, 6)
    si.wi = mi.Vector3f(0.6, 0.0, 0.8)
    numbers = [mi.Float(dr.arange(mi.UInt32, 6) == k) for k in range(1, 6)]
    si.p, si.uv = mi.Point3f(*numbers[:3]), mi.Point2f(*numbers[3:])
    value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0.0, -0.6, 0.8)))
    assert len(np.unique(value[0])) == 6


def test_evaluation_and_sampling_have_the_same_albedo():
    bsdf, ctx, n = mi.load_dict(LACQUER), mi.BSDFContext(), 1 << 17
    for cos_theta in (0.95, 0.4):
        si, rng = interactions(n, 1, cos_theta)
        _, weight = samples(bsdf, si, rng)
        # The directions `wo` follow a cosine density, which is unrelated to the BSDF.
        wo = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        value = bsdf.eval(ctx, si, wo) * (dr.pi / wo.z)
        a, b = np.array(weight, np.float64), np.array(value, np.float64)
        z = (a.mean(axis=1) - b.mean(axis=1)) / np.sqrt((a.var(axis=1) + b.var(axis=1)) / n)
        assert np.abs(z).max() < 4.0  # false alarm 4e-4


def test_the_back_and_other_lobe_types_are_black():
    bsdf, ctx = mi.load_dict(LACQUER), mi.BSDFContext()
    si, rng = interactions(100, 0, 0.5)
    wo = mi.Vector3f(0.0, 0.6, 0.8)
    assert dr.all(bsdf.eval(ctx, si, -wo) == 0, axis=None)
    assert dr.all(bsdf.pdf(ctx, si, -wo) == 0, axis=None)
    diffuse = mi.BSDFContext()
    diffuse.type_mask = +mi.BSDFFlags.DiffuseReflection
    assert dr.all(bsdf.eval(diffuse, si, wo) == 0, axis=None)
    si.wi = -si.wi
    bs, weight = samples(bsdf, si, rng)
    assert dr.all(bs.pdf == 0, axis=None)
    assert dr.all(weight == 0, axis=None)
    assert dr.all(bsdf.eval(ctx, si, wo) == 0, axis=None)
    two = mi.load_dict({"type": "twosided", "material": LACQUER})
    assert dr.any(two.eval(ctx, si, -wo) > 0, axis=None)


@pytest.mark.parametrize(
    ("changes", "message"),
    (
        ({"alpha_top": float("nan")}, "alpha_top is nan, allowed is 0.0001 .. 1"),
        ({"eta_top": 0.9}, "eta_top is 0.9, allowed is 1 .. 4"),
        ({"albedo": rgb(0.5, 1.2, 0.0)}, "albedo is 0.5, 1.2, 0, allowed is 0 .. 1"),
        ({"sigma_t": rgb(0.1, 0.2, 0.3)}, "sigma_t needs one number or a texture, got the colour"),
        ({"alpha_top": "rough"}, "alpha_top needs a number"),
        ({"alpha_top": 1.0, "roughness": 0.1}, "roughness"),
        ({"material": "unobtainium"}, "unobtainium"),
        ({"alpha_bottom": texture(np.nan)}, "texture of alpha_bottom at x=5, y=2: alpha_bottom is nan"),
        ({"alpha_bottom": texture(3.0)}, "texture of alpha_bottom at x=5, y=2: alpha_bottom is 3"),
        ({"alpha_bottom": texture([0.1, 0.2, 0.3], 3)}, "texture of alpha_bottom is coloured"),
        ({"k_conductor": texture(-1.0, 3)}, "texture of k_conductor at x=5, y=2: k_conductor is -1"),
    ),
)
def test_wrong_inputs_are_refused(changes, message):
    assert message in load_error({**LACQUER, **changes})


def test_missing_inputs_are_named():
    description = {key: value for key, value in LACQUER.items() if key not in ("albedo", "sigma_t")}
    assert "no value for albedo, sigma_t" in load_error(description)


def test_other_variants_are_refused():
    for variant in ("scalar_spectral", "llvm_ad_spectral"):
        mi.set_variant(variant)
        assert f"not in {variant}" in load_error(LACQUER)


def test_inputs_may_be_numbers_colours_spectra_or_textures():
    textured = {
        "albedo": texture(0.2, 3),
        "alpha_top": texture(0.3),
        "eta_conductor": {"type": "spectrum", "value": 2.5},
    }
    bsdf = mi.load_dict(
        {**LACQUER, **textured, "sigma_t": {"type": "checkerboard", "color0": 0.25, "color1": 3.0}}
    )
    assert bsdf.inputs.textured == ("alpha_top", "albedo", "sigma_t")
    params = mi.traverse(bsdf)
    assert {"alpha_bottom", "eta_top", "eta_conductor", "albedo.data", "sigma_t.color0.value"} <= set(
        params.keys()
    )
    si, _ = interactions(1, 0, 0.8)
    si.uv = mi.Point2f(5.5 / 8, 2.5 / 4)
    columns = [c.numpy()[0] for c in bsdf.inputs.columns(si)]
    np.testing.assert_allclose(columns[:6], [0.3, 0.3, 1.5, 2.5, 2.5, 2.5], rtol=1e-5)
    np.testing.assert_allclose(columns[9:], [0.2, 0.2, 0.2, 0.25], rtol=1e-5)

    params["alpha_bottom"] = 0.05
    params.update()
    assert bsdf.inputs.columns(si)[1].numpy()[0] == pytest.approx(0.05)


def test_the_bsdf_loads_from_xml_and_from_named_materials():
    scene = mi.load_string(
        f"""<scene version="3.0.0"><shape type="sphere"><bsdf type="layered">
            <string name="material" value="{names()[0]}"/>
            <rgb name="k_conductor" value="1, 5.5, 7"/> <float name="alpha_top" value="0.05"/>
        </bsdf></shape></scene>"""
    )
    columns = [c.numpy()[0] for c in scene.shapes()[0].bsdf().inputs.columns()]
    np.testing.assert_allclose([columns[0], *columns[6:9]], [0.05, 1.0, 5.5, 7.0], rtol=1e-6)


def scene(size, **integrator):
    """Loads a scene of a textured ball on a smooth floor, under a constant sky and a lamp.

    The integrator computes direct light and one bounce.
    """
    patches = np.random.default_rng(0).uniform(0.05, 0.9, (4, 8, 3)).astype(np.float32)
    floor = {**LACQUER, "alpha_top": 0.02, "alpha_bottom": 0.15, "sigma_t": 0.2}
    ball = {**LACQUER, "albedo": bitmap_texture(patches), "alpha_bottom": bitmap_texture(patches[..., :1])}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0.0, -4.0, 2.2], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0])
    lamp = mi.ScalarTransform4f().look_at([1.8, -0.6, 2.5], [0.0, 0.0, 0.5], [0.0, 1.0, 0.0]).scale(0.9)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"max_depth": 3, **integrator},
            "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
            "sky": {"type": "constant", "radiance": 0.4},
            "lamp": {
                "type": "rectangle",
                "to_world": lamp,
                "light": {"type": "area", "radiance": rgb(5.0, 4.0, 3.0)},
            },
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3.0), "material": floor},
            "ball": {"type": "sphere", "center": [0.0, 0.0, 0.8], "radius": 0.8, "material": ball},
        }
    )


def register_bsdf_sampling():
    """Registers a path tracer that finds lights only by sampling the BSDF."""

    class BsdfSampling(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.max_depth = props["max_depth"]

        def sample(self, scene, sampler, ray, medium=None, active=True):
            def body(ray, weight, light, active, depth, sampler):
                si = scene.ray_intersect(ray, active)
                light += weight * dr.select(active, si.emitter(scene, active).eval(si, active), 0.0)
                active = active & si.is_valid() & (depth + 1 < self.max_depth)
                bs, value = si.bsdf(ray).sample(
                    mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active
                )
                active &= bs.pdf > 0
                return si.spawn_ray(si.to_world(bs.wo)), weight * value, light, active, depth + 1, sampler

            state = (mi.Ray3f(ray), mi.Color3f(1.0), mi.Color3f(0.0), mi.Bool(active), mi.UInt32(0), sampler)
            light = dr.while_loop(state, lambda ray, weight, light, active, *rest: active, body)[2]
            return light, mi.Bool(True), []

    mi.register_integrator("bsdf_sampling", lambda props: BsdfSampling(props))


def same_image(a, b):
    """Returns whether two measured images have equal means, and the worst deviations.

    Three tests compare the means of pixels, of blocks of 8 x 8 pixels, and of the whole image. The false-alarm rate of
    each test is 1 %.
    """
    tests = {
        n: zscore_images(a.mean, a.variance, 8, b.mean, b.variance, 8, block=n, rounding=1e-4)
        for n in (1, 8, 32)
    }
    worst = {n: f"p {t.p_values.min():.1e}, level {t.level:.1e}, at {t.worst}" for n, t in tests.items()}
    return all(t.passed for t in tests.values()), worst


@pytest.mark.slow
def test_light_sampling_equals_bsdf_sampling(monkeypatch):
    """Next-event estimation with MIS renders the same image as BSDF sampling alone.

    Three statistical tests each have a false-alarm rate of 1 %.

    A failure means that `eval` or `pdf` does not match `sample`. The test detects values that are 3 % too large.
    """
    register_bsdf_sampling()
    both = measure(scene(32, type="path"), 128, 8, warmup=False)
    alone = measure(scene(32, type="bsdf_sampling"), 512, 8, warmup=False)
    same, worst = same_image(both, alone)
    assert same, worst
    # The lamp is small, so direct sampling of the lamp must reduce the variance.
    assert 4 * alone.mean_variance > both.mean_variance

    evaluate = layered_eval.evaluate
    monkeypatch.setattr(layered_eval, "evaluate", lambda *args: evaluate(*args) * 1.03)
    wrong = measure(scene(32, type="path"), 128, 8, warmup=False)
    assert not same_image(wrong, alone)[0]


def test_white_furnace():
    """A lossless material under a uniform sky is invisible (false-alarm rate .1 %).

    A failure means that the simulation loses or adds light.
    """
    material = {**LACQUER, **WHITE, "alpha_top": 1e-4, "alpha_bottom": 1e-4, "sigma_t": 1.0}
    description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]).scale(1.2),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        },
        "sky": {"type": "constant", "radiance": 1.0},
        "ball": {"type": "sphere", "material": material},
    }
    result = measure(mi.load_dict(description), 1024, 6, warmup=False)
    one = np.ones_like(result.mean)
    # At grazing angles below the coat, microfacets block about .1 % of the light even at a small roughness, so that the
    # test allows a difference of 1e-3.
    same = zscore_images(result.mean, result.variance, 6, one, 0 * one, 1, rounding=1e-3, false_alarm=1e-3)
    assert same.passed, f"p {same.p_values.min():.1e} below {same.level:.1e} at {same.worst}"


def test_a_scene_s_composites_do_not_depend_on_the_scenes_loaded_before():
    """`blended` returns the right result for a BSDF even if a BSDF of an older scene had the same name and address."""
    blend = {"type": "blendbsdf", "weight": 0.5, "a": LACQUER, "b": {"type": "diffuse"}}
    kept = []
    for composite in (True, False, True, True, False, False):
        scene = mi.load_dict(
            {"type": "scene", "ball": {"type": "sphere", "bsdf": blend if composite else LACQUER}}
        )
        bsdf = mi.traverse(scene).hierarchy
        (ours,) = (part for part in bsdf if type(part).__name__ == "Layered")
        kept.append(bytes(range(256)))
        assert blended(ours) == composite
