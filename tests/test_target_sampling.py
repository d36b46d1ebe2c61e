"""Chi-square tests of `sample` against `pdf`, in bins that adapt to the lobes, and tests of the lobe probabilities.

The tests compute in double precision. At grazing angles, the narrowest lobes are only 1e-5 wide, and rounding to single
precision would move samples from one bin to another. Tests in test_target.py show that single and double precision draw
the same directions.
"""

import drjit as dr
import numpy as np
import pytest
from scipy.stats import chi2
from target_cases import below_interface, mapped, random_blend, random_directions, stacked

from nma import ops, target
from nma.llvm import ensure_llvm
from nma.ops import Vec3
from nma.target.blend import lobe_probabilities
from nma.target.interface import sample_below
from nma.target.sampling import sample_clearcoat, sample_diffuse, sample_spec

ensure_llvm()

N_BLENDS = 200
DEPTH = 7  # 2^7 = 128 bins per blend
FINE = 10  # 2^10 boxes per blend, so that each bin is integrated over at least 8 boxes
PILOT = 1 << 13
SAMPLES = 100_000
FAMILY_ERROR = 1e-3  # the chance that a correct sampler fails at least one of the 200 tests
SIDAK = 1 - (1 - FAMILY_ERROR) ** (1 / N_BLENDS)


# ---- A chart of the hemisphere. Its coordinates are 1 - cos(theta) and the azimuth, both relative to the mirror
# ---- direction and both mapped by asinh. So the narrowest lobes are as smooth as their tails over many decades.

EPSILON = 1e-7


def to_chart(w, mirror):
    """Returns the chart coordinates (a, b) of directions.

    1 - cos(theta) is computed from x and y, which keep their digits near the pole.
    """
    t = (w.x * w.x + w.y * w.y) / (1.0 + w.z)
    phi = dr.atan2(w.y, w.x) - mirror[1]
    phi = phi - dr.two_pi * dr.round(phi / dr.two_pi)
    return dr.asinh((t - mirror[0]) / EPSILON), dr.asinh(phi / EPSILON)


def from_chart(a, b, mirror):
    """Returns the direction at the chart coordinates (a, b), and the solid angle per unit of chart area there."""
    t = dr.clip(mirror[0] + EPSILON * dr.sinh(a), 0.0, 1.0)
    phi = mirror[1] + EPSILON * dr.sinh(b)
    r = dr.safe_sqrt(t * (2.0 - t))
    return Vec3(r * dr.cos(phi), r * dr.sin(phi), 1.0 - t), EPSILON**2 * dr.cosh(a) * dr.cosh(b)


def whole_chart(mirror):
    """Returns the boxes (n, 1, 4), each a0, a1, b0, b1, that cover the hemisphere."""
    seam = np.full_like(mirror[0], np.arcsinh(np.pi / EPSILON))
    a0, a1 = (np.arcsinh((t - mirror[0]) / EPSILON) for t in (0.0, 1.0))
    return np.stack([a0, a1, -seam, seam], 1)[:, None]


class Cases:
    """Random blends of 1 to 5 instances, with one view direction each, as double-precision arrays.

    With `below`, the instances lie under interfaces.
    """

    def __init__(self, seed, n=N_BLENDS, dialect=True, below=False):
        rng = np.random.default_rng(seed)
        blend = random_blend(rng, n, 5, dialect)
        blend = below_interface(rng, blend) if below else blend
        # A random count of instances, from 1 to 5, have a weight above 0.
        used = np.arange(5)[:, None] < rng.integers(1, 6, n)
        weights = np.where(used, stacked(blend.weights) + 1e-3, 0.0)
        self.blend = blend._replace(weights=tuple(weights / weights.sum(0)))
        z = np.where(rng.random(n) < 0.15, 10.0 ** rng.uniform(-3, -1, n), rng.random(n))
        phi = rng.uniform(0, 2 * np.pi, n)
        self.wi = Vec3(np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z)
        self.mirror = (1 - z, np.arctan2(-self.wi.y, -self.wi.x))

    def at(self, Float, index):
        """Gathers blend, view direction and mirror direction per lane. `index` holds the index of each lane's blend."""
        gather = lambda x: dr.gather(Float, Float(x), index)
        return mapped((self.blend, self.wi, self.mirror), gather)


