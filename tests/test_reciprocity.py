"""Tests of `nma/evaluate/reciprocity.py` and its bench, which measure how far an adapter is from reciprocal."""

import numpy as np
from adapter_cases import materials, random_adapter

from bench import reciprocity
from nma.evaluate.reciprocity import non_reciprocity, swapped_pairs

MATERIAL = materials(1)[0]


def test_adapters_with_constant_parameters_are_reciprocal():
    found = reciprocity.measured(random_adapter(directional=False), MATERIAL, 4000)
    assert np.abs(list(found.values())).max() < 1e-9


def test_both_orders_reflect_the_same_over_all_directions():
    """Swapping wi and wo does not change the integral of f cos(theta_i) cos(theta_o) over all pairs of directions.

    In each of the three channels, the means with and without swapping agree within four standard errors. The
    false-alarm rate over all channels is 2e-4.
    """
    n, rng = 1 << 15, np.random.default_rng(1)
    both = swapped_pairs(random_adapter(), MATERIAL, np.sqrt(rng.random(n)), rng)
    off = both.swapped - both.forward
    assert (np.abs(off.mean(axis=1)) < 4.0 * off.std(axis=1) / n**0.5).all()
    # Swapping wi and wo changes the values of single pairs of directions far more than the mean over all pairs.
    assert (np.abs(off).mean(axis=1) > 10.0 * np.abs(off.mean(axis=1))).all()


def test_adapters_that_follow_the_direction_are_not_reciprocal():
    found = reciprocity.measured(random_adapter(), MATERIAL, 4000)
    assert set(found) == {"difference", *(f"cos {c}" for c in reciprocity.COSINES)}
    assert np.min(found["difference"]) > 0.02
    assert np.abs(found["cos 0.2"]).max() > 0.02


def test_non_reciprocity_is_0_within_rounding_for_reciprocal_targets_alone():
    assert non_reciprocity(random_adapter(directional=False), MATERIAL, 4000) < 1e-9
    directional = random_adapter()
    per_channel = reciprocity.measured(directional, MATERIAL, 4000)["difference"]
    found = non_reciprocity(directional, MATERIAL, 4000)
    assert min(per_channel) <= found <= max(per_channel)
    assert found > 0.02
