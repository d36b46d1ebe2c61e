"""Microfacets and Fresnel terms, compared with integrals and closed forms."""

import numpy as np
import pytest

from nma import ops
from nma.microfacet import (
    fresnel_conductor,
    fresnel_conductor_rgb,
    fresnel_dielectric,
    ggx_d,
    reflect,
    refract,
    sample_visible_normal,
    smith_g1,
    visible_normal_pdf,
)
from nma.ops import Vec3


def square(n):
    u = (np.arange(n) + 0.5) / n
    return np.meshgrid(u, u, indexing="ij")


def normals(alpha_x, alpha_y, n=400):
    """Returns normals and their weights. The weighted mean of a function is its integral against D cos(theta).

    The slopes of GGX normals follow P(|slope / alpha| > t) = 1 / (1 + t^2). To place many normals in the long tail, the
    code sets the probability P to (1 - v)^4 for uniform numbers v.
    """
    v, u2 = square(n)
    t = np.sqrt(1 - (1 - v) ** 4) / (1 - v) ** 2
    phi = 2 * np.pi * u2
    return (
        ops.normalize(Vec3(t * alpha_x * np.cos(phi), t * alpha_y * np.sin(phi), np.ones_like(t))),
        4 * (1 - v) ** 3,
    )


def direction(cos, phi):
    s = np.sqrt(1 - cos * cos)
    return Vec3(s * np.cos(phi), s * np.sin(phi), cos)


ALPHAS = pytest.mark.parametrize("alphas", ((0.001, 0.001), (0.05, 0.3), (0.4, 0.4), (1.0, 0.6)))


@ALPHAS
def test_distribution_is_the_density_of_its_slopes(alphas):
    m, _ = normals(*alphas)
    # The density of the slopes -m.xy / m.z is D cos^4(theta), and has a known formula (Heitz 2014, eq. 75 and 84).
    sx, sy = m.x / m.z / alphas[0], m.y / m.z / alphas[1]
    expected = 1 / (np.pi * alphas[0] * alphas[1] * (1 + sx * sx + sy * sy) ** 2)
    np.testing.assert_allclose(ggx_d(m, *alphas) * m.z**4, expected, rtol=1e-9)


@ALPHAS
@pytest.mark.parametrize("cos", (0.1, 0.5, 0.95))
def test_visible_area_projects_to_the_macrosurface(alphas, cos):
    # Smith's masking function G1 is derived from a condition: the visible microfacets project to the area cos(theta) of
    # the macrosurface. The projected area is the integral of D(m) G1 max(dot(w, m), 0) over m (Heitz 2014, eq. 43).
    m, weight = normals(*alphas)
    w = direction(cos, 0.7)
    g1 = smith_g1(w, *alphas)
    visible = np.mean(weight * g1 * np.maximum(ops.dot(w, m), 0) / m.z)
    assert visible == pytest.approx(cos, rel=1e-3)


@ALPHAS
@pytest.mark.parametrize("cos", (0.05, 0.5, 0.95))
def test_visible_normals_follow_their_density(alphas, cos):
    # For any function of the normal, the mean over samples is the integral of the function times the density.
    w = direction(cos, 0.7)
    m = sample_visible_normal(w, *alphas, *square(600))
    assert np.all(ops.dot(w, m) > -1e-12)
    wide, weight = normals(*alphas, n=600)
    density = weight * visible_normal_pdf(w, wide, *alphas) / (ggx_d(wide, *alphas) * wide.z)
    for k in range(4):
        f = lambda m, k=k: np.exp(-m.z) if k == 0 else 1 / (1 + (m[k % 2] / m.z / alphas[k % 2] - k) ** 2)
        assert np.mean(f(m)) == pytest.approx(np.mean(f(wide) * density), rel=2e-3)


