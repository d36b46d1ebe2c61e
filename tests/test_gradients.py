"""Derivatives of pictures with respect to parameters equal finite differences, and optimisation recovers a texture."""

import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import random_adapter

import nma.render
from nma.jit import dr
from nma.render.textures import bitmap_texture

nma.render.use("llvm_ad_rgb")


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def grains(channels, seed=0):
    return np.random.default_rng(seed).uniform(0.3, 0.8, (3, 4, channels))


MATERIAL = {
    "type": "nma",
    "adapter": "layered3-3x32",
    "alpha_top": 0.2,
    "alpha_bottom": 0.4,
    "eta_top": 1.5,
    "eta_conductor": rgb(0.2, 0.92, 1.1),
    "k_conductor": rgb(3.9, 2.45, 2.14),
    "albedo": rgb(0.8, 0.4, 0.3),
    "sigma_t": 0.7,
}
# Each case is a material and a dictionary of directional derivatives to test. A derivative is given by the name of a
# parameter and the direction in which the parameter changes.
CASES = {
    "plain": (
        MATERIAL,
        {
            "sigma_t": np.ones(1),
            "alpha_bottom": np.ones(1),
            "albedo": np.array([0.2, 1.0, -0.6]),
            "eta_conductor": np.array([0.3, 1.0, -0.5]),
        },
    ),
    "textured": (
        MATERIAL | {"albedo": bitmap_texture(grains(3)), "sigma_t": bitmap_texture(grains(1))},
        {"sigma_t.data": grains(1, seed=1), "albedo.data": grains(3, seed=1), "eta_top": np.ones(1)},
    ),
}


def scene(bsdf, depth, sky, beside=None):
    """Loads a scene of a ball on a floor of the same material, under a point light.

    `sky` is the radiance of a uniform sky. `beside` is the material of a second ball, if given.
    """
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at([0.0, -3.0, 2.5], [0.0, 0.0, 0.4], [0.0, 0.0, 1.0])
    same = {"type": "ref", "id": "material"}
    description = {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": depth},
        "sensor": {"type": "perspective", "fov": 35, "to_world": look, "film": film},
        "lamp": {"type": "point", "position": [1.5, -2.0, 3.0], "intensity": 10.0},
        "material": bsdf,
        "floor": {"type": "rectangle", "bsdf": same},
        "ball": {"type": "sphere", "center": [0.0, 0.0, 0.5], "radius": 0.5, "bsdf": same},
    }
    if beside:
        description["other"] = {"type": "sphere", "center": [0.9, 0.0, 0.3], "radius": 0.3, "bsdf": beside}
    if sky:
        description["sky"] = {"type": "constant", "radiance": sky}
    return mi.load_dict(description)


def replaced(params, key, value):
    """Sets a parameter to `value`, converted to the parameter's type.

    Enables derivatives with respect to the parameter and resets the accumulated derivative to zero.
    """
    kind = type(params[key])
    numbers = np.asarray(value, np.float32)
    params[key] = kind(numbers) if kind is mi.TensorXf else kind(numbers.ravel().tolist())
    dr.enable_grad(params[key])


def slopes(loaded, directions, step, spp, seeds):
    """Returns directional derivatives of a picture's mean, by the integrator `prb` and by central differences.

    `directions` maps the name of a parameter to a direction in which its values change. Derivatives and differences are
    dictionaries with the same keys, whose values are arrays (seeds,).
    """
    params = mi.traverse(loaded)
    start = {key: np.array(params[key], np.float64).reshape(d.shape) for key, d in directions.items()}
    derivatives = {key: [] for key in directions}
    for seed in range(1, seeds + 1):
        for key, value in start.items():
            replaced(params, key, value)
        params.update()
        # `seed_grad` is the seed of the pass that computes derivatives. Pictures for the central differences use the
        # value of `seed_grad` as their seed.
        picture = mi.render(loaded, params, spp=spp, seed=seeds + seed, seed_grad=seed)
        dr.backward(dr.mean(picture, axis=None))
        for key, d in directions.items():
            derivatives[key].append((np.array(dr.grad(params[key])).reshape(d.shape) * d).sum())

    def mean(key, value, seed):
        replaced(params, key, value)
        params.update()
        with dr.suspend_grad():
            return np.array(mi.render(loaded, spp=spp, seed=seed), np.float64).mean()

    differences = {}
    for key, d in directions.items():
        up, down = ([mean(key, start[key] + s * d, n + 1) for n in range(seeds)] for s in (step, -step))
        differences[key] = (np.array(up) - np.array(down)) / (2.0 * step)
        mean(key, start[key], 1)
    return {key: np.array(value) for key, value in derivatives.items()}, differences


def case(name, folder):
    """Returns the material of a case in CASES, and the directions in which its parameters change.

    The textured material gets a small random adapter, whose derivatives are large.
    """
    bsdf, directions = CASES[name]
    if name == "textured":
        random_adapter(hidden="2x8", seed=5).save(folder / "small.safetensors")
        bsdf = bsdf | {"adapter": str(folder / "small.safetensors")}
    return bsdf, directions


@pytest.mark.parametrize("name", ("plain", pytest.param("textured", marks=pytest.mark.slow)))
def test_gradients_of_direct_light_are_finite_differences(name, tmp_path):
    """Derivatives equal finite differences within 1 %, for direct light from one point light.

    The renderings use random numbers only for positions in the pixels. Derivatives and finite differences use the same
    random numbers.
    """
    bsdf, directions = case(name, tmp_path)
    directions = {f"material.{key}": d for key, d in directions.items()}
    derivatives, differences = slopes(scene(bsdf, depth=2, sky=0.0), directions, 0.001, spp=16, seeds=2)
    for key, expected in differences.items():
        np.testing.assert_allclose(derivatives[key], expected, rtol=0.01, err_msg=key)
        assert np.abs(expected).min() > 1e-4


