"""Signed errors of brightness say how much too bright an adapter is, and at which directions."""

import numpy as np
import pytest

from nma.evaluate.brightness import BANDS, Energy, energy, signed_errors

TABLE = np.random.default_rng(0).uniform(0.1, 1.0, (40, 40, 40, 3))


def errors(adapter, reference=TABLE):
    return signed_errors(energy(adapter), energy(reference))


def test_a_target_that_is_10_percent_too_bright_reports_10_percent_in_every_band():
    found = errors(1.1 * TABLE)
    np.testing.assert_allclose(found.theta_i, [0.1] * BANDS)
    np.testing.assert_allclose(found.theta_o, [0.1] * BANDS)


def test_an_error_at_grazing_wo_shows_in_the_grazing_band_of_theta_o_alone():
    wrong = TABLE.copy()
    wrong[:, : 40 // BANDS] *= 1.5
    found = errors(wrong)
    np.testing.assert_allclose(found.theta_o, [0.5, 0, 0, 0, 0], atol=1e-12)
    # Every band of theta_i holds the same directions wo.
    assert (np.array(found.theta_i) > 0.05).all()


def test_an_error_at_grazing_wi_shows_in_the_grazing_band_of_theta_i_alone():
    wrong = TABLE.copy()
    wrong[: 40 // BANDS] *= 0.5
    found = errors(wrong)
    np.testing.assert_allclose(found.theta_i, [-0.5, 0, 0, 0, 0], atol=1e-12)
    assert (np.array(found.theta_o) < -0.05).all()


def test_bins_count_by_their_energy():
    """Dark bins that are twice too bright change the error of a band by little, and bright bins decide."""
    reference = np.full((40, 40, 40, 3), 1e-3)
    reference[:, :, 0] = 1.0
    wrong = reference.copy()
    wrong[:, :, 1:] *= 2.0
    dark = 39 * 1e-3
    np.testing.assert_allclose(errors(wrong, reference).theta_i, [dark / (1.0 + dark)] * BANDS)


def test_energies_of_several_materials_are_added_up():
    ours, theirs = (Energy(*map(np.stack, zip(*map(energy, pair), strict=True))) for pair in (
        (1.5 * TABLE, 3.0 * TABLE), (TABLE, 3.0 * TABLE)
    ))  # fmt: skip
    assert signed_errors(ours, theirs).theta_o == pytest.approx([0.5 / 4.0] * BANDS)


def test_bands_without_light_have_no_error():
    black = TABLE.copy()
    black[:, : 40 // BANDS] = 0.0
    found = errors(TABLE, black).theta_o
    assert np.isnan(found[0]) and np.isfinite(found[1:]).all()
