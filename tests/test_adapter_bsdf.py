"""The Mitsuba BSDF `nma`: its values are the adapter's, its methods are consistent, and it checks inputs and edits."""

import json
import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import VARIANTS, random_adapter
from bsdf_cases import load_error, texture
from safetensors import safe_open
from safetensors.numpy import save

import nma.render
from nma import network, target
from nma.adapter import Adapter, shipped
from nma.jit import dr
from nma.ops import Vec3
from nma.params import LAYERED3
from nma.render.textures import bitmap_texture
from nma.target import Brdf

nma.render.use("llvm_ad_rgb")
TEXTURED = {"alpha_bottom": 0.3, "albedo": [0.9, 0.3, 0.2], "sigma_t": 0.7}
NUMBERS = {
    "alpha_top": 0.1,
    "eta_top": 1.5,
    "eta_conductor": [0.14, 0.37, 1.44],
    "k_conductor": [3.9, 2.3, 7.6],
}
NUMBERS |= TEXTURED


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")
    yield
    nma.render.use("llvm_ad_rgb")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """The weights file of a small adapter, which compiles quickly.

    The values of the adapter are arbitrary and vary with every input.
    """
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    random_adapter(hidden="2x8").save(path)
    return path


@pytest.fixture(scope="module")
def stretched_weights(tmp_path_factory):
    """The weights file of a small, bounded adapter whose lobes are stretched along the plane of incidence."""
    path = tmp_path_factory.mktemp("weights") / "stretched.safetensors"
    replace(random_adapter(hidden="2x8", params=target.STRETCHED_PARAMS), bounded=True).save(path)
    return path


def rgb(values):
    return {"type": "rgb", "value": list(values)}


def description(weights, **changes):
    values = {name: rgb(v) if isinstance(v, list) else v for name, v in NUMBERS.items()}
    return {"type": "nma", "adapter": str(weights), **values, **changes}


def textured(weights, **changes):
    """Describes the same material as `description`, but gives three parameters as textures.

    Each texture has the same value everywhere.
    """
    images = {name: bitmap_texture(np.full((4, 8, np.size(v)), v)) for name, v in TEXTURED.items()}
    return description(weights, **images, **changes)


def interactions(n, seed=0):
    """Returns n surface interactions with random wi on the front side."""
    rng = mi.PCG32(n, seed)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
    si.uv = mi.Point2f(rng.next_float32(), rng.next_float32())
    return si, rng


def drawn(rng):
    return rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())


def close(a, b, rtol=1e-4, atol=1e-6):
    np.testing.assert_allclose(np.array(a), np.array(b), rtol=rtol, atol=atol)


@pytest.mark.parametrize("make", (description, textured))
def test_values_are_those_of_the_adapter(weights, make):
    """The BSDF has the values and densities that NumPy computes from the adapter.

    The mean relative error is below 1e-5 for textured materials. For untextured materials, the limit is 2e-4, because
    an untextured material interpolates the parameters of its target from precomputed curves.
    """
    bsdf, (si, rng) = mi.load_dict(make(weights)), interactions(2000)
    wo = mi.warp.square_to_uniform_hemisphere(drawn(rng)[1])
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo)

    adapter = Adapter.load(weights)
    wi = np.array(si.wi, np.float64)
    flat = adapter.numbers(LAYERED3.vector(NUMBERS), wi[2])[0].astype(np.float64)
    brdf = adapter.from_numbers(list(flat.T), Vec3(*wi))
    expected, density = brdf.eval_pdf(Vec3(*wi), Vec3(*np.array(wo, np.float64)))
    for found, wanted in ((value, np.stack(expected)), (pdf, density)):
        error = np.abs(np.array(found) - wanted) / wanted
        # Near narrow peaks, single precision causes larger errors than on average.
        assert error.mean() < (1e-5 if make is textured else 2e-4)
        assert error.max() < 1e-2


