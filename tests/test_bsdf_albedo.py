"""Our BSDFs report their directional albedo at wi to denoisers and to the integrator `aov`.

The reported albedo has no noise and is at most 1.
"""

import mitsuba as mi
import numpy as np
import pytest

import nma.render
from nma.jit import dr
from nma.render.textures import bitmap_texture
from nma.render.values_bsdf import bsdf_of
from nma.sources.coating import Coating

nma.render.use("llvm_ad_rgb")
SAMPLES = 200_000
ADAPTER = {"type": "nma", "adapter": "layered3-3x32"}
GREY = {"sigma_t": bitmap_texture(np.full((2, 2, 1), 0.4))}
# The BSDFs, each with the largest allowed difference between its reported albedo and the mean of many samples.
KINDS = {
    "nma": (ADAPTER | {"material": "gold-red-lacquer"}, 0.02),
    "nma, smooth": (ADAPTER | {"material": "wet-nickel"}, 0.02),
    "nma, textured": (ADAPTER | {"material": "pearl-white"} | GREY, 0.02),
    "layered": ({"type": "layered", "material": "gold-red-lacquer"}, 0.06),
    "values": (bsdf_of(Coating(alpha=0.2)), 0.02),
}


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")


def interactions(n, cosine):
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0.0, cosine) + dr.zeros(mi.Float, n)
    return si


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_reported_albedo_is_the_mean_of_sample_weights(kind):
    description, error = KINDS[kind]
    bsdf, rng = mi.load_dict(description), mi.PCG32(SAMPLES)
    for cosine in (1.0, 0.5, 0.15):
        drawn = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        _, weight = bsdf.sample(mi.BSDFContext(), interactions(SAMPLES, cosine), *drawn)
        expected = np.array(weight, np.float64).mean(axis=1)
        found = np.array(bsdf.eval_diffuse_reflectance(interactions(3, cosine)))
        np.testing.assert_allclose(found, np.stack([expected] * 3, axis=1), atol=error)
        assert np.ptp(found, axis=1).max() == 0
        assert found.max() <= 1


def test_the_albedo_is_at_most_one_and_zero_from_behind():
    white = {"eta_conductor": 0.0, "k_conductor": 1.0, "albedo": 1.0, "alpha_top": 1e-4, "alpha_bottom": 1e-4}
    bsdf = mi.load_dict({"type": "layered", "eta_top": 1.5, "sigma_t": 1.0} | white)
    si = interactions(2, 0.3)
    si.wi.z = mi.Float([0.3, -0.3])
    found = np.array(bsdf.eval_diffuse_reflectance(si))
    np.testing.assert_allclose(found[:, 0], 1.0, atol=0.01)
    assert (found[:, 0] <= 1).all()
    assert (found[:, 1] == 0).all()


def test_blendbsdf_blends_the_albedos_of_its_parts():
    parts = [{"type": "diffuse", "reflectance": 0.5}, ADAPTER | {"material": "gold-red-lacquer"}]
    both = mi.load_dict({"type": "blendbsdf", "weight": 0.25, "a": parts[0], "b": parts[1]})
    si = interactions(1, 0.6)
    a, b = (np.array(mi.load_dict(p).eval_diffuse_reflectance(si)) for p in parts)
    np.testing.assert_allclose(np.array(both.eval_diffuse_reflectance(si)), 0.75 * a + 0.25 * b, rtol=1e-5)
