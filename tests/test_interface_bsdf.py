"""The BSDF `nma` renders adapters whose target lies under the interface of their class."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import random_interface_adapter
from test_adapter_bsdf import NUMBERS, description, drawn, interactions, textured

import nma.render
from nma.adapter import Adapter
from nma.ops import Vec3
from nma.params import LAYERED3

nma.render.use("llvm_ad_rgb")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("interface") / "interface.safetensors"
    random_interface_adapter("2x8").save(path)
    return path


@pytest.mark.parametrize("make", (description, textured))
def test_values_and_samples_are_those_of_the_adapter(weights, make):
    """Values and densities are those that NumPy computes from the adapter, for given and for sampled directions.

    The mean relative error is below 1e-4 for textured materials. For untextured materials the limit is 1e-3, because an
    untextured material interpolates the parameters of its target from precomputed curves.
    """
    bsdf, ctx, (si, rng) = mi.load_dict(make(weights)), mi.BSDFContext(), interactions(2000)
    adapter, wi = Adapter.load(weights), np.array(si.wi, np.float64)
    flat = adapter.numbers(LAYERED3.vector(NUMBERS), wi[2])[0].astype(np.float64)
    brdf = adapter.from_numbers(list(flat.T), Vec3(*wi))
    sampled, weight = bsdf.sample(ctx, si, *drawn(rng))
    for wo in (mi.warp.square_to_uniform_hemisphere(drawn(rng)[1]), sampled.wo):
        value, pdf = bsdf.eval_pdf(ctx, si, wo)
        expected, density = brdf.eval_pdf(Vec3(*wi), Vec3(*np.array(wo, np.float64)))
        valid = density > 1e-3
        assert valid.mean() > 0.5
        for found, wanted in ((value, np.stack(expected)), (pdf, density)):
            error = (np.abs(np.array(found) - wanted) / (wanted + 1e-6))[..., valid]
            assert error.mean() < (1e-4 if make is textured else 1e-3)
    valid = np.array(sampled.pdf) > 0
    ratio = np.array(weight) * np.array(sampled.pdf)
    np.testing.assert_allclose(ratio[:, valid], np.array(value)[:, valid], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("name", ("alpha_top", "eta_top"))
def test_gradients_reach_the_parameters_of_the_interface(weights, name):
    """The derivative with respect to the interface is that of finite differences."""
    bsdf = mi.load_dict(description(weights))
    params, ctx, (si, rng) = mi.traverse(bsdf), mi.BSDFContext(), interactions(4000)
    wo = mi.warp.square_to_uniform_hemisphere(drawn(rng)[1])
    start, step = NUMBERS[name], 1e-3 * NUMBERS[name]

    def mean(x):
        params[name] = x
        params.update()
        return dr.mean(bsdf.eval(ctx, si, wo), axis=None)

    x = mi.Float(start)
    dr.enable_grad(x)
    dr.backward(mean(x))
    difference = (mean(mi.Float(start + step)) - mean(mi.Float(start - step))) / (2.0 * step)
    np.testing.assert_allclose(dr.grad(x)[0], float(difference[0]), rtol=0.05)
