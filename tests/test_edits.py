"""Edits of our BSDFs are checked, take effect at once, compile no new kernel, and work inside frozen functions."""

import gc
import os
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import random_adapter

import nma.render
from nma.errors import NmaError
from nma.jit import dr
from nma.render.textures import bitmap_texture

nma.render.use("llvm_ad_rgb")


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")
    # Frozen functions and errors form reference cycles with scenes, and only the garbage collector frees such scenes.
    # The fixture runs the garbage collector, because Dr.Jit would record the BSDFs of these scenes too.
    gc.collect()


@pytest.fixture(scope="module")
def adapter(tmp_path_factory):
    """The description of a BSDF `nma` with a small adapter, which compiles quickly."""
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    random_adapter(hidden="1x8").save(path)
    return {"type": "nma", "adapter": str(path), "material": "frosted-silver", "clamp": True}


LAYERED = {"type": "layered", "material": "frosted-silver"}
TEXTURE = bitmap_texture(np.full((4, 4, 1), 0.3))


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def scene(bsdf, integrator="path", **more):
    """Loads a scene of a ball under a uniform sky."""
    film = {"type": "hdrfilm", "width": 6, "height": 6, "pixel_format": "rgb", "component_format": "float32"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": 2},
            "sky": {"type": "constant"},
            "sensor": {"type": "perspective", "film": film},
            "ball": {"type": "sphere", "center": [0, 0, 3], "bsdf": bsdf},
            **more,
        }
    )


def picture(loaded, spp=16, seed=0):
    return np.array(mi.render(loaded, spp=spp, seed=seed))


@pytest.fixture
def compiled():
    """A function that calls another function and returns how many kernels this call compiled."""

    def count(function):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            function()
            kernels = dr.kernel_history([dr.KernelType.JIT])
        return sum(not kernel["cache_hit"] for kernel in kernels)

    return count


BESIDE = {
    "plain": lambda adapter: adapter,
    "textured": lambda adapter: adapter | {"alpha_bottom": TEXTURE},
    "layered": lambda adapter: LAYERED,
    "layered, textured": lambda adapter: LAYERED | {"alpha_bottom": TEXTURE},
}


@pytest.mark.parametrize("kind", BESIDE)
def test_an_edit_compiles_nothing(adapter, compiled, kind):
    loaded = scene(BESIDE[kind](adapter))
    before = picture(loaded)
    params = mi.traverse(loaded)

    def edit(value):
        params["ball.bsdf.albedo"] = mi.Color3f(*value)
        params["ball.bsdf.sigma_t"] = value[0]
        params.update()
        return picture(loaded)

    edit((0.5, 0.4, 0.3))  # the first edit may compile a few small kernels
    after = []
    assert compiled(lambda: after.append(edit((0.9, 0.1, 0.2)))) == 0
    assert np.abs(after[0] - before).max() > 0.01
    fresh = scene(BESIDE[kind](adapter) | {"albedo": rgb(0.9, 0.1, 0.2), "sigma_t": 0.9})
    np.testing.assert_allclose(after[0], picture(fresh), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", BESIDE)
def test_materials_of_one_structure_share_a_kernel(adapter, compiled, kind):
    def show(number):
        value = 0.1 + 0.2 * number
        bsdf = BESIDE[kind](adapter) | {
            "alpha_top": 0.1 * value,
            "albedo": rgb(value, 0.5, 0.3),
            "sigma_t": value,
        }
        return picture(scene(bsdf))

    show(0)
    assert compiled(lambda: [show(number) for number in (1, 2, 3)]) == 0


def test_loading_many_materials_leaves_memory_flat():
    """200 materials with an adapter of 19,000 weights take less than 10 MB, because they share the weights."""
    memory = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")  # noqa: E731
    make = lambda: mi.load_dict({"type": "nma", "material": "gold-red-lacquer"})  # noqa: E731
    kept = [make() for _ in range(3)]
    before = memory()
    kept += [make() for _ in range(200)]
    assert len(kept) == 203
    assert memory() - before < 10e6


@pytest.mark.parametrize("kind", [*BESIDE, "blendbsdf"])
def test_frozen_functions_render_edited_values(adapter, kind):
    """A frozen function renders with parameter values that are set before the call or inside the function.

    The function is recorded at most twice.
    """
    blend = {"type": "blendbsdf", "weight": 0.3, "a": adapter | {"alpha_bottom": TEXTURE}, "b": LAYERED}
    loaded = scene(blend if kind == "blendbsdf" else BESIDE[kind](adapter))
    params = mi.traverse(loaded)
    key = "ball.bsdf.bsdf_0.sigma_t" if kind == "blendbsdf" else "ball.bsdf.sigma_t"
    numbers = [dr.opaque(mi.Float, x) for x in (0.2, 0.5, 0.9)]

    def set_and_render(loaded, value):
        params[key] = value
        params.update()
        return mi.render(loaded, spp=16)

    frozen = dr.freeze(lambda loaded: mi.render(loaded, spp=16))
    expected = []
    for value in numbers:
        expected.append(np.array(set_and_render(loaded, value)))
        np.testing.assert_allclose(frozen(loaded), expected[-1], rtol=1e-4, atol=1e-5)
    assert np.abs(expected[0] - expected[2]).max() > 0.005
    inside = dr.freeze(set_and_render)
    for value, wanted in zip(numbers, expected, strict=True):
        np.testing.assert_allclose(inside(loaded, value), wanted, rtol=1e-4, atol=1e-5)
    assert max(inside.n_recordings, frozen.n_recordings) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ("plain", "textured"))