@pytest.mark.parametrize("before", (False, True), ids=("alone", "after a call without derivatives"))
def test_a_call_with_derivatives_does_not_reuse_a_brdf_without_derivatives(before, tmp_path):
    """While Dr.Jit records a kernel, a call inside `dr.suspend_grad` and the next call have the same arguments.

    The BSDF keeps the BRDF of the first call. A failure means that the next call uses this BRDF and has no derivatives.
    """
    bsdf, _ = case("textured", tmp_path)
    loaded, ctx, wo = mi.load_dict(bsdf), mi.BSDFContext(), mi.Vector3f(0.0, 0.6, 0.8)
    params = mi.traverse(loaded)
    dr.enable_grad(params["albedo.data"])
    params.update()

    def recorded(si):
        if before:
            with dr.suspend_grad():
                loaded.eval(ctx, si, wo)
        return loaded.eval(ctx, si, wo).x

    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.wi = dr.opaque(mi.Vector3f, (0.6, 0.0, 0.8), 2)
    value = dr.switch(dr.arange(mi.UInt32, 2), [recorded, lambda si: mi.Float(0.0)], si)
    dr.backward(value)
    assert np.abs(np.array(dr.grad(params["albedo.data"]))).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_gradients_of_all_light_are_finite_differences(name, tmp_path):
    """Derivatives equal finite differences within four standard errors over 8 seeds, with indirect light.

    Random sampling makes derivatives and differences noisy, so they are compared by t-tests. The false-alarm rate over
    all comparisons together is .007.
    """
    bsdf, directions = case(name, tmp_path)
    directions = {f"material.{key}": d for key, d in directions.items()}
    derivatives, differences = slopes(scene(bsdf, depth=4, sky=0.5), directions, 0.01, spp=128, seeds=8)
    for key, expected in differences.items():
        found = derivatives[key]
        error = np.sqrt((found.var(ddof=1) + expected.var(ddof=1)) / 8)
        assert abs(found.mean() - expected.mean()) < 4.0 * error, key
        # The noise is small enough that the test detects a derivative that is 50 % off.
        assert error < 0.1 * abs(expected.mean()), key


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("blended", (False, True), ids=("alone", "blended"))
def test_forward_and_backward_derivatives_agree(name, blended, tmp_path):
    """Forward-mode and reverse-mode derivatives agree within 1e-3 in a scene of several BSDFs.

    Dr.Jit traces each BSDF as a separate function call, and derivatives must propagate into and out of these calls.
    """
    bsdf, directions = case(name, tmp_path)
    within, key = (
        ("material.bsdf_0.", next(iter(directions))) if blended else ("material.", next(iter(directions)))
    )
    mixed = {"type": "blendbsdf", "weight": 0.3, "a": bsdf, "b": {"type": "diffuse"}}
    loaded = scene(mixed if blended else bsdf, depth=3, sky=0.5, beside={"type": "diffuse"})
    params, found = mi.traverse(loaded), []
    for forward in (True, False):
        amount = dr.opaque(mi.Float, 0.0)
        dr.enable_grad(amount)
        value = params[within + key]
        flat = value.array if isinstance(value, mi.TensorXf) else value
        params[within + key] = (
            mi.TensorXf(flat + amount, value.shape) if flat is not value else value + amount
        )
        params.update()
        mean = dr.mean(mi.render(loaded, params, spp=16, seed=1), axis=None)
        if forward:
            dr.forward(amount)
        else:
            dr.backward(mean)
        found.append(np.array(dr.grad(mean if forward else amount)).item())
        params[within + key] = dr.detach(value)
    assert abs(found[0]) > 1e-3
    assert found[0] == pytest.approx(found[1], rel=1e-3)


@pytest.mark.slow
def test_optimisation_finds_a_texture():
    """Optimisation recovers the albedo texture of a sheet under a uniform sky.

    The 27 values of the recovered texture differ from the true values by less than .02 on average and .08 at worst.
    """
    wanted = np.random.default_rng(2).uniform(0.1, 0.9, (3, 3, 3))
    bsdf = MATERIAL | {"sigma_t": 1.0, "albedo": bitmap_texture(np.full((3, 3, 3), 0.5))}
    look = mi.ScalarTransform4f().look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 2},
            "sensor": {"type": "perspective", "fov": 28, "to_world": look, "film": film},
            "sky": {"type": "constant"},
            "sheet": {"type": "rectangle", "bsdf": bsdf},
        }
    )
    params, key = mi.traverse(loaded), "sheet.bsdf.albedo.data"
    replaced(params, key, wanted)
    params.update()
    with dr.suspend_grad():
        target = mi.render(loaded, spp=256, seed=0)

    replaced(params, key, np.full((3, 3, 3), 0.5))
    optimiser = mi.ad.Adam(lr=0.15, params={key: params[key]})
    for step in range(30):
        params.update(optimiser)
        picture = mi.render(loaded, params, spp=16, seed=1 + step)
        dr.backward(dr.mean(dr.square(picture - target), axis=None))
        optimiser.set_learning_rate(0.15 * 0.91**step)
        optimiser.step()
        optimiser[key] = dr.clip(optimiser[key], 0.0, 1.0)
    error = np.abs(np.array(optimiser[key]) - wanted)
    assert error.mean() < 0.02
    assert error.max() < 0.08