@pytest.mark.parametrize(
    ("alpha", "albedo"), ((0.1, 0.98830), (0.3, 0.87736), (0.6, 0.59152), (1.0, 1 - np.log(2)))
)
def test_white_rough_conductor_at_normal_incidence(alpha, albedo):
    wi = Vec3(0.0, 0.0, 1.0)
    wo = reflect(wi, sample_visible_normal(wi, alpha, alpha, *square(500)))
    weight = np.where(wo.z > 0, smith_g1(wo, alpha, alpha), 0.0)
    assert np.mean(weight) == pytest.approx(albedo, abs=2e-4)


def test_dielectric_reflectance_in_closed_form():
    reflectance, cos_t = fresnel_dielectric(1.0, 1.5)
    assert reflectance == pytest.approx(0.04)
    assert cos_t == pytest.approx(1.0)
    # At Brewster's angle only s-polarised light is reflected.
    brewster = np.arctan(1.5)
    s_only = 0.5 * np.sin(2 * brewster - np.pi / 2) ** 2
    assert fresnel_dielectric(np.cos(brewster), 1.5)[0] == pytest.approx(s_only)
    assert fresnel_dielectric(0.0, 1.5)[0] == pytest.approx(1.0)
    # Inside the denser medium, light beyond the critical angle is reflected completely.
    assert fresnel_dielectric(0.5, 1 / 1.5) == (1.0, 0.0)


def test_dielectric_reflectance_is_the_same_from_both_sides():
    cos = np.linspace(0.01, 1, 100)
    outside, cos_t = fresnel_dielectric(cos, 1.7)
    inside, back = fresnel_dielectric(cos_t, 1 / 1.7)
    np.testing.assert_allclose(inside, outside, rtol=1e-9)
    np.testing.assert_allclose(back, cos, rtol=1e-9)


def test_refraction_follows_snell():
    rng = np.random.default_rng(2)
    m = direction(rng.uniform(0.6, 1, 100), rng.uniform(0, 6, 100))
    w = direction(rng.uniform(0.6, 1, 100), rng.uniform(0, 6, 100))
    for eta in (1.5, 1 / 1.2):
        _, cos_t = fresnel_dielectric(ops.dot(w, m), eta)
        ok = (ops.dot(w, m) > 0.1) & (cos_t > 0)
        t = refract(w, m, cos_t, eta)
        np.testing.assert_allclose(ops.dot(t, t)[ok], 1.0, rtol=1e-9)
        np.testing.assert_allclose(-ops.dot(t, m)[ok], cos_t[ok], rtol=1e-9)
        for a, b in zip(ops.cross(w, m), ops.cross(t, m), strict=True):
            np.testing.assert_allclose(a[ok], -eta * b[ok], atol=1e-9)


def test_conductor_reflectance_is_that_of_complex_indices():
    rng = np.random.default_rng(3)
    cos = rng.random(1000)
    eta, k = rng.uniform(0.03, 7.6, 1000), rng.uniform(0.0, 9.5, 1000)
    index = eta + 1j * k
    cos_t = np.sqrt(1 - (1 - cos**2) / index**2)
    r_s = (cos - index * cos_t) / (cos + index * cos_t)
    r_p = (index * cos - cos_t) / (index * cos + cos_t)
    expected = 0.5 * (abs(r_s) ** 2 + abs(r_p) ** 2)
    np.testing.assert_allclose(fresnel_conductor(cos, eta, k), expected, rtol=1e-7)


def test_conductor_limits():
    cos = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(fresnel_conductor(cos, 0.0, 1.0), 1.0, rtol=1e-12)
    np.testing.assert_allclose(fresnel_conductor(cos, 1.5, 0.0), fresnel_dielectric(cos, 1.5)[0], rtol=1e-6)
    rgb = fresnel_conductor_rgb(0.5, Vec3(0.2, 0.9, 1.1), Vec3(3.0, 2.5, 2.0))
    assert rgb.z == pytest.approx(fresnel_conductor(0.5, 1.1, 2.0))