def test_frozen_functions_see_derivatives_of_numbers_set_before(adapter, kind):
    """With and without `dr.freeze`, a function returns equal derivatives with respect to `sigma_t`, within 2 %.

    `sigma_t` is set before the function is called. An untextured material precomputes curves of its target parameters,
    also before the call, so that the frozen function receives both `sigma_t` and the curves.
    """

    def derive(loaded, params):
        dr.backward(dr.mean(mi.render(loaded, params, spp=64), axis=None))
        return dr.grad(params["ball.bsdf.sigma_t"])

    loaded = scene(BESIDE[kind](adapter), "prb")
    params = mi.traverse(loaded)
    gradients = []
    for function in (derive, dr.freeze(derive)):
        for value in (0.3, 0.7):
            sigma_t = dr.opaque(mi.Float, value)
            dr.enable_grad(sigma_t)
            params["ball.bsdf.sigma_t"] = sigma_t
            params.update()
            gradients.append(function(loaded, params)[0])
    assert abs(gradients[0]) > 1e-3
    np.testing.assert_allclose(gradients[2:], gradients[:2], rtol=0.02)


def refused(function, message):
    with pytest.raises((NmaError, RuntimeError)) as error:
        function()
    causes, cause = [], error.value
    while cause is not None:
        causes.append(str(cause))
        cause = cause.__cause__
    assert message in "\n".join(causes)


WRONG_AT_LOAD = {
    "nma": lambda adapter: adapter | {"sigma_t": "thick"},
    "layered": lambda adapter: LAYERED | {"sigma_t": -1.0},
    "values": lambda adapter: {"type": "values", "file": "nowhere.npz"},
}


@pytest.mark.parametrize("kind", WRONG_AT_LOAD)
def test_a_refused_bsdf_does_not_stop_other_scenes(adapter, kind):
    """Scenes still render while an error object keeps a reference to a BSDF that was refused.

    Notebooks, for example, keep the last error object.
    """
    expected = picture(scene(LAYERED))
    with pytest.raises(RuntimeError) as error:
        mi.load_dict(WRONG_AT_LOAD[kind](adapter))
    # The film adds samples in random order, so that pictures of the same scene differ by rounding.
    np.testing.assert_allclose(picture(scene(LAYERED)), expected, rtol=1e-5)
    assert error.value.__traceback__ is not None


