"""`nma evaluate` prints figures of merit as a table, or as JSON for other programs."""

import json

import numpy as np
import pytest

from nma.cli.evaluate import _finite
from nma.evaluate.brightness import BANDS
from nma.evaluate.metrics import FIGURES


def test_simulate_and_evaluate_print_one_json_object_and_nothing_else(nma, untrained, tmp_path):
    drawn, again = tmp_path / "drawn.npz", tmp_path / "again.npz"
    assert nma("simulate", "--draw", 2, "--walks", 16_000, "--seed", 3, "-o", drawn)[0] == 0
    code, out, _ = nma("simulate", "--params", drawn, "--walks", 16_000, "--seed", 3, "-o", again)
    assert (code, out) == (0, "")
    with np.load(drawn) as one, np.load(again) as two:
        assert one["params"].shape == (2, 13)
        for name in ("class", "params", "table", "walks", "error"):
            np.testing.assert_array_equal(one[name], two[name])
    code, out, _ = nma("evaluate", untrained, "--reference", again, "--json")
    assert code == 0
    result = json.loads(out)
    assert set(result) == {"mean", "materials"}
    assert len(result["materials"]) == 2
    for figures in (result["mean"], *result["materials"]):
        assert tuple(figures) == (*FIGURES, "signed_theta_i", "signed_theta_o", "non_reciprocity")
        assert all(np.isfinite(values).all() for values in figures.values())
        assert len(figures["signed_theta_i"]) == len(figures["signed_theta_o"]) == BANDS
    for name in FIGURES:
        assert result["mean"][name] == pytest.approx(np.mean([m[name] for m in result["materials"]]))


def test_json_has_no_infinity():
    """The PSNR of two equal tables is infinite, which JSON output writes as null."""
    assert _finite({"psnr": float("inf"), "ae": 0.0}) == {"psnr": None, "ae": 0.0}