def drawn(cases, count, seed, sampler):
    """Returns the chart coordinates of the directions that `sampler(blend, wi, lane, u)` draws.

    There are `count` lanes per blend. Lanes are ordered by blend. Invalid samples have a = inf.
    """
    n = cases.wi.z.size
    lane = dr.arange(dr.llvm.UInt, n * count)
    rng = dr.rng(seed)
    blend, wi, mirror = cases.at(dr.llvm.Float64, lane // count)
    wo, valid = sampler(blend, wi, lane, [rng.random(dr.llvm.Float64, n * count) for _ in range(3)])
    a, b = to_chart(wo, mirror)
    return dr.select(valid, a, dr.inf), b


def draw(cases, count, seed, alpha_scale=1.0):
    """Draws samples of the blends.

    An `alpha_scale` other than 1 makes the samples wrong, because it multiplies the widths of specular lobes, also of
    the interface's own.
    """

    def sampler(blend, wi, lane, u):
        rough = float(np.sqrt(alpha_scale))
        off = tuple(p._replace(roughness=p.roughness * rough) for p in blend.instances)
        above = blend.interface
        if above is not None:
            above = above._replace(alpha=above.alpha * alpha_scale)
        wo, _, pdf = target.sample(blend._replace(instances=off, interface=above), wi, *u)
        return wo, pdf > 0

    return drawn(cases, count, seed, sampler)


def draw_lobes(cases, count, seed):
    """Draws equally many samples from every lobe of every instance, without regard to weights.

    All samples are valid.
    """

    def sampler(blend, wi, lane, u):
        wo = sample_diffuse(u[1], u[2])
        for k, (alpha_x, alpha_y, alpha_c) in enumerate(target.lobe_alphas(blend)):
            if blend.interface is None:
                spec = sample_spec(wi, alpha_x, alpha_y, u[1], u[2])
                last = sample_clearcoat(wi, alpha_c, u[1], u[2])
            else:
                alpha, eta = blend.interface
                spec = sample_below(wi, eta, blend.instances[k].shift, alpha_x, alpha_y, u[1], u[2])
                last = sample_spec(wi, alpha, alpha, u[1], u[2])
            wo = ops.select(lane % 11 == 2 * k + 1, spec, wo)
            wo = ops.select(lane % 11 == 2 * k + 2, last, wo)
        # Uniform directions replace samples below the horizon, because only samples above the horizon define bins.
        z = u[1]
        r = dr.sqrt(1.0 - z * z)
        uniform = Vec3(r * dr.cos(dr.two_pi * u[2]), r * dr.sin(dr.two_pi * u[2]), z)
        return ops.select(wo.z > 0, wo, uniform), dr.llvm.Bool(True)

    return drawn(cases, count, seed, sampler)


def adaptive_bins(boxes, a, b):
    """Cuts `boxes` (n, 1, 4) FINE times at the medians of the samples in each box.

    Returns the resulting boxes (n, 2^FINE, 4), and the positions of the cuts at each level.
    """
    n = len(boxes)
    points = np.stack([a.numpy(), b.numpy()], -1).reshape(n, 1, -1, 2)
    cuts = []
    for level in range(FINE):
        axis = level % 2
        order = np.argsort(points[..., axis], axis=-1)
        points = np.take_along_axis(points, order[..., None], axis=2)
        half = points.shape[2] // 2
        cut = 0.5 * (points[:, :, half - 1, axis] + points[:, :, half, axis])
        cuts.append(cut)
        points = points.reshape(n, -1, half, 2)
        low, high = boxes.copy(), boxes.copy()
        low[..., 2 * axis + 1] = cut
        high[..., 2 * axis] = cut
        boxes = np.stack([low, high], 2).reshape(n, -1, 4)
    return boxes, cuts


def counts(a, b, cuts):
    """Returns the counts of samples in each bin, (n, 2^DEPTH + 1). The last column counts invalid samples."""
    n, size, UInt = len(cuts[0]), 2**DEPTH, dr.llvm.UInt
    row = dr.arange(UInt, len(a)) // (len(a) // n)
    node = dr.zeros(UInt, len(a))
    for level, cut in enumerate(cuts[:DEPTH]):
        border = dr.gather(dr.llvm.Float64, dr.llvm.Float64(cut.ravel()), row * cut.shape[1] + node)
        node = 2 * node + dr.select((a, b)[level % 2] > border, UInt(1), UInt(0))
    node = dr.select(dr.isinf(a), UInt(size), node)
    return np.bincount((row * (size + 1) + node).numpy(), minlength=n * (size + 1)).reshape(n, size + 1)


def integrate(cases, index, boxes, order=6):
    """Integrates the density over boxes (m, 4) by Gauss-Legendre quadrature. Box k belongs to blend `index[k]`."""
    Float, UInt = dr.llvm.Float64, dr.llvm.UInt
    x, w = np.polynomial.legendre.leggauss(order)
    x, w = 0.5 + 0.5 * x, 0.5 * w
    m, q = len(boxes), order * order
    lane = dr.arange(UInt, m * q)
    box, node = lane // q, lane % q
    a0, a1, b0, b1 = (dr.gather(Float, Float(boxes[:, k]), box) for k in range(4))
    blend, wi, mirror = cases.at(Float, dr.gather(UInt, UInt(index), box))
    wo, solid_angle = from_chart(
        ops.lerp(a0, a1, dr.gather(Float, Float(x), node // order)),
        ops.lerp(b0, b1, dr.gather(Float, Float(x), node % order)),
        mirror,
    )
    weight = dr.gather(Float, Float(w), node // order) * dr.gather(Float, Float(w), node % order)
    density = target.pdf(blend, wi, wo) * solid_angle * weight * (a1 - a0) * (b1 - b0)
    return dr.block_sum(density, q).numpy()


def integrate_adaptively(cases, boxes, tolerance=2e-6):
    """Returns the integrals (n, 2^DEPTH) of the density over all bins.

    A box is divided into quarters until the integrals over the quarters add up to the integral over the box.
    """
    n, bins, _ = boxes.shape
    owner = np.arange(n * bins)
    parts = boxes.reshape(-1, 4)
    whole = integrate(cases, owner // bins, parts)
    total = np.zeros(n * bins)
    for _ in range(14):
        a0, a1, b0, b1 = parts.T
        am, bm = (a0 + a1) / 2, (b0 + b1) / 2
        parts = np.stack([[a0, am, b0, bm], [a0, am, bm, b1], [am, a1, b0, bm], [am, a1, bm, b1]])
        parts = parts.transpose(2, 0, 1)
        quarters = integrate(cases, np.repeat(owner // bins, 4), parts.reshape(-1, 4)).reshape(-1, 4)
        done = np.abs(quarters.sum(1) - whole) < tolerance
        np.add.at(total, owner[done], quarters[done].sum(1))
        if done.all():
            return total.reshape(n, 2**DEPTH, -1).sum(2)
        parts, whole = parts[~done].reshape(-1, 4), quarters[~done].ravel()
        owner = np.repeat(owner[~done], 4)
    raise AssertionError("the integral of the density does not converge; the density has a singularity")


@pytest.fixture(scope="module", params=(False, True), ids=("plain", "below"))
def bins(request):
    """Random blends, the cuts of their bins, and the probability that a sample lies in each bin (n, 2^DEPTH + 1).

    The last column is the probability of an invalid sample. In the second half of the tests, the instances lie under
    interfaces.
    """
    cases = Cases(seed=31, below=request.param)
    boxes, cuts = adaptive_bins(whole_chart(cases.mirror), *draw_lobes(cases, PILOT, seed=1))
    probability = integrate_adaptively(cases, boxes)
    invalid = 1.0 - probability.sum(1, keepdims=True)
    return cases, cuts, np.concatenate([probability, invalid], 1)


def p_values(bins, seed, alpha_scale=1.0):
    """Returns one chi-square p-value per blend."""
    cases, cuts, probability = bins
    observed = counts(*draw(cases, SAMPLES, seed, alpha_scale), cuts)
    expected = np.maximum(probability, 0.0) * SAMPLES
    return np.array([pooled_p_value(o, e) for o, e in zip(observed, expected, strict=True)])


def pooled_p_value(observed, expected):
    """Returns the p-value of a chi-square test. All bins with fewer than 5 expected samples are merged into one bin."""
    small = expected < 5
    observed = np.append(observed[~small], observed[small].sum())
    expected = np.append(expected[~small], expected[small].sum())
    if expected[-1] < 5:
        observed[-2] += observed[-1]
        expected[-2] += expected[-1]
        observed, expected = observed[:-1], expected[:-1]
    statistic = np.sum((observed - expected) ** 2 / expected)
    return chi2.sf(statistic, len(expected) - 1)


def test_no_probability_of_a_bin_or_of_an_invalid_sample_is_negative(bins):
    _, _, probability = bins
    assert np.all(probability > -1e-4)


def test_samples_follow_their_density(bins):
    p = p_values(bins, seed=2)
    assert p.min() > SIDAK, f"blend {p.argmin()}: p = {p.min():.2e} against {SIDAK:.2e}"
    # The p-values of a correct sampler are uniform, so that their median is near .5.
    assert 0.35 < np.median(p) < 0.65


@pytest.mark.slow
def test_samples_with_alpha_off_by_five_per_cent_are_rejected(bins):
    p = p_values(bins, seed=3, alpha_scale=1.05)
    assert p.min() < SIDAK
    # The test rejects more than half of the blends, so that the error is not found only by chance. Under an interface,
    # fewer samples are drawn from the lobes whose widths are wrong.
    assert np.mean(p < SIDAK) > (0.15 if bins[0].blend.interface else 0.5)


@pytest.mark.parametrize("below, median, largest", [(False, 0.2, 0.7), (True, 0.25, 1.5)])
def test_lobe_probabilities_follow_the_albedos(below, median, largest):
    """Each lobe is chosen about as often as its share of the albedo, so that sample weights vary little.

    Under an interface, they vary more, because many samples are reflected back down. A failure means that the estimates
    of the lobes' albedos are poor, and renderings become noisier.
    """
    cases = Cases(seed=32, dialect=False, below=below)
    count = 4096
    lane = dr.arange(dr.llvm.UInt, N_BLENDS * count)
    blend, wi, _ = cases.at(dr.llvm.Float, lane // count)
    rng = dr.rng(4)
    _, value, pdf = target.sample(blend, wi, *(rng.random(dr.llvm.Float, N_BLENDS * count) for _ in range(3)))
    weight = dr.select(pdf > 0, ops.mean(value) / pdf, 0.0).numpy().reshape(N_BLENDS, count)
    deviation = weight.std(1) / weight.mean(1)
    assert np.median(deviation) < median
    assert deviation.max() < largest
    total = sum(sum(p) for p in lobe_probabilities(cases.blend, cases.wi.z))
    np.testing.assert_allclose(total, 1.0, rtol=1e-5)


@pytest.mark.parametrize("below", (False, True), ids=("plain", "below"))
def test_sample_returns_the_value_and_pdf_of_eval_pdf(below):
    rng = np.random.default_rng(33)
    blend, wi = random_blend(rng, 1000, 3), random_directions(rng, 1000)
    blend = below_interface(rng, blend) if below else blend
    wo, value, pdf = target.sample(blend, wi, *rng.random((3, 1000)))
    again, density = target.eval_pdf(blend, wi, wo)
    np.testing.assert_array_equal(stacked(value), stacked(again))
    np.testing.assert_array_equal(pdf, density)
    assert np.all(pdf[wo.z < 0] == 0)
    total = sum(sum(p) for p in lobe_probabilities(blend, wi.z))
    np.testing.assert_allclose(total, 1.0, rtol=1e-5)
