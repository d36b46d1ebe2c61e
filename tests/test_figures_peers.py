"""Laws of the peers in figures/peers: limits in which their formulas are known, and energy."""

import numpy as np
import pytest

import nma
from figures.peers import belcour, lobes, openpbr
from figures.peers.belcour import Belcour
from figures.peers.openpbr import OpenPbr
from nma import microfacet
from nma.jit import dr
from nma.ops import Color, Vec3, at_azimuth_0, dot, normalize

GOLD = Color(0.143, 0.375, 1.442), Color(3.983, 2.386, 1.603)
MIRROR = Color.of(0.0), Color.of(50.0)
WIDTHS = [(0.1, 0.2), (0.3, 0.8), (0.3, 0.15)]
# A width so small that a lobe is a mirror.
SMOOTH = 1e-4


def layers(alpha_top=0.1, alpha_bottom=0.2, eta_top=1.5, albedo=0.5, sigma_t=0.5, metal=GOLD):
    return lobes.Layered3(alpha_top, alpha_bottom, eta_top, *metal, Color.of(albedo), sigma_t)


def coated(*numbers, **named):
    return openpbr.from_layered3(layers(*numbers, **named))


def moments(*numbers, **named):
    return belcour.from_layered3(layers(*numbers, **named))


def lanes(v):
    return Vec3(*(dr.auto.Float(np.ascontiguousarray(x, np.float32).ravel()) for x in v))


def hemisphere(n=256):
    mu, phi = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n * 2 * np.pi, indexing="ij")
    s = np.sqrt(1 - mu**2)
    return lanes(Vec3(s * np.cos(phi), s * np.sin(phi), mu))


def value(source, wi, wo):
    return np.stack([x.numpy() for x in source.eval(lanes(wi), wo)], axis=-1)


def albedo(source, cosine):
    return 2 * np.pi * value(source, at_azimuth_0(np.float64(cosine)), hemisphere()).mean(axis=0)


def at(curve, cosine):
    return np.interp(cosine, lobes.COSINES, curve)