@pytest.mark.parametrize(("instances", "directional"), VARIANTS.values(), ids=VARIANTS)
def test_every_variant_of_adapters_has_the_values_of_numpy(tmp_path, instances, directional):
    """The values of the BSDF and of the adapter in NumPy agree within 1 %.

    The test covers several counts of instances, and target parameters that are constant or depend on the view
    direction.
    """
    random_adapter(instances, directional, hidden="1x4").save(tmp_path / "w.safetensors")
    adapter, (si, rng) = Adapter.load(tmp_path / "w.safetensors"), interactions(500)
    wo = mi.warp.square_to_uniform_hemisphere(drawn(rng)[1])
    found = mi.load_dict(description(tmp_path / "w.safetensors")).eval(mi.BSDFContext(), si, wo)
    wi = np.array(si.wi, np.float64)
    flat = adapter.numbers(LAYERED3.vector(NUMBERS), wi[2])[0].astype(np.float64)
    brdf = adapter.from_numbers(list(flat.T), Vec3(*wi))
    close(found, np.stack(brdf.eval(Vec3(*wi), Vec3(*np.array(wo, np.float64)))), rtol=1e-2)


@pytest.mark.parametrize("make", (description, textured))
def test_stretched_lobes_turn_with_the_view(stretched_weights, make):
    """A material with stretched lobes is isotropic: rotating both directions about the normal changes no value."""
    bsdf, ctx, (si, rng) = mi.load_dict(make(stretched_weights)), mi.BSDFContext(), interactions(2000)
    wo = bsdf.sample(ctx, si, *drawn(rng))[0].wo
    valid = wo.z > 0
    adapter, wi = Adapter.load(stretched_weights), np.array(si.wi, np.float64)
    assert adapter.in_plane
    flat = adapter.numbers(LAYERED3.vector(NUMBERS), wi[2])[0].astype(np.float64)
    brdf = adapter.from_numbers(list(flat.T), Vec3(*wi))
    assert np.abs(brdf.blend.instances[0].anisotropic).max() > 0.5
    assert np.min(brdf.blend.scale) < 0.95
    value, pdf = brdf.eval_pdf(Vec3(*wi), Vec3(*np.array(wo, np.float64)))
    expected = [np.where(valid, x, 0.0) for x in (*value, pdf)]
    for angle in (0.0, 0.7, 2.9):
        turn = mi.Transform4f().rotate([0, 0, 1], math.degrees(angle))
        turned, _ = interactions(2000)
        turned.wi = turn @ si.wi
        value, pdf = bsdf.eval_pdf(ctx, turned, turn @ wo, valid)
        for found, wanted in zip((*np.array(value), pdf), expected, strict=True):
            error = np.abs(np.array(found) - wanted) / (wanted + 1e-3)
            assert error.mean() < 5e-4
            assert error.max() < 3e-2


@pytest.mark.parametrize("make", (description, textured))
@pytest.mark.parametrize("stretched", (False, True), ids=("principled", "stretched"))
def test_the_methods_of_the_bsdf_agree(weights, stretched_weights, make, stretched):
    weights = stretched_weights if stretched else weights
    bsdf, ctx, (si, rng) = mi.load_dict(make(weights)), mi.BSDFContext(), interactions(1000)
    wo, numbers = mi.warp.square_to_cosine_hemisphere(drawn(rng)[1]), drawn(rng)
    value, pdf = bsdf.eval_pdf(ctx, si, wo)
    bs, weight = bsdf.sample(ctx, si, *numbers)
    joint_value, joint_pdf, joint_bs, joint_weight = bsdf.eval_pdf_sample(ctx, si, wo, *numbers)
    for a, b in ((bsdf.eval(ctx, si, wo), value), (joint_value, value), (joint_weight, weight)):
        close(a, b)
    for a, b in (
        (bsdf.pdf(ctx, si, wo), pdf),
        (joint_pdf, pdf),
        (joint_bs.pdf, bs.pdf),
        (joint_bs.wo, bs.wo),
    ):
        close(a, b)

    valid = bs.pdf > 0
    assert dr.count(valid)[0] > 800
    again, density = bsdf.eval_pdf(ctx, si, bs.wo, valid)
    close(dr.select(valid, bs.pdf, 0), density, rtol=1e-3)
    close(weight * bs.pdf, again, rtol=1e-3)
    assert dr.all(valid | dr.all(weight == 0))
    assert dr.all(~valid | ((bs.wo.z > 0) & (bs.eta == 1) & (dr.abs(dr.norm(bs.wo) - 1) < 1e-4)))


