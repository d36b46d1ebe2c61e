"""The Mitsuba BSDF `values` has exactly the values of its source, and its samples follow its own pdf."""

import mitsuba as mi
import numpy as np
import pytest

import nma.render
from nma.jit import dr
from nma.render.load import SceneError, load_dict

METAL = '<bsdf version="3.0.0" type="roughconductor"><string name="material" value="Au"/></bsdf>'


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "gold.xml"
    path.write_text(METAL)
    return str(path)


def interactions(n, cos_theta):
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - cos_theta**2)), 0.0, cos_theta) + dr.zeros(mi.Float, n)
    return si


@pytest.mark.parametrize("cos_theta", (0.2, 0.9))
def test_values_are_the_source_s_and_sampling_is_unbiased(file, cos_theta):
    """The BSDF has the values of its source, and the mean sample weight is the source's albedo, within 2 %.

    The integral of the pdf is the share of valid samples, within 3 %. A failure means biased pictures. Seeds are fixed.
    """
    n, ctx = 400_000, mi.BSDFContext()
    bsdf, own = load_dict({"type": "values", "file": file}), mi.load_file(file)
    si, rng = interactions(n, cos_theta), mi.PCG32(n)
    u = [rng.next_float32() for _ in range(5)]
    wo = mi.warp.square_to_uniform_hemisphere(mi.Point2f(u[3], u[4]))
    value, pdf = bsdf.eval_pdf(ctx, si, wo)
    np.testing.assert_allclose(value, own.eval(ctx, si, wo), rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(value, bsdf.eval(ctx, si, wo))
    np.testing.assert_allclose(pdf, bsdf.pdf(ctx, si, wo), rtol=1e-6)
    bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    drawn, density = bsdf.eval_pdf(ctx, si, bs.wo)
    np.testing.assert_allclose(bs.pdf, density, rtol=1e-4)
    np.testing.assert_allclose(
        np.array(weight) * np.array(bs.pdf), np.array(drawn), rtol=1e-3, atol=1e-6 * np.array(drawn).max()
    )
    _, expected = own.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
    np.testing.assert_allclose(np.mean(weight, axis=1), np.mean(expected, axis=1), rtol=0.02)
    valid = float(dr.mean(dr.select(bs.pdf > 0, 1.0, 0.0))[0])
    assert 2.0 * np.pi * np.mean(pdf) == pytest.approx(valid, rel=0.03)


def test_the_back_is_black_and_unreadable_files_are_refused(file, tmp_path):
    bsdf, si = load_dict({"type": "values", "file": file}), interactions(4, 0.5)
    si.wi = -si.wi
    assert dr.all(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0.0, 0.0, 1.0)) == 0, axis=None)
    assert "gold" in str(bsdf)
    with pytest.raises(SceneError, match="no source reads such files"):
        load_dict({"type": "values", "file": str(tmp_path / "x.txt")})
