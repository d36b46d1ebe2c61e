"""The numbers that experiments report follow from their data. The tests call the experiments' functions."""

import numpy as np
import pytest

import nma
from figures.energy import run as energy
from figures.limits import run as limits
from figures.lobes import run as lobes
from figures.slices import run as slices
from figures.variants import report
from figures.variants.train import VARIANTS, Job
from nma import ops
from nma.lattice import lattice_points


def test_albedos_of_energy_are_integrals_of_the_value():
    """The mean of value / pdf over samples equals the integral of the value over uniform directions, within .5 %."""
    adapter, cosines = nma.Adapter.load("layered3-3x32"), np.array([0.3, 0.9])
    material = {"alpha_top": 0.3, "alpha_bottom": 0.6, "eta_top": 1.4, "eta_conductor": 1.0}
    params = nma.LAYERED3.vector(material | {"k_conductor": 4.0, "albedo": 0.7, "sigma_t": 0.5})[None]
    found = energy.albedos(adapter, params, cosines, np.arange(2), 4096, 0.0)
    z, turn = lattice_points(1 << 14, 2).T
    sine, phi = np.sqrt(1.0 - z * z), 2.0 * np.pi * turn
    for cosine, albedo in zip(cosines, found, strict=True):
        wi = ops.at_azimuth_0(np.full(len(z), cosine))
        brdf = adapter.prepare([np.full(len(z), x) for x in params[0]], wi)
        value = brdf.eval(wi, ops.Vec3(sine * np.cos(phi), sine * np.sin(phi), z))
        assert albedo == pytest.approx(2.0 * np.pi * max(c.mean() for c in value), rel=5e-3)


def test_energy_reports_the_brightest_pair(monkeypatch):
    params, brightest = np.arange(39.0).reshape(3, 13), 2 * energy.ANGLES + 5

    def albedos(adapter, params, mu, pairs, samples, shift):
        return np.where(pairs == brightest, 1.2, 0.9) + 0.01 * (shift - 0.25)

    monkeypatch.setattr(energy, "albedos", albedos)
    found, envelope = energy.measure(None, params, ((None, 1), (4, 2)))
    assert found == {
        "largest_albedo": 1.2,
        "error": 0.0025,
        "pairs_above_1": 1,
        "cos_theta_i": 5.5 / energy.ANGLES,
        "material": params[2].tolist(),
    }
    assert envelope.argmax() == 5 and len(envelope) == energy.ANGLES


def test_lobes_are_cut_along_the_plane_of_incidence():
    """The cut runs from grazing on the side of wi through the normal to grazing on the side of the mirror direction."""
    theta_o = np.arccos((np.arange(40) + 0.5) / 40)
    table = np.zeros((40, 40, 40, 3))
    table[lobes.common.row(50, 40), :, 0] = -theta_o[:, None]
    table[lobes.common.row(50, 40), :, -1] = theta_o[:, None]
    angles, values = lobes.in_plane(table, 50)
    assert (np.diff(angles) > 0).all()
    np.testing.assert_array_equal(values, np.repeat(angles[:, None], 3, axis=1))
    wrong = table.copy()
    wrong[lobes.common.row(50, 40), 7, 0] += 0.4
    errors = lobes.plane_errors(wrong, table)
    assert errors == {"20 degrees": 0.0, "50 degrees": pytest.approx(0.4 / 80), "75 degrees": 0.0}


def test_slices_report_the_mean_error_and_the_error_of_noise_alone():
    params, values = nma.LAYERED3.sample(np.random.default_rng(0), 1), np.full((1, 40, 40, 40, 3), 0.5)
    tables = nma.Tables(params, values, np.ones(1), np.full(values.shape, 0.1))
    adapter = tables.values + np.where(np.arange(40) < 10, 0.3, -0.1)[:, None, None]
    found = slices.summary(tables, adapter, "label")
    assert found["mean_absolute_error"] == {f"{angle} degrees": 0.15 for angle in slices.ANGLES}
    for angle in slices.ANGLES:
        entry = found["slices"][0][f"{angle} degrees"]
        # The mean absolute value of a normally distributed number is .7978846 of its standard deviation.
        assert entry == {"mean_absolute_error": 0.15, "mean": 0.5, "of_noise_alone": 0.079788}


def test_discs_show_the_view_direction_on_the_left_and_the_horizon_at_the_edge():
    values = np.zeros((40, 40, 3))
    values[:, 0, 0], values[:, -1, 1], values[0, :, 2] = 1.0, 1.0, 1.0
    picture, middle = slices.disc(values), slices.PIXELS // 2
    assert picture[middle, middle // 2].tolist() == [1.0, 0.0, 0.0]
    assert picture[middle, -middle // 2].tolist() == [0.0, 1.0, 0.0]
    assert picture[0, middle].tolist() == [0.0, 0.0, 1.0]
    assert picture[0, 0].tolist() == [1.0, 1.0, 1.0]


def test_limits_are_means_over_the_materials():
    rows = [{"params": [], "a": {"log_loss": x, "albedo_error": 2.0 * x}} for x in (0.1, 0.4)]
    assert limits.summary(rows) == {"a": {"log_loss": 0.25, "albedo_error": 0.5}}


def test_variants_are_ordered_by_every_seed_and_have_the_deviation_of_a_sample():
    assert report.statistics([1.0, 3.0]) == {"mean": 2.0, "std": 1.4142136, "seeds": 2}
    assert report.statistics([1.0]) == {"mean": 1.0, "std": None, "seeds": 1}
    losses = {0: (4.0, 2.0, 3.0, 1.0), 1: (2.0, 4.0, 3.0, 2.5)}
    results = {
        Job(variant, 100, seed, 1): {"tables": {"log_loss": loss}}
        for seed, given in losses.items()
        for variant, loss in zip(VARIANTS, given, strict=True)
    }
    expected = {"single worst": [True, False], "blended + omega_i best": [True, False]}
    assert report.orderings(results, [100]) == {"log loss, 100 materials": expected}