@pytest.mark.parametrize("material", ("gold-red-lacquer", "frosted-silver", "car-paint-blue"))
def test_samples_follow_the_pdf(material):
    """Samples of each shipped adapter follow `pdf` (chi-square test).

    The false-alarm rate is .01 per adapter and material, over three directions together (Sidak's correction). A failure
    means biased renderings.
    """
    for adapter in shipped():
        bsdf = {
            "type": "nma",
            "adapter": adapter,
            "material": material,
            "alpha_top": 0.1,
            "alpha_bottom": 0.2,
        }
        for wi in ([0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.95, (1 - 0.95**2) ** 0.5]):
            sample, pdf = mi.chi2.BSDFAdapter("nma", bsdf, wi=wi)
            test = mi.chi2.ChiSquareTest(
                domain=mi.chi2.SphericalDomain(),
                sample_func=sample,
                pdf_func=pdf,
                sample_dim=3,
                sample_count=1 << 17,
                res=51,
                ires=32,  # points per bin: with 8, the test's own integral of a narrow lobe is .5 % off
            )
            assert test.run(0.01, 3), (adapter, wi, test.messages)


def test_the_back_and_other_lobe_types_are_black(weights):
    bsdf, (si, rng) = mi.load_dict(description(weights)), interactions(100)
    wo = mi.Vector3f(0.0, 0.6, 0.8)
    diffuse = mi.BSDFContext()
    diffuse.type_mask = +mi.BSDFFlags.DiffuseReflection
    for ctx, w in ((mi.BSDFContext(), -wo), (diffuse, wo)):
        value, pdf = bsdf.eval_pdf(ctx, si, w)
        assert dr.all((pdf == 0) & dr.all(value == 0))
    si.wi = -si.wi
    value, pdf, bs, weight = bsdf.eval_pdf_sample(mi.BSDFContext(), si, wo, *drawn(rng))
    assert dr.all((pdf == 0) & (bs.pdf == 0) & dr.all(value == 0) & dr.all(weight == 0))


def scene(bsdf, name="material", **integrator):
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0.0, -4.0, 1.5], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    same = {"type": "ref", "id": name}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4, **integrator},
            "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
            "sky": {"type": "constant", "radiance": 0.5},
            "lamp": {"type": "point", "position": [2.0, -2.0, 3.0], "intensity": 6.0},
            name: bsdf,
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3.0), "bsdf": same},
            "ball": {"type": "sphere", "center": [0.0, 0.0, 0.8], "radius": 0.8, "bsdf": same},
        }
    )


def test_pictures_by_curves_network_and_wavefront_are_equal(weights):
    """Target parameters from precomputed curves and from the network give the same picture, up to rounding.

    Pictures with Dr.Jit's evaluated loops also equal pictures with symbolic loops. All pictures use the same random
    numbers.
    """
    curves = np.array(mi.render(scene(description(weights)), spp=16, seed=1))
    loaded = scene(textured(weights))
    network = np.array(mi.render(loaded, spp=16, seed=1))
    flags = dr.JitFlag.SymbolicLoops, dr.JitFlag.SymbolicCalls
    with dr.scoped_set_flag(flags[0], False), dr.scoped_set_flag(flags[1], False):
        wavefront = np.array(mi.render(loaded, spp=16, seed=1))
    assert curves.mean() > 0.1
    # Rounding may change the direction of a sample completely, so that up to 1 % of the pixels may differ.
    for other in (curves, wavefront):
        off = np.abs(network - other) > 0.01 * network
        assert off.mean() < 0.01
        assert abs(network.mean() - other.mean()) < 2e-3 * network.mean()


