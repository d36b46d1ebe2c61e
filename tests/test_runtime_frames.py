"""BRDFs in C++ include the frame of the plane of incidence, in all three ways to prepare a BRDF.

BRDFs are prepared one by one, in a batch, or from curves.
"""

import ctypes
from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import random_adapter
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


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "bounded"])
def stretched(request, tmp_path_factory):
    """Returns an adapter whose lobes stretch along the plane of incidence, and its runtime."""
    about = {"name": "direction", "params": TARGETS["stretched"], "space": MEASURED, "hidden": "1x8"}
    adapter = replace(random_adapter(**about), bounded=request.param)
    path = tmp_path_factory.mktemp("frames") / "stretched.safetensors"
    adapter.save(path)
    return adapter, Runtime(path, "portable")


@pytest.fixture(scope="module")
def directions():
    rng = np.random.default_rng(3)
    wi, wo = (rows(random_directions(rng, CASES)).astype(np.float32) for _ in range(2))
    return wi, wo, rng.random((CASES, 3)).astype(np.float32)


def prepared(runtime, way, wi):
    """Returns the BRDFs seen from `wi`, which the C interface prepares in the way named by `way`."""
    brdfs = runtime.prepare(np.zeros((CASES, 0), np.float32), wi)
    if way == "batch":
        return brdfs
    handle, none = runtime._handle, pointer(np.zeros(1, np.float32))
    runtime._c.nma_curves_new.restype = ctypes.c_void_p
    curves = ctypes.c_void_p(runtime._c.nma_curves_new(handle, none))
    brdfs[:] = 0
    for brdf, view in zip(brdfs, wi, strict=True):
        if way == "single":
            runtime._c.nma_prepare_direction(handle, none, pointer(view), pointer(brdf))
        else:
            runtime._c.nma_curves_at(curves, ctypes.c_float(view[2]), pointer(brdf))
    runtime._c.nma_curves_free(curves)
    return brdfs


@pytest.mark.parametrize("way", WITHIN)
def test_stretched_brdfs_have_the_values_of_the_package_at_every_azimuth(stretched, directions, way):
    adapter, runtime = stretched
    wi, wo, _ = directions
    view, light = (Vec3(*v.astype(np.float64).T) for v in (wi, wo))
    expected = stacked(adapter.prepare([], view).eval(view, light)).T
    found = runtime.eval(prepared(runtime, way, wi), wi, wo)
    assert np.abs(found - expected).mean() < WITHIN[way] * expected.mean()


def test_only_a_c_brdf_prepared_at_azimuth_0_turns_with_the_view(stretched, directions):
    """A C++ BRDF computes the plane of incidence in each call. A Python BRDF keeps the plane of `prepare`."""
    adapter, runtime = stretched
    wi, wo, _ = directions
    unturned = facing(wi[:, 2].astype(np.float64))
    brdfs = runtime.prepare(np.zeros((CASES, 0), np.float32), unturned)
    np.testing.assert_allclose(
        runtime.eval(brdfs, wi, wo), runtime.eval(prepared(runtime, "batch", wi), wi, wo)
    )
    view, other, light = (Vec3(*v.astype(np.float64).T) for v in (wi, unturned, wo))
    kept, turned = (stacked(adapter.prepare([], v).eval(view, light)) for v in (other, view))
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
    # In narrow lobes, rounding of the direction changes the value a lot, so that 2 % of the samples may differ.
    close = np.isclose(again, value, rtol=1e-2, atol=1e-4).all(axis=1) & np.isclose(density, pdf, rtol=1e-2)
    assert close[valid].mean() > 0.98
