"""Decoding of raw network outputs to blends, and encoding of blends to raw outputs."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from nma.errors import WeightsError
from nma.ops import Vec3
from nma.target import (
    PRINCIPLED_PARAMS,
    STRETCHED_PARAMS,
    Blend,
    Principled,
    TargetParam,
    decode,
    encode,
    from_numbers,
    lobe_alphas,
    numbers,
    output_size,
)
from nma.target.decode import instance_size, params_from_json, params_to_json

FULL = (*PRINCIPLED_PARAMS, TargetParam("anisotropic"), TargetParam("flatness"))


def raw_outputs(n_instances, scale=3.0, params=PRINCIPLED_PARAMS):
    rng = np.random.default_rng(21)
    return list(rng.normal(size=(output_size(n_instances, params), 200)) * scale)


def test_sizes_are_those_of_the_paper():
    assert instance_size() == 11
    assert [output_size(n) for n in (1, 2, 3, 5)] == [11, 23, 35, 59]
    assert output_size(2, FULL) == 27


def test_declared_fields_exist_in_the_order_of_the_paper():
    names = [p.name for p in PRINCIPLED_PARAMS]
    assert tuple(names) == Principled._fields[: len(names)]


@pytest.mark.parametrize("n_instances", (1, 2, 3, 5))
def test_any_raw_output_is_a_valid_blend(n_instances):
    blend = decode(raw_outputs(n_instances, scale=1e3), n_instances)
    assert len(blend.instances) == n_instances
    np.testing.assert_allclose(sum(blend.weights), 1.0, rtol=1e-12)
    assert all(np.all(np.asarray(w) >= 0) for w in blend.weights)
    for p in blend.instances:
        for param in PRINCIPLED_PARAMS:
            value = np.asarray(getattr(p, param.name))
            assert np.all(value >= param.low * (1 - 1e-12))
            assert np.all(value <= param.high * (1 + 1e-12))
        assert p.anisotropic == 0.0
        assert p.flatness == 0.0


def test_a_raw_output_of_zero_is_the_middle_of_its_range():
    blend = decode([0.0] * 23, 2)
    p = blend.instances[0]
    assert p.base_color == Vec3(0.5, 0.5, 0.5)
    assert p.specular == pytest.approx(0.8)
    assert p.roughness == pytest.approx(0.001**0.25)
    assert blend.weights == (0.5, 0.5)


def test_the_blend_weight_is_that_of_the_first_instance():
    assert decode([0.0] * 22 + [30.0], 2).weights[0] == pytest.approx(1.0)
    assert decode([0.0] * 22 + [-30.0], 2).weights[1] == pytest.approx(1.0)


def test_roughness_reaches_the_lower_bound_of_alpha():
    sharp = decode([-40.0] * 23, 2)
    assert lobe_alphas(sharp)[0] == pytest.approx((0.001, 0.001, 0.1))
    wide = decode([40.0] * 23, 2)
    assert lobe_alphas(wide)[1] == pytest.approx((1.0, 1.0, 0.001))


@pytest.mark.parametrize("params", (PRINCIPLED_PARAMS, FULL))
@pytest.mark.parametrize("n_instances", (1, 2, 4))
def test_encode_inverts_decode(n_instances, params):
    raw = raw_outputs(n_instances, scale=2.0, params=params)
    again = encode(decode(raw, n_instances, params), params)
    np.testing.assert_allclose(np.stack(again), np.stack(raw), atol=1e-6)


def test_encode_is_finite_at_the_ends_of_ranges():
    p = Principled(Vec3(0.0, 1.0, 0.5), 0.0, 1.0, 1.6, 0.0, 0.0, 0.0, 1.0, 1.0)
    raw = encode(Blend((p, p), (1.0, 0.0)))
    assert np.all(np.isfinite(raw))
    assert decode(raw, 2).instances[0].metallic == pytest.approx(1.0, abs=1e-5)
    # If the first weight is 1, the other two weights are 0, and their ratio is undefined.
    assert np.all(np.isfinite(encode(Blend((p, p, p), (1.0, 0.0, 0.0)))))


@pytest.mark.parametrize("n_instances", (1, 2, 4))
def test_a_blend_is_the_same_after_conversion_to_numbers_and_back(n_instances):
    blend = decode(raw_outputs(n_instances), n_instances)
    flat = numbers(blend)
    assert len(flat) == output_size(n_instances)
    again = from_numbers(flat)
    np.testing.assert_allclose(np.stack(numbers(again)), np.stack(flat))
    np.testing.assert_allclose(again.weights[-1], blend.weights[-1], atol=1e-12)


def test_mixtures_of_numbers_are_valid_blends():
    a, b = (numbers(decode(raw_outputs(3, scale), 3)) for scale in (2.0, 5.0))
    mixed = from_numbers([0.3 * x + 0.7 * y for x, y in zip(a, b, strict=True)])
    assert all(np.all(w > -1e-12) for w in mixed.weights)


@pytest.mark.parametrize("length", (0, 10, 12, 22, 24))
def test_lists_of_another_length_are_refused(length):
    with pytest.raises(WeightsError, match=f"{length} numbers"):
        from_numbers([0.5] * length)


@pytest.mark.parametrize("params", (FULL, STRETCHED_PARAMS))
def test_declarations_are_the_same_after_conversion_to_json_and_back(params):
    assert params_from_json(params_to_json(params)) == params


def test_stretching_fades_towards_normal_incidence():
    """Anisotropy is scaled by sin^2(theta_i). No other parameter depends on the cosine."""
    raw = raw_outputs(2, params=STRETCHED_PARAMS)
    full, half, none = (
        decode(raw, 2, STRETCHED_PARAMS, mu).instances[0] for mu in (0.0, math.sqrt(0.5), 1.0)
    )
    np.testing.assert_allclose(half.anisotropic, 0.5 * full.anisotropic)
    assert np.all(none.anisotropic == 0)
    np.testing.assert_array_equal(np.stack([*full[0], *full[1:9]]), np.stack([*none[0], *none[1:9]]))
    assert full.anisotropic.min() < -3
    assert full.anisotropic.max() > 0.9


@pytest.mark.parametrize(
    ("entry", "message"),
    (
        ({"name": "transmission"}, "wrong name or size"),
        ({"name": "roughness", "low": 0.5, "high": 0.1}, "no valid range"),
        ({"name": "roughness", "low": 0.0, "scale": "log"}, "no valid range"),
        ({"name": "roughness", "scale": "cubic"}, "no valid range"),
        ({"name": "base_color", "size": 1}, "wrong name or size"),
        ({"name": "roughness", "colour": 1}, "colour"),
        ({"name": "roughness", "in_plane": True}, "cannot be `in_plane`"),
        ({"name": "roughness"}, "must have a base_color"),
    ),
)
def test_senseless_declarations_are_refused(entry, message):
    complete = params_to_json([TargetParam("roughness")])[0]
    with pytest.raises(WeightsError, match=message):
        params_from_json([complete | entry])


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("specular", 0.0, 12.0), ("anisotropic", -1e6, 1.0), ("fade", -1.0, 1.0), ("fade_width", 0.0, 1e6)],
)
def test_ranges_end_where_the_field_is_defined(name, low, high):
    colour = TargetParam("base_color", size=3)
    widest = (colour, TargetParam(name, low=low, high=high))
    assert params_from_json(params_to_json(widest)) == widest
    for wider in (TargetParam(name, low=low - 0.01, high=high), TargetParam(name, low=low, high=high + 0.01)):
        with pytest.raises(WeightsError, match="no valid range"):
            params_from_json(params_to_json([colour, wider]))


def test_jax_decodes_to_the_same_numbers_as_numpy():
    raw = raw_outputs(2)
    expected = np.stack(numbers(decode(raw, 2)))
    decoded = np.stack(
        [np.asarray(x) for x in numbers(decode([jnp.asarray(r, jnp.float32) for r in raw], 2))]
    )
    np.testing.assert_allclose(decoded, expected, rtol=1e-5, atol=1e-6)