WRONG = {
    "a number": ({}, "sigma_t", -1.0, "sigma_t is -1"),
    "a colour": ({}, "albedo", mi.Color3f(0.5, 3.0, 0.5), "albedo is 0.5, 3, 0.5"),
    "a pixel": (
        {"albedo": bitmap_texture(np.full((2, 2, 3), 0.5))},
        "albedo.data",
        None,
        "albedo at x=1, y=0: albedo is 3, allowed is 0 .. 1",
    ),
}


@pytest.mark.parametrize("kind", ("nma", "layered"))
@pytest.mark.parametrize("what", WRONG)
def test_wrong_edits_are_refused_and_not_rendered(adapter, kind, what):
    changes, key, value, message = WRONG[what]
    loaded = scene((adapter | {"clamp": False} if kind == "nma" else LAYERED) | changes)
    before, params = picture(loaded), mi.traverse(loaded)
    key = f"ball.bsdf.{key}"
    good = type(params[key])(params[key])
    if value is None:
        pixels = np.full((2, 2, 3), 0.5, np.float32)
        pixels[0, 1] = 3.0
        value = mi.TensorXf(pixels)
    params[key] = value
    refused(params.update, message)
    np.testing.assert_array_equal(params[key], good)
    np.testing.assert_allclose(picture(loaded), before, rtol=1e-5)


@pytest.mark.parametrize("kind", BESIDE)
def test_of_several_edits_only_the_wrong_ones_are_undone(adapter, kind):
    """If an update has several edits, edits with wrong values are undone, and all correct edits take effect."""
    bsdf = BESIDE[kind](adapter)
    bsdf = bsdf if "layered" in kind else bsdf | {"clamp": False}
    loaded = scene(bsdf)
    params, edited = mi.traverse(loaded), {"alpha_top": -1.0, "sigma_t": 0.9, "eta_top": 99.0}
    before = {name: np.array(params[f"ball.bsdf.{name}"]) for name in edited}
    for name, value in edited.items():
        params[f"ball.bsdf.{name}"] = value
    refused(params.update, "alpha_top is -1")
    for name in ("alpha_top", "eta_top"):
        np.testing.assert_array_equal(params[f"ball.bsdf.{name}"], before[name])
    expected = picture(scene(bsdf | {"sigma_t": 0.9}))
    np.testing.assert_allclose(picture(loaded), expected, rtol=1e-4, atol=1e-5)


def test_values_that_frozen_functions_set_are_clamped(adapter):
    """If a frozen function sets a value beyond its bounds, the picture shows the nearest allowed value.

    Later renderings outside of the frozen function also show the clamped value.
    """
    loaded = scene(adapter | {"clamp": False})
    params = mi.traverse(loaded)

    @dr.freeze
    def render(loaded, params, value):
        params["ball.bsdf.sigma_t"] = value
        params.update()
        return mi.render(loaded, spp=16)

    expected = picture(scene(adapter | {"sigma_t": 1.0}))
    for value in (0.5, 5.0):
        found = np.array(render(loaded, params, dr.opaque(mi.Float, value)))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(picture(loaded), expected, rtol=1e-4, atol=1e-5)


def shared_key(params, leaf):
    """Returns the key in `params` of a texture that two objects share. The key begins with the first object's name."""
    (key,) = (key for key in params.keys() if key.endswith(f".{leaf}") and "sky" not in key)  # noqa: SIM118
    return key


