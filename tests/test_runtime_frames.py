"""BRDFs in C++ include the frame of the plane of incidence, in all three ways to prepare a BRDF.

BRDFs are prepared one by one, in a batch, or from curves.
"""

import ctypes
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from adapter_cases import materials, random_adapter, random_interface_adapter
from runtime_cases import facing, pointer, rows
from target_cases import random_directions, stacked

from nma import Runtime
from nma.ops import Vec3
from nma.params import MEASURED
from nma.target.decode import TARGETS

CASES = 500
# The largest mean difference of values between C++ and the package, relative to the mean value. Differences are due to
# rounding in the network and, for curves, to interpolation.
WITHIN = {"single": 1e-4, "batch": 1e-4, "curves": 2e-2}

pytestmark = pytest.mark.usefixtures("compiler")


@pytest.fixture(scope="module", params=["plain", "bounded", "interface", "bounded interface"])
def stretched(request, tmp_path_factory):
    """Returns an adapter whose lobes stretch along the plane of incidence, and its runtime."""
    about = {"name": "direction", "params": TARGETS["stretched"], "space": MEASURED}
    make = (
        partial(random_interface_adapter, seed=4)
        if "interface" in request.param
        else partial(random_adapter, **about)
    )
    adapter = replace(make(hidden="1x8"), bounded="bounded" in request.param)
    path = tmp_path_factory.mktemp("frames") / "stretched.safetensors"
    adapter.save(path)
    return adapter, Runtime(path, "portable")


def material_of(runtime):
    """Returns the parameters of one material of the adapter's class, or none for the class "measured"."""
    return materials(1)[0].astype(np.float32)[: runtime.parameters]


@pytest.fixture(scope="module")
def directions():
    rng = np.random.default_rng(3)
    wi, wo = (rows(random_directions(rng, CASES)).astype(np.float32) for _ in range(2))
    return wi, wo, rng.random((CASES, 3)).astype(np.float32)


def columns_of(runtime):
    return list(np.tile(material_of(runtime).astype(np.float64)[:, None], CASES))


def prepared(runtime, way, wi):
    """Returns the BRDFs seen from `wi`, which the C interface prepares in the way named by `way`."""
    material = material_of(runtime)
    brdfs = runtime.prepare(np.tile(material, (CASES, 1)), wi)
    if way == "batch":
        return brdfs
    handle, numbers = runtime._handle, pointer(material)
    runtime._c.nma_curves_new.restype = ctypes.c_void_p
    curves = ctypes.c_void_p(runtime._c.nma_curves_new(handle, numbers))
    brdfs[:] = 0
    for brdf, view in zip(brdfs, wi, strict=True):
        if way == "single":
            runtime._c.nma_prepare_direction(handle, numbers, pointer(view), pointer(brdf))
        else:
            runtime._c.nma_curves_at(curves, ctypes.c_float(view[2]), pointer(brdf))
    runtime._c.nma_curves_free(curves)
    return brdfs


@pytest.mark.parametrize("way", WITHIN)
def test_stretched_brdfs_have_the_values_of_the_package_at_every_azimuth(stretched, directions, way):
    adapter, runtime = stretched
    wi, wo, _ = directions
    view, light = (Vec3(*v.astype(np.float64).T) for v in (wi, wo))
    expected = stacked(adapter.prepare(columns_of(runtime), view).eval(view, light)).T
    found = runtime.eval(prepared(runtime, way, wi), wi, wo)
    assert np.abs(found - expected).mean() < WITHIN[way] * expected.mean()


def test_only_a_c_brdf_prepared_at_azimuth_0_turns_with_the_view(stretched, directions):
    """A C++ BRDF computes the plane of incidence in each call. A Python BRDF keeps the plane of `prepare`."""
    adapter, runtime = stretched
    wi, wo, _ = directions
    unturned = facing(wi[:, 2].astype(np.float64))
    brdfs = runtime.prepare(np.tile(material_of(runtime), (CASES, 1)), unturned)
    np.testing.assert_allclose(
        runtime.eval(brdfs, wi, wo), runtime.eval(prepared(runtime, "batch", wi), wi, wo)
    )
    view, other, light = (Vec3(*v.astype(np.float64).T) for v in (wi, unturned, wo))
    columns = columns_of(runtime)
    kept, turned = (stacked(adapter.prepare(columns, v).eval(view, light)) for v in (other, view))
    assert np.abs(kept - turned).mean() > 0.1 * turned.mean()


@pytest.mark.parametrize("way", WITHIN)
def test_samples_leave_the_frame(stretched, directions, way):
    """A sampled direction is in the local frame: `eval_pdf` returns the same value and density for this direction."""
    _, runtime = stretched
    wi, _, u = directions
    brdfs = prepared(runtime, way, wi)
    wo, value, pdf = runtime.sample(brdfs, wi, u)
    valid = pdf > 0
    assert valid.mean() > 0.5
    again, density = runtime.eval_pdf(brdfs, wi, wo)
    np.testing.assert_allclose(again[valid], value[valid], rtol=1e-6)
    np.testing.assert_allclose(density[valid], pdf[valid], rtol=1e-6)
