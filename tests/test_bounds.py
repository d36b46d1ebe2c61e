"""All ways to give a parameter (file, command line, scene, edit) have the same bounds, tolerance and error message."""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import random_adapter
from material_cases import write_image
from runtime_cases import pointer

import nma.render
from nma import materials, sources
from nma.errors import NmaError
from nma.native.runtime import Runtime
from nma.params import LAYERED3, ROUNDING, Bounds
from nma.render.textures import bitmap_texture

nma.render.use("llvm_ad_rgb")

PLAIN = {"alpha_top": 0.1, "alpha_bottom": 0.2, "eta_top": 1.5, "eta_conductor": 1.0, "k_conductor": 3.0}
PLAIN |= {"albedo": 0.5, "sigma_t": 0.25}
NAMES = ("alpha_top", "eta_top", "albedo", "sigma_t")
INFINITE = [float("nan"), float("inf"), -float("inf")]


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")


@pytest.fixture(scope="module")
def adapter(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    random_adapter(hidden="1x8").save(path)
    return path


def pixels(name, value):
    """Returns an image of 3 x 4 correct pixels, with the pixel at x=2, y=1 replaced by `value`."""
    image = np.full((3, 4, LAYERED3[name].size), PLAIN[name], np.float32)
    image[1, 2] = value
    return image


def text(value):
    return str(value).replace("(", "[").replace(")", "]")


class Entries:
    """All ways to give a parameter, as methods.

    Each method takes the parameter's name and value, and raises an error if the value is refused.
    """

    def __init__(self, folder, adapter, material_file, command):
        self.folder, self.adapter, self.material_file, self.command = folder, adapter, material_file, command

    def vector(self, name, value):
        LAYERED3.check(LAYERED3.vector(PLAIN | {name: value}))

    def number_of_a_file(self, name, value):
        materials.load(self.material_file(f"{name} = {PLAIN[name]}", f"{name} = {text(value)}"))

    def texture_of_a_file(self, name, value):
        write_image(self.folder / "image.exr", pixels(name, value))
        given = f"{name} = {{ texture = 'image.exr' }}"
        materials.load(self.material_file(f"{name} = {PLAIN[name]}", given)).values[name].read()

    def command_line(self, name, value):
        material = self.material_file()
        given = ",".join(map(str, np.ravel(value)))
        status, _, said = self.command("render", material, "--set", f"{name}={given}", "--mesh", "none.ply")
        # If the value is allowed, the command fails at a later step, because the mesh file none.ply does not exist.
        if status and "none.ply" not in said:
            raise NmaError(" ".join(said.split()))

    def number_of_a_scene(self, name, value):
        load({name: property_of(value)})

    def texture_of_a_scene(self, name, value):
        load({name: bitmap_texture(pixels(name, value))})

    def edit_of_a_number(self, name, value):
        edit(load({}), name, type_of(name)(value))

    def edit_of_a_texture(self, name, value):
        edit(
            load({name: bitmap_texture(pixels(name, PLAIN[name]))}),
            f"{name}.data",
            mi.TensorXf(pixels(name, value)),
        )


class TrainedEntries(Entries):
    """All ways to give a parameter to an adapter. The value must lie in the training range of the adapter."""

    def vector(self, name, value):
        nma.Adapter.load(self.adapter).check(LAYERED3.vector(PLAIN | {name: value}))

    def batch(self, name, value):
        row = LAYERED3.vector(PLAIN | {name: value})[None].astype(np.float32)
        Runtime(self.adapter).prepare(row, np.ones(1, np.float32))

    def number_of_a_scene(self, name, value):
        load({name: property_of(value)}, type="nma", adapter=str(self.adapter))

    def texture_of_a_scene(self, name, value):
        load({name: bitmap_texture(pixels(name, value))}, type="nma", adapter=str(self.adapter))

    def edit_of_a_number(self, name, value):
        edit(load({}, type="nma", adapter=str(self.adapter)), name, type_of(name)(value))


def load(changes, **settings):
    given = {name: property_of(value) for name, value in PLAIN.items()}
    return mi.load_dict({"type": "layered"} | given | settings | changes)


def property_of(value):
    return {"type": "rgb", "value": list(value)} if isinstance(value, tuple) else value


def type_of(name):
    return mi.Float if LAYERED3[name].size == 1 else mi.Color3f


def edit(bsdf, name, value):
    params = mi.traverse(bsdf)
    params[name] = value
    params.update()


VALID = [way for way in vars(Entries) if not way.startswith("_")]
TRAINED = [way for way in vars(TrainedEntries) if not way.startswith("_")]
WAYS = [("valid", way) for way in VALID] + [("training", way) for way in TRAINED]


@pytest.fixture
def give(tmp_path, adapter, material_file, nma):
    def way(kind, name):
        entries = Entries if kind == "valid" else TrainedEntries
        return getattr(entries(tmp_path, adapter, material_file, nma), name)

    return way


def beyond(kind, steps):
    """Yields (name, value) with values that lie `steps` tolerances beyond the lower or the upper bound.

    If the parameter is a colour, only one of its channels lies beyond its bound.
    """
    for name in NAMES:
        low, high = LAYERED3[name].bounds(kind)
        slack = steps * ROUNDING * min(high - low, 1.0)
        for value in (low - slack, high + slack):
            # Skips values that single precision rounds back onto the bound.
            if float(np.float32(value)) != float(np.float32(low if value < low else high)):
                yield name, value if LAYERED3[name].size == 1 else (PLAIN[name], value, PLAIN[name])


def wrong(kind):
    yield from beyond(kind, 3)
    for value in INFINITE:
        yield "alpha_top", value
        yield "albedo", (0.5, value, 0.25)


@pytest.mark.parametrize(("kind", "way"), WAYS)
def test_a_wrong_value_is_refused_in_one_sentence_wherever_it_is_given(give, kind, way):
    for name, value in wrong(kind):
        with pytest.raises((NmaError, RuntimeError)) as error:
            give(kind, way)(name, value)
        found = value[1] if way == "batch" and isinstance(value, tuple) else value
        said = LAYERED3[name].bounds(kind).refusal(name, np.float32(found), kind)
        assert number_free(said) in number_free(" ".join(str(error.value).split())), (name, value)


def number_free(message):
    """Removes the digits that come from rounding to single precision, as in 1.000003."""
    return re.sub(r"(\d\.\d{5})\d+", r"\1", message)


@pytest.mark.parametrize(("kind", "way"), WAYS)
def test_a_rounding_error_is_allowed_wherever_it_is_given(give, kind, way):
    for name, value in beyond(kind, 0.5):
        give(kind, way)(name, value)


@pytest.mark.parametrize("kind", ("training", "valid"))
@pytest.mark.parametrize("name", sources.classes())
def test_single_precision_keeps_bounds_within_the_tolerance(name, kind):
    for param in sources.space(name).params:
        bounds = param.bounds(kind)
        ends = np.array(bounds, np.float32)
        assert not bounds.bad(ends).any() and not bounds.bad(ends.astype(np.float64)).any()


@pytest.mark.parametrize(("low", "high", "slack"), [(0.0, 1.0, 1e-6), (0.2, 0.3, 1e-7), (-5.0, 1000.0, 1e-6)])
def test_the_tolerance_is_1e_6_or_1e_6_of_a_narrower_range(low, high, slack):
    bounds = Bounds(low, high)
    assert not bounds.bad(np.array([low - 0.9 * slack, high + 0.9 * slack])).any()
    assert bounds.bad(np.array([low - 1.1 * slack, high + 1.1 * slack])).all()


def test_numpy_and_drjit_agree_on_bad_values_and_on_clamped_values():
    bounds = Bounds(0.001, 0.5)
    x = np.array([0.0, 0.001, 0.25, 0.5, 0.6, *INFINITE], np.float32)
    lanes = mi.Float(x)
    for clamp in (False, True):
        np.testing.assert_array_equal(bounds.bad(x, clamp), bounds.bad(lanes, clamp).numpy())
    assert bounds.bad(x).tolist() == [True, False, False, False, True, True, True, True]
    assert bounds.bad(x, clamp=True).tolist() == [False] * 5 + [True] * 3
    np.testing.assert_array_equal(bounds.moved(x), bounds.moved(lanes).numpy())
    moved = [0.001, 0.001, 0.25, 0.5, 0.5, 0.001, 0.5, 0.001]
    np.testing.assert_allclose(bounds.moved(x), moved)


def test_the_derivative_of_clamping_is_1_on_a_bound():
    x = mi.Float([-1.0, 0.0, 0.5, 1.0, 2.0])
    dr.enable_grad(x)
    dr.backward(Bounds(0.0, 1.0).moved(x))
    np.testing.assert_array_equal(x.grad.numpy(), [0, 1, 1, 1, 0])


def test_cpp_allows_the_same_values(adapter):
    runtime = Runtime(adapter)
    for steps, known in ((0.8, True), (1.2, False)):
        for name, value in beyond("training", steps):
            row = LAYERED3.vector(PLAIN | {name: value}).astype(np.float32)
            found = runtime._c.nma_check(runtime._handle, pointer(row))
            assert (found == -1) == known, (name, value)