@pytest.mark.parametrize("kind", ("nma", pytest.param("layered", marks=pytest.mark.slow)))
def test_edits_of_shared_textures_show_and_are_checked(adapter, kind):
    """Our BSDF uses and checks the edits of a texture that it shares with another object.

    When the shared texture is edited, Mitsuba notifies only the other object.
    """
    shared = {"type": "ref", "id": "shared"}
    first = {"type": "sphere", "center": [0, 0, -9], "bsdf": {"type": "diffuse", "reflectance": shared}}
    colours = ([0.1, 0.5, 0.9], [0.9, 0.1, 0.1])
    image = lambda colour: bitmap_texture(np.broadcast_to(np.array(colour), (2, 2, 3)))  # noqa: E731
    for make, leaf in ((lambda c: {"type": "srgb", "color": c}, "value"), (image, "data")):
        bsdf = (adapter if kind == "nma" else LAYERED) | {"albedo": shared}
        loaded = scene(bsdf, shared=make(colours[0]), a_first=first)
        params = mi.traverse(loaded)
        start, key = picture(loaded), shared_key(params, leaf)
        kind_of = type(params[key])
        params[key] = (
            kind_of(np.broadcast_to(np.float32(colours[1]), (2, 2, 3)))
            if leaf == "data"
            else kind_of(*colours[1])
        )
        params.update()
        expected = scene(bsdf, shared=make(colours[1]), a_first=first)
        found = picture(loaded)
        np.testing.assert_allclose(found, picture(expected), rtol=1e-4, atol=1e-5)
        assert np.abs(found - start).max() > 0.02
        params[key] = kind_of(np.full((2, 2, 3), np.nan, np.float32)) if leaf == "data" else kind_of(np.nan)

        def update_and_render(loaded=loaded, params=params):
            params.update()  # Mitsuba notifies only the diffuse sphere
            picture(loaded)

        refused(update_and_render, "albedo")
        np.testing.assert_allclose(picture(loaded), found, rtol=1e-5)


def test_shared_constants_have_gradients(adapter):
    shared = {"type": "ref", "id": "shared"}
    loaded = scene(adapter | {"albedo": shared}, "prb", shared={"type": "srgb", "color": [0.1, 0.5, 0.9]})
    params = mi.traverse(loaded)
    key = shared_key(params, "value")
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(loaded, params, spp=16), axis=None))
    assert (np.abs(np.array(dr.grad(params[key]))) > 1e-4).all()


@pytest.mark.parametrize("clamp", (False, True))
@pytest.mark.parametrize("textured", (False, True))
def test_values_on_a_bound_have_gradients(adapter, clamp, textured):
    """The derivative with respect to a parameter is the same on the parameter's lower bound and just above, within 5 %.

    A failure means that an optimisation cannot change black texels.
    """
    gradients = []
    for value in (0.0, 1e-3):
        sigma_t = bitmap_texture(np.full((2, 2, 1), value)) if textured else value
        loaded = scene(adapter | {"sigma_t": sigma_t, "clamp": clamp}, "prb")
        params = mi.traverse(loaded)
        key = "ball.bsdf.sigma_t.data" if textured else "ball.bsdf.sigma_t"
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(loaded, params, spp=32), axis=None))
        gradients.append(np.array(dr.grad(params[key])).sum())
    assert abs(gradients[0]) > 1e-3
    assert gradients[0] == pytest.approx(gradients[1], rel=0.05)


@pytest.mark.parametrize("kind", ("nma", "layered"))
def test_attributes_are_the_inputs(adapter, kind):
    bsdf = mi.load_dict(
        (adapter if kind == "nma" else LAYERED) | {"sigma_t": TEXTURE, "albedo": rgb(0.9, 0.2, 0.1)}
    )
    si = dr.zeros(mi.SurfaceInteraction3f)
    assert all(bsdf.has_attribute(name) for name in ("alpha_top", "sigma_t", "albedo"))
    assert not bsdf.has_attribute("reflectance")
    assert bsdf.eval_attribute_1("sigma_t", si)[0] == pytest.approx(0.3)
    # For a colour, `eval_attribute_1` returns the mean of the channels, as Mitsuba's `principled` does.
    mitsubas = mi.load_dict({"type": "principled", "base_color": rgb(0.9, 0.2, 0.1)})
    for found, name in ((bsdf, "albedo"), (mitsubas, "base_color")):
        assert found.eval_attribute_1(name, si)[0] == pytest.approx(0.4)
    alpha_top = np.array(mi.traverse(bsdf)["alpha_top"])[0]
    np.testing.assert_allclose(np.ravel(bsdf.eval_attribute("alpha_top", si)), [alpha_top] * 3)
    np.testing.assert_allclose(np.ravel(bsdf.eval_attribute_3("albedo", si)), [0.9, 0.2, 0.1], rtol=1e-6)
