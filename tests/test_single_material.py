"""An adapter of one material records the parameters of that material.

Users may leave the parameters out. Parameters that differ from the record are refused.
"""

import json
import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import random_adapter
from source_cases import numbers, pairs

import nma.render
from nma import materials
from nma.adapter import Adapter
from nma.adapter.values import AdapterValues
from nma.errors import ParamError, WeightsError
from nma.images.io import read_image
from nma.params import MEASURED
from nma.render.load import SceneError, load_dict, material_bsdf
from nma.render.textures import bitmap_texture

nma.render.use("llvm_ad_rgb")
GOLD = materials.load("gold-red-lacquer")


def of_gold(**record):
    """Returns an adapter with random weights, with a record of the material "gold under red lacquer"."""
    adapter = random_adapter(hidden="1x8", name="direction")
    return replace(adapter, training={"material": GOLD.name, "params": GOLD.vector().tolist(), **record})


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "gold.safetensors"
    of_gold().save(path)
    return path


def values(description):
    """Evaluates a BSDF for three pairs of directions."""
    bsdf, si = load_dict(description), mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(0.6, 0.0, 0.8)
    wo = mi.Vector3f([0.0, 0.6, -0.6], [0.6, 0.0, 0.0], 0.8)
    return np.array(bsdf.eval(mi.BSDFContext(), si, wo))


def test_the_weights_file_records_its_material(weights):
    np.testing.assert_array_equal(Adapter.load(weights).material, GOLD.vector())
    assert random_adapter().material is None  # an adapter of a whole class
    assert random_adapter(name="direction").material is None  # a file of an older version, without a record


def test_only_the_recorded_material_is_accepted_up_to_rounding(weights):
    adapter, vector = Adapter.load(weights), GOLD.vector()
    np.testing.assert_allclose(adapter.check(vector.astype(np.float32)), vector[None], rtol=1e-6)
    other = vector.copy()
    other[9] *= 1.001
    with pytest.raises(
        ParamError, match="trained for .*gold-red-lacquer, whose albedo is 0.95, 0.08, 0.03, not 0.95095, "
    ):
        adapter.check(np.stack([vector, other]))


@pytest.mark.parametrize(
    "params", [[], [1.0], [[1.0] * 13], ["a"] * 13, {"a": 1}, [-1.0] * 13, [math.nan] * 13]
)
def test_a_record_that_is_no_material_of_the_class_is_refused(tmp_path, params):
    of_gold(params=params).save(tmp_path / "a.safetensors")
    with pytest.raises(
        WeightsError, match="a.safetensors: the recorded material does not fit the class layered3"
    ):
        Adapter.load(tmp_path / "a.safetensors")


def test_the_source_of_an_adapter_needs_no_parameters(weights):
    adapter, wo_wi = Adapter.load(weights), pairs(50)
    own = numbers(AdapterValues(adapter).eval(*wo_wi))
    assert own.max() > 0
    np.testing.assert_array_equal(own, numbers(AdapterValues(adapter, GOLD.vector()).eval(*wo_wi)))
    with pytest.raises(ParamError, match="was trained for a single material"):
        AdapterValues(adapter, materials.load("wet-nickel").vector())


@pytest.mark.parametrize(
    "given",
    [{"material": "gold-red-lacquer"}, {"alpha_top": 0.005}, material_bsdf(GOLD), {"clamp": True}],
    ids=["by name", "a number of it", "all of it", "clamped"],
)
def test_the_bsdf_needs_no_parameters_and_accepts_the_recorded_ones(weights, given):
    alone = values({"type": "nma", "adapter": str(weights)})
    assert alone.min() > 0
    np.testing.assert_array_equal(values({**given, "type": "nma", "adapter": str(weights)}), alone)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"material": "wet-nickel"},
            "was trained for a single material, gold-red-lacquer, whose alpha_top is 0.005, not 0.001",
        ),
        ({"material": "gold-red-lacquer", "sigma_t": 0.5}, "whose sigma_t is 0.6, not 0.5"),
        (
            {"albedo": {"type": "rgb", "value": [0.1, 0.2, 0.3]}},
            "whose albedo is 0.95, 0.08, 0.03, not 0.1, 0.2, 0.3",
        ),
        ({"sigma_t": bitmap_texture(np.full((2, 2), 0.6))}, "sigma_t cannot be textured"),
        ({"sigma_t": 0.5, "clamp": True}, "whose sigma_t is 0.6, not 0.5"),
    ],
)
def test_the_bsdf_refuses_another_material(weights, given, message):
    with pytest.raises(SceneError, match=message):
        load_dict({"type": "nma", "adapter": str(weights), **given})


def test_a_recorded_material_may_lie_beyond_the_training_range_of_its_class(tmp_path):
    vector = GOLD.vector()
    vector[-1] = 3.0
    of_gold(params=vector.tolist()).save(tmp_path / "thick.safetensors")
    assert values({"type": "nma", "adapter": str(tmp_path / "thick.safetensors"), "sigma_t": 3.0}).min() > 0


def test_nma_render_shows_an_adapter_alone_and_refuses_another_material(nma, weights, tmp_path):
    options = ("--size", "8", "--spp", "1")
    for subject in ((weights,), ("gold-red-lacquer", "--adapter", weights)):
        code, _, err = nma("render", *subject, "-o", tmp_path / f"{len(subject)}.exr", *options)
        assert code == 0, err
    np.testing.assert_array_equal(read_image(tmp_path / "1.exr"), read_image(tmp_path / "3.exr"))
    code, _, err = nma("render", "wet-nickel", "--adapter", weights, "-o", tmp_path / "no.exr", *options)
    assert code == 1 and err.count("\n") == 1
    assert "was trained for a single material, gold-red-lacquer" in err
    assert not (tmp_path / "no.exr").exists()


def test_nma_render_needs_a_material_for_the_adapter_of_a_class(nma, tmp_path):
    random_adapter(hidden="1x8").save(tmp_path / "class.safetensors")
    code, _, err = nma("render", tmp_path / "class.safetensors", "-o", tmp_path / "no.exr")
    assert code == 1
    assert "adapter of the whole class layered3; name a material, too: nma render MATERIAL --adapter" in err


@pytest.mark.slow
def test_nma_compare_simulates_the_recorded_material(nma, weights, tmp_path):
    options = ("--size", "16", "--spp", "2", "--json")
    alone = nma("compare", weights, *options)
    assert alone[0] == 0, alone[2]
    assert json.loads(alone[1]) == json.loads(
        nma("compare", "gold-red-lacquer", "--adapter", weights, *options)[1]
    )
    random_adapter(hidden="1x8", name="direction", space=MEASURED).save(tmp_path / "measured.safetensors")
    code, _, err = nma("compare", tmp_path / "measured.safetensors", *options)
    assert code == 1 and "cannot be simulated" in err