@pytest.mark.parametrize("cosine", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("widths", WIDTHS)
@pytest.mark.parametrize("eta_top", [1.05, 1.5, 2.0])
def test_peers_reflect_no_more_light_than_they_receive(cosine, widths, eta_top):
    given = {"eta_top": eta_top, "albedo": 1.0, "sigma_t": 0.0, "metal": MIRROR}
    assert (albedo(OpenPbr(coated(*widths, **given)), cosine) <= 1.0).all()
    found = moments(*widths, **given)
    assert (albedo(Belcour(belcour.normalised(found)), cosine) <= 1.001).all()
    assert (albedo(Belcour(found), cosine) <= 1.0).all()


@pytest.mark.parametrize("seed", range(20))
def test_energies_of_belcours_lobes_sum_to_at_most_one(seed):
    row = nma.LAYERED3.sample(np.random.default_rng(seed), 1)[0]
    found = belcour.from_layered3(lobes.given(row))
    total = sum(x.energy for x in found)
    assert (total >= 0).all() and (total <= 1 + 1e-9).all()


def test_albedo_by_visible_normals_is_the_integral_of_the_lobe():
    for cosine, alpha in ((0.2, 0.3), (0.7, 0.2), (0.9, 0.8)):
        wi, wo = at_azimuth_0(np.float64(cosine)), Vec3(*(x.numpy().astype(float) for x in hemisphere(512)))
        integral = 2 * np.pi * lobes.ggx(wi, wo, normalize(wi + wo), alpha).mean()
        np.testing.assert_allclose(lobes.albedo([cosine], alpha), integral, rtol=2e-3)


# OpenPBR


def test_openpbr_without_a_coat_is_the_metal_of_its_f82_tint():
    bare, wi, wo = coated(1e-3, 0.3, 1.0 + 1e-6, sigma_t=0.0), at_azimuth_0(0.6), at_azimuth_0(0.7)
    m = normalize(wi + wo)
    expected = [
        openpbr.f82(dot(wi, m), f0, edge) * lobes.ggx(wi, wo, m, bare.base_alpha)
        for f0, edge in zip(bare.base_color, bare.edge, strict=True)
    ]
    np.testing.assert_allclose(value(OpenPbr(bare), wi, lanes(wo))[0], expected, rtol=1e-3)


def test_f82_passes_through_the_metals_reflectances():
    for eta, k in zip(*GOLD, strict=True):
        f0, edge = (microfacet.fresnel_conductor(c, eta, k) for c in (1.0, 1 / 7))
        np.testing.assert_allclose([openpbr.f82(1.0, f0, edge), openpbr.f82(1 / 7, f0, edge)], [f0, edge])


def test_a_medium_that_only_scatters_does_not_tint_openpbrs_coat():
    assert coated(albedo=1.0, sigma_t=1.0).coat_color == Color(1.0, 1.0, 1.0)
    np.testing.assert_allclose(list(coated(albedo=0.0, sigma_t=1.0).coat_color), np.exp(-2.0))


def test_openpbrs_coat_dims_the_base_by_one_way_or_by_both():
    """The base alone, under a rough coat that is far from its lobe's peak, is dimmed by 1 - E(wo) on the way out."""
    material, wi, wo = coated(SMOOTH, 0.5), at_azimuth_0(0.9), at_azimuth_0(0.3)
    fresnel = microfacet.fresnel_dielectric(0.3, 1.5)[0]
    one, both = (value(OpenPbr(material, way), wi, lanes(wo)) for way in (False, True))
    np.testing.assert_allclose(both / one, 1.0 - fresnel, rtol=1e-2)


def test_openpbrs_absorption_follows_both_refracted_ways():
    clear, dim = coated(SMOOTH, 0.5, sigma_t=0.0), coated(SMOOTH, 0.5, albedo=0.0, sigma_t=0.7)
    wi, wo = at_azimuth_0(0.9), at_azimuth_0(0.3)
    depth = sum(1.0 / microfacet.fresnel_dielectric(c, 1.5)[1] for c in (0.9, 0.3))
    ratio = value(OpenPbr(dim), wi, lanes(wo)) / value(OpenPbr(clear), wi, lanes(wo))
    np.testing.assert_allclose(ratio, np.exp(-0.7 * depth), rtol=1e-4)


def test_a_white_base_is_not_darkened():
    np.testing.assert_allclose(openpbr.darkening(coated(), 1.0, 0.5), 1.0)
    assert openpbr.darkening(coated(), 0.5, 0.5) < 1.0


# Belcour 2018


def test_width_inverts_variance():
    alpha = np.linspace(0.01, 0.99, 20)
    np.testing.assert_allclose(belcour.width(belcour.variance(alpha)), alpha)


def test_a_smooth_stack_reflects_what_fresnel_and_the_geometric_series_say():
    c = lobes.COSINES[20:]
    coat, base = moments(SMOOTH, SMOOTH, 1.5, sigma_t=0.0)
    r, inside = microfacet.fresnel_dielectric(c, 1.5)
    np.testing.assert_allclose(coat.energy[20:, 0], r, rtol=2e-3)
    for channel, (eta, k) in enumerate(zip(*GOLD, strict=True)):
        metal = microfacet.fresnel_conductor(inside, eta / 1.5, k / 1.5)
        expected = (1 - r) ** 2 * metal / (1 - r * metal)
        np.testing.assert_allclose(base.energy[20:, channel], expected, rtol=2e-3)


def test_a_coat_without_an_index_leaves_the_metal_alone():
    """The base's lobe is the conductor's own: its width, and its energy with the masking of its facets."""
    _, base = moments(0.2, 0.4, 1.0 + 1e-9, sigma_t=0.0)
    np.testing.assert_allclose(base.alpha, 0.4, rtol=2e-4)
    metal = [
        lobes.albedo(lobes.COSINES, 0.4, lambda c, e=e, k=k: microfacet.fresnel_conductor(c, e, k))
        for e, k in zip(*GOLD, strict=True)
    ]
    np.testing.assert_allclose(base.energy, np.stack(metal, -1), rtol=1e-4)


def test_a_white_slab_loses_no_light():
    cosines, inside = lobes.COSINES, microfacet.fresnel_dielectric(lobes.COSINES, 1.6)[1]
    top = belcour.dielectric(cosines, 0.1, 1.6)
    slab, _ = belcour.add(top, belcour.dielectric(inside, 0.2, 1.2))
    np.testing.assert_allclose(slab.r + slab.t, 1.0)
    np.testing.assert_allclose(slab.r_up + slab.t_up, 1.0)


def test_a_layer_over_nothing_is_the_layer():
    cosines, inside = lobes.COSINES, microfacet.fresnel_dielectric(lobes.COSINES, 1.6)[1]
    top = belcour.dielectric(cosines, 0.1, 1.6)
    stack, lobe = belcour.add(top, belcour.medium(inside, 0.0, 3 * (0.5,)))
    assert not lobe.energy.any()
    for name, got, expected in zip(top._fields, stack, top, strict=True):
        np.testing.assert_allclose(got, np.broadcast_to(expected, got.shape), err_msg=name)


def test_a_medium_dims_as_far_as_it_absorbs():
    c = lobes.COSINES
    np.testing.assert_allclose(belcour.medium(c, 0.7, 3 * (0.0,)).t[:, 0], np.exp(-0.7 / c))
    white = belcour.medium(c, 0.7, 3 * (1.0,)).t[:, 0]
    assert (white <= 1.0).all() and (white > np.exp(-0.7 / c)).all()


def test_a_smooth_coat_widens_the_metals_lobe_by_its_index():
    _, base = moments(SMOOTH, 0.1, 1.5, sigma_t=0.0, metal=(Color.of(0.2), Color.of(3.0)))
    r = lobes.albedo([1.0], SMOOTH, lambda c: microfacet.fresnel_dielectric(c, 1.5)[0])[0]
    # Light that goes up and down again between metal and coat is a little wider.
    again = r + belcour.trapped(np.array([1.0]), 0.1, 1.5)[0]
    narrow, wide = (belcour.width(1.5 * x * belcour.variance(0.1)) for x in (1.0, 1.0 + 2.0 * again))
    assert narrow * 0.999 <= at(base.alpha, 0.998) <= wide


def test_light_beyond_the_critical_angle_is_trapped():
    critical = np.sqrt(1 - 1 / 1.5**2)
    shares = belcour.trapped(np.array([1.0, critical + 0.1, critical - 0.1]), SMOOTH, 1.5)
    np.testing.assert_allclose(shares, [0.0, 0.0, 1.0])
    wide = belcour.trapped(np.array([1.0]), 1.0, 1.5)[0]
    assert 0.2 < wide < 0.8


def test_normalised_lobes_reflect_the_energy_of_their_moments():
    found = moments(0.2, 0.5)
    expected = [at(sum(x.energy[:, c] for x in found), 0.6) for c in range(3)]
    np.testing.assert_allclose(albedo(Belcour(belcour.normalised(found)), 0.6), expected, rtol=5e-3)
    assert (albedo(Belcour(found), 0.6) < expected).all()
