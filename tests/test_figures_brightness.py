"""The experiments on brightness, residuals and seeds report what their data say."""

from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import random_adapter

from figures.brightness import run as brightness
from figures.limits import residuals
from figures.shipped import card, seeds

# A column of pixels for each cosine, and a last column that does not show the material.
COSINES = np.tile([*np.linspace(0.15, 0.95, 9), np.nan], (6, 1))
PICTURES = np.random.default_rng(0).uniform(0.1, 1.0, (brightness.PARTS, *COSINES.shape, 3))


def test_pictures_that_are_10_percent_too_bright_report_10_percent_in_every_band():
    found = brightness.errors(1.1 * PICTURES, PICTURES, COSINES, brightness.BANDS)
    np.testing.assert_allclose(found.signed, 0.1)
    np.testing.assert_allclose(found.doubt, 0.0, atol=1e-12)


def test_only_the_band_of_the_wrong_pixels_has_an_error():
    wrong = PICTURES.copy()
    wrong[:, (COSINES > 0.4) & (COSINES < 0.6)] *= 0.8
    # Pixels beside the material and below the lowest band do not count.
    wrong[:, ~(COSINES >= brightness.BANDS[0])] *= 5.0
    found = brightness.errors(wrong, PICTURES, COSINES, brightness.BANDS)
    np.testing.assert_allclose(found.signed, [0.0, -0.2, 0.0, 0.0], atol=1e-12)


def test_the_doubt_is_the_standard_error_over_the_parts():
    factors = np.array([0.9, 1.1, 0.95, 1.05])
    found = brightness.errors(
        np.broadcast_to(factors[:, None, None, None], PICTURES.shape),
        np.ones(PICTURES.shape),
        COSINES,
        brightness.BANDS,
    )
    np.testing.assert_allclose(found.signed, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.doubt, factors.std(ddof=1) / 2.0)


def test_the_summary_names_the_largest_error_of_oblique_views():
    materials = {
        "a": {"signed": [0.01, 0.02, 0.5, 0.5], "doubt": [0.001] * 4},
        "b": {"signed": [0.02, -0.07, 0.0, 0.0], "doubt": [0.004] * 4},
    }
    assert "-7.0 % (standard error 0.4 %): b, 0.4 to 0.6" in brightness.worst(materials)


def test_residuals_are_signed_and_relative():
    reference = np.full((2, 2, 2, 3), 1.0)
    own = reference.copy()
    own[0, 1, 0] = 1.5
    found = residuals.residuals(own, reference)
    assert found[0, 1, 0] == pytest.approx(0.5 / (1.0 + residuals.EPS))
    assert np.count_nonzero(found) == 1


def trained(**recipe):
    return replace(random_adapter(), training={"recipe": {"network": "3x32"} | recipe})


def test_seeds_of_one_recipe_are_accepted_and_others_are_refused():
    files = ["a", "b"]
    seeds.check(files, [trained(seed=0), trained(seed=1)])
    with pytest.raises(SystemExit, match="train each with another --seed"):
        seeds.check(files, [trained(seed=1), trained(seed=1)])
    with pytest.raises(SystemExit, match="b was trained with another network than a"):
        seeds.check(files, [trained(seed=0), trained(seed=1, network="5x64")])
    with pytest.raises(SystemExit, match="b does not record its seed"):
        seeds.check(files, [trained(seed=0), trained()])


def test_the_table_of_seeds_has_mean_and_deviation():
    found = {name: {"mean": 0.002, "std": 0.0001, "seeds": 3} for name in seeds.FIGURES}
    last = seeds.table({"recipe": {"range": found}}).splitlines()[-1]
    assert last == "| recipe | range | 3 |" + " 0.0020 +- 0.0001 |" * 3


def test_cards_show_signed_errors_and_their_sizes():
    bands, sizes = [0.1, 0.0, 0.0, 0.0, -0.05], [0.2] * 5
    found = {"theta_i": bands, "theta_o": bands, "theta_i_size": sizes, "theta_o_size": sizes}
    lines = card._brightness({"range": found | {"non_reciprocity": 0.05}}).splitlines()
    assert lines[2].startswith("| range | +10.0, +0.0, +0.0, +0.0, -5.0 |") and lines[2].endswith("0.050 |")
    assert lines[3].startswith("| range, mean size | 20.0, 20.0,")