def test_a_shading_point_runs_the_network_once(weights, monkeypatch):
    """A path tracer evaluates and samples a BSDF at each shading point, but runs the BSDF's network once per point.

    A failure means that the network runs more often than needed, and pictures take longer.
    """
    calls = []

    def counted(function):
        def call(*arguments):
            calls.append(function.__name__)
            return function(*arguments)

        return call

    for owner, name in ((network, "forward_lanes"), (Brdf, "eval_pdf"), (Brdf, "sample")):
        monkeypatch.setattr(owner, name, counted(getattr(owner, name)))
    dr.eval(mi.render(scene(textured(weights)), spp=1))
    assert calls.count("forward_lanes") == calls.count("eval_pdf") == calls.count("sample") > 0
    # Outside of a rendering, each call of `eval_pdf` or `sample` runs the network.
    bsdf, (si, rng) = mi.load_dict(textured(weights)), interactions(10)
    calls.clear()
    bsdf.eval_pdf(mi.BSDFContext(), si, mi.Vector3f(0.0, 0.6, 0.8))
    bsdf.sample(mi.BSDFContext(), si, *drawn(rng))
    assert calls.count("forward_lanes") == 2


def test_edits_take_effect_at_once(weights):
    ctx, (si, _) = mi.BSDFContext(), interactions(100)
    wo = mi.Vector3f(0.0, 0.6, 0.8)
    for make in (description, textured):
        bsdf = mi.load_dict(make(weights))
        params = mi.traverse(bsdf)
        names = {"alpha_top": 0.2, "albedo": mi.Color3f(0.1, 0.2, 0.8)}
        if make is textured:
            names = {"alpha_top": 0.2, "albedo.data": np.broadcast_to([0.1, 0.2, 0.8], (4, 8, 3))}
        for name, value in names.items():
            params[name] = mi.TensorXf(value) if name.endswith("data") else value
            params.update()
        fresh = {"alpha_top": 0.2, "albedo": rgb([0.1, 0.2, 0.8])}
        expected = mi.load_dict(description(weights, **fresh)).eval(ctx, si, wo)
        close(bsdf.eval(ctx, si, wo), expected, rtol=2e-3)
        assert not np.allclose(expected, mi.load_dict(make(weights)).eval(ctx, si, wo), rtol=0.01)


def test_wrong_edits_are_refused(weights):
    params = mi.traverse(mi.load_dict(description(weights)))
    params["sigma_t"] = 1.5
    with pytest.raises(Exception, match=r"sigma_t is 1.5, allowed is 0 .. 1.*`clamp`"):
        params.update()
    params = mi.traverse(mi.load_dict(textured(weights)))
    pixels = np.full((4, 8, 3), 0.5, np.float32)
    pixels[2, 5, 1] = np.nan
    params["albedo.data"] = mi.TensorXf(pixels)
    with pytest.raises(Exception, match="texture of albedo at x=5, y=2: albedo is 0.5, nan, 0.5"):
        params.update()


def test_clamp_moves_inputs_to_the_training_range(weights):
    ctx, (si, _) = mi.BSDFContext(), interactions(100)
    wo = mi.Vector3f(0.0, 0.6, 0.8)
    image = np.full((4, 8, 1), 2.0, np.float32)
    limit = mi.load_dict(description(weights, alpha_top=10**-0.5, sigma_t=1.0)).eval(ctx, si, wo)
    for sigma_t in (3.0, bitmap_texture(image)):
        bsdf = mi.load_dict(description(weights, alpha_top=0.9, sigma_t=sigma_t, clamp=True))
        close(bsdf.eval(ctx, si, wo), limit, rtol=2e-3)
    params = mi.traverse(mi.load_dict(description(weights, clamp=True)))
    params["alpha_top"] = 0.9
    params.update()


