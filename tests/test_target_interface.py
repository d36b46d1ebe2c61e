"""The laws of lobes under an interface."""

import numpy as np
import pytest
from target_cases import random_directions, stacked

from nma import ops
from nma.ops import Color, Vec3
from nma.target import Blend, Interface, Principled, eval
from nma.target.interface import FLAT, FLAT_COSINE, cos_shifted, shifted
from nma.target.principled import microfacet_lobe

CASES = 1000


@pytest.fixture
def directions():
    rng = np.random.default_rng(5)
    return random_directions(rng, CASES), random_directions(rng, CASES)


def instance(metallic, **fields):
    return Principled(Color(0.9, 0.5, 0.2), 0.4, metallic, *(0.0,) * 6, **fields)


def value_below(p, wi, wo, eta=1.0):
    return stacked(eval(Blend((p,), (1.0,), interface=Interface(0.1, eta)), wi, wo))


def test_under_an_interface_of_index_1_lie_a_tinted_mirror_and_a_lambertian(directions):
    """An interface of index 1 neither reflects nor refracts."""
    wi, wo = directions
    color = np.array([[0.9], [0.5], [0.2]])
    np.testing.assert_allclose(
        value_below(instance(1.0), wi, wo), color * microfacet_lobe(wi, wo, 0.16, 0.16)[0], rtol=1e-9
    )
    np.testing.assert_allclose(value_below(instance(0.0), wi, wo), color * wo.z / np.pi, rtol=1e-9)


def test_the_flat_lobe_has_the_albedo_of_the_diffuse_lobe():
    mu = (np.arange(20_000) + 0.5) / 20_000
    assert (2.0 * mu * FLAT / (mu + FLAT_COSINE)).mean() == pytest.approx(1.0, abs=1e-6)
    lambertian, flat = (
        value_below(instance(0.0, flatness=s), ops.at_azimuth_0(0.5), ops.at_azimuth_0(mu))
        for s in (0.0, 1.0)
    )
    np.testing.assert_allclose(flat.mean(axis=1), lambertian.mean(axis=1), rtol=1e-6)
    assert (flat[:, mu < 0.5] > lambertian[:, mu < 0.5]).all()


def test_the_veil_is_the_share_of_the_inner_reflection_that_is_lost(directions):
    """With a veil of 1, the light that leaves is what the interface transmits."""
    wi, wo = directions
    reflected, clear, veiled = (
        value_below(p, wi, wo, eta=1.5)
        for p in (
            instance(0.0)._replace(base_color=Color(0.0, 0.0, 0.0)),
            instance(0.0),
            instance(0.0, veil=1.0),
        )
    )
    transmitted = (veiled - reflected) / (clear - reflected)
    cos_t = np.sqrt(1.0 - (1.0 - wo.z**2) / 1.5**2)
    r_s = (wo.z - 1.5 * cos_t) / (wo.z + 1.5 * cos_t)
    r_p = (1.5 * wo.z - cos_t) / (1.5 * wo.z + cos_t)
    np.testing.assert_allclose(transmitted, np.tile(1.0 - 0.5 * (r_s**2 + r_p**2), (3, 1)), atol=1e-6)


def test_a_shift_multiplies_the_slope(directions):
    wi, _ = directions
    for shift in (-0.5, 0.0, 0.7):
        v = shifted(wi, shift)
        np.testing.assert_allclose(ops.dot(v, v), 1.0, rtol=1e-12)
        np.testing.assert_allclose(v.x * wi.z, (1.0 + shift) * wi.x * v.z, atol=1e-12)
        np.testing.assert_allclose(cos_shifted(wi.z, shift), v.z, rtol=1e-9)
    still = Vec3(*(np.float32(c) for c in wi))
    assert all((a == b).all() for a, b in zip(shifted(still, np.float32(0.0)), still, strict=True))