@pytest.mark.parametrize(
    ("changes", "message"),
    (
        (
            {"alpha_top": 0.9},
            "alpha_top is 0.9, allowed is 0.001 .. 0.316228, the range that the adapter was trained on",
        ),
        ({"alpha_top": 0.9}, "set `clamp` to clamp such values"),
        ({"eta_conductor": rgb([0.1, 9.0, 1.0])}, "eta_conductor is 0.1, 9, 1, allowed is 0.03 .. 7.6"),
        ({"alpha_top": float("nan"), "clamp": True}, "alpha_top is nan"),
        ({"alpha_bottom": texture(np.nan)}, "texture of alpha_bottom at x=5, y=2: alpha_bottom is nan"),
        (
            {"alpha_bottom": texture(np.nan), "clamp": True},
            "texture of alpha_bottom at x=5, y=2: alpha_bottom is nan",
        ),
        ({"sigma_t": texture(1.5)}, "texture of sigma_t at x=5, y=2: sigma_t is 1.5"),
        ({"material": "unobtainium"}, "unobtainium"),
        ({"roughness": 0.3}, "roughness"),
        ({"adapter": "layered9-1x1"}, "layered9-1x1"),
        ({"adapter": "nowhere.safetensors"}, "nowhere.safetensors: no such weights file"),
        ({"adapter": 3}, "adapter"),
        ({"material": 3}, "material needs a name (string), got 3"),
        ({"clamp": "false"}, "clamp needs true or false (boolean), got 'false'"),
    ),
)
def test_wrong_inputs_are_refused(weights, changes, message):
    assert message in load_error(description(weights, **changes))


def test_damaged_weights_are_refused(weights, tmp_path):
    damaged = tmp_path / "damaged.safetensors"
    content = weights.read_bytes()
    for part in (content[:1000], content[: len(content) // 2], b"no weights at all"):
        damaged.write_bytes(part)
        message = load_error(description(damaged))
        assert f"{damaged}: truncated, or not a safetensors file" in message


def test_weights_of_another_class_are_refused(weights, tmp_path):
    with safe_open(weights, framework="numpy") as f:
        metadata, tensors = f.metadata(), {name: f.get_tensor(name) for name in f.keys()}  # noqa: SIM118
    header = json.loads(metadata["nma"]) | {"class_name": "fabric"}
    other = tmp_path / "fabric.safetensors"
    other.write_bytes(save(tensors, metadata={"nma": json.dumps(header)}))
    assert "fabric" in load_error(description(other))


def test_missing_inputs_are_named(weights):
    few = {key: value for key, value in description(weights).items() if key not in ("albedo", "sigma_t")}
    assert "no value for albedo, sigma_t" in load_error(few)


def test_other_variants_are_refused(weights):
    present = {"scalar_spectral", "llvm_ad_spectral", "llvm_ad_mono", "metal_ad_rgb"} & set(mi.variants())
    for variant in present:
        mi.set_variant(variant)
        assert f"not in {variant}" in load_error(description(weights))


def test_xml_and_named_materials(weights):
    scene = mi.load_string(
        f"""<scene version="3.0.0"><shape type="sphere"><bsdf type="nma">
            <string name="adapter" value="{weights}"/> <boolean name="clamp" value="true"/>
            <string name="material" value="gold-red-lacquer"/> <float name="alpha_top" value="0.05"/>
            <rgb name="albedo" value="0.1, 0.2, 0.3"/>
        </bsdf></shape></scene>"""
    )
    bsdf = scene.shapes()[0].bsdf()
    columns = [c.numpy()[0] for c in bsdf.inputs.columns()]
    np.testing.assert_allclose([columns[0], *columns[9:12]], [0.05, 0.1, 0.2, 0.3], rtol=1e-6)
    assert bsdf.inputs.clamp
