"""The declaration of a class: the distributions of its parameters, its bounds, and the values that it refuses.

The Kolmogorov-Smirnov tests of all columns of a population have the false-alarm rate `FALSE_ALARM` together (Sidak's
correction). Seeds are fixed.
"""

import numpy as np
import pytest
from scipy import stats

from nma import sources
from nma.conductors import load_conductors
from nma.errors import ParamError
from nma.params import LAYERED3, LIBRARY, MEASURED, Param, ParamSpace

FALSE_ALARM = 1e-3
DRAWS = 20_000
POPULATIONS = ("mixed", "broad", "range", "metals", "held_out_metals", "unseen_metals")
NAMES = ("alpha_top", "alpha_bottom", "eta_top", "eta_conductor", "k_conductor", "albedo", "sigma_t")


def draw(population, n=DRAWS, seed=0):
    return LAYERED3.sample(np.random.default_rng(seed), n, population)


def column(vectors, name, channel=0):
    return vectors[:, LAYERED3.slices[name]][:, channel]


def metal_of(vectors):
    """Returns the index of each vector's conductor in the list of conductors, or -1 for an unlisted conductor."""
    metals = load_conductors()
    corpus = np.hstack([metals.eta, metals.k])
    conductors = np.hstack(
        [vectors[:, LAYERED3.slices["eta_conductor"]], vectors[:, LAYERED3.slices["k_conductor"]]]
    )
    equal = (conductors[:, None] == corpus[None]).all(axis=-1)
    return np.where(equal.any(axis=1), equal.argmax(axis=1), -1)


def assert_laws(samples):
    """Asserts by Kolmogorov-Smirnov tests that random values follow their cumulative distributions.

    `samples` holds pairs (values, cumulative distribution) by name.
    """
    level = 1.0 - (1.0 - FALSE_ALARM) ** (1.0 / len(samples))
    for name, (values, cdf) in samples.items():
        assert stats.kstest(values, cdf).pvalue > level, name


@pytest.mark.parametrize("population", [name for name in POPULATIONS if name != "broad"])
def test_every_parameter_follows_its_law(population):
    """Parameters have the distributions of the paper's Table 1: 10^U, U and 1 - U^2, where U is uniform.

    The cumulative distribution of 1 - U^2 is 1 - sqrt(1 - x). A failure means that a parameter has another
    distribution.
    """
    vectors = draw(population)
    logarithmic = {"alpha_top": (-3.0, 2.5), "alpha_bottom": (-3.0, 3.0)}
    samples = {
        name: (np.log10(column(vectors, name)), stats.uniform(*law).cdf) for name, law in logarithmic.items()
    }
    samples["eta_top"] = column(vectors, "eta_top"), stats.uniform(1.05, 0.95).cdf
    samples["sigma_t"] = column(vectors, "sigma_t"), stats.uniform(0.0, 1.0).cdf
    for channel in range(3):
        samples[f"albedo {channel}"] = column(vectors, "albedo", channel), lambda x: 1.0 - np.sqrt(1.0 - x)
    assert_laws(samples)


@pytest.mark.parametrize("population", ("range", "mixed"))
def test_conductors_of_the_range_are_uniform(population):
    """In the population `range`, the values of eta and k of the conductors are uniform over their ranges.

    In the population `mixed`, eta and k of all conductors that are not real metals are uniform too.
    """
    vectors = draw(population)
    vectors = vectors[metal_of(vectors) < 0]
    samples = {}
    for channel in range(3):
        samples[f"eta {channel}"] = (
            column(vectors, "eta_conductor", channel),
            stats.uniform(0.03, 7.57).cdf,
        )
        samples[f"k {channel}"] = column(vectors, "k_conductor", channel), stats.uniform(0.0, 9.5).cdf
    assert_laws(samples)


def test_half_of_the_mixed_population_are_real_metals():
    metals = (metal_of(draw("mixed")) >= 0).sum()
    assert stats.binomtest(int(metals), DRAWS, 0.5).pvalue > FALSE_ALARM
    assert (metal_of(draw("range")) < 0).all()


def test_a_third_of_the_broad_population_is_near_the_ends_of_the_ranges():
    """Two thirds are real metals. A sixth has a grey pigment, and the law of sigma_t has the ends of a beta law."""
    drawn = draw("broad")
    count = lambda rows: int(np.count_nonzero(rows))
    assert stats.binomtest(count(metal_of(drawn) >= 0), DRAWS, 2 / 3).pvalue > FALSE_ALARM
    albedo = drawn[:, LAYERED3.slices["albedo"]]
    assert stats.binomtest(count(albedo[:, 0] == albedo[:, 1]), DRAWS, 1 / 6).pvalue > FALSE_ALARM
    sigma_t = LAYERED3["sigma_t"].normalise(column(drawn, "sigma_t"))
    law = lambda x: (2.0 * x + stats.beta(0.5, 0.5).cdf(x)) / 3.0
    assert stats.kstest(sigma_t, law).pvalue > FALSE_ALARM


@pytest.mark.parametrize(
    ("population", "held_out"),
    [("mixed", False), ("broad", False), ("metals", False), ("held_out_metals", True)],
)
def test_metals_are_drawn_evenly_from_their_own_list(population, held_out):
    corpus = load_conductors()
    metals = metal_of(draw(population))
    metals = metals[metals >= 0]
    # Some metals are in the list twice, with equal values, and are drawn twice as often.
    assert (corpus.held_out[metals] == held_out).all()
    rows = np.nonzero(corpus.held_out == held_out)[0]
    values = np.hstack([corpus.eta, corpus.k])[rows]
    _, which, multiplicity = np.unique(values, axis=0, return_inverse=True, return_counts=True)
    group = dict(zip(rows.tolist(), which.ravel().tolist(), strict=True))
    found = np.bincount([group[m] for m in metals.tolist()], minlength=len(multiplicity))
    assert stats.chisquare(found, multiplicity / len(rows) * len(metals)).pvalue > FALSE_ALARM


def test_no_metal_held_out_is_ever_trained_on():
    """No material drawn for training has the values of a held-out metal, under its own name or another name."""
    corpus = load_conductors()
    values = np.hstack([corpus.eta, corpus.k])
    held_out = values[corpus.held_out]
    assert len(np.unique(held_out, axis=0)) == 8
    equal = (values[~corpus.held_out][:, None] == held_out[None]).all(axis=-1)
    assert not equal.any()
    for seed in range(5):
        for population in ("mixed", "metals"):
            metals = metal_of(draw(population, seed=seed))
            assert not corpus.held_out[metals[metals >= 0]].any()


def test_a_third_of_the_unseen_metals_is_held_out():
    corpus = load_conductors()
    metals = metal_of(draw("unseen_metals", 60))
    assert (metals >= 0).all()
    assert corpus.held_out[metals].sum() == 20


@pytest.mark.parametrize("population", POPULATIONS)
def test_draws_lie_in_the_training_range(population):
    """All drawn materials, even real metals, lie in the training range. The training range lies in the valid range."""
    vectors = draw(population)
    np.testing.assert_array_equal(LAYERED3.check(vectors, "training"), vectors)
    np.testing.assert_array_equal(LAYERED3.check(vectors), vectors)


def test_draws_depend_on_the_seed_alone():
    np.testing.assert_array_equal(draw("mixed", 10, 3), draw("mixed", 10, 3))
    assert (draw("mixed", 10, 3)[:, 0] != draw("mixed", 10, 4)[:, 0]).all()
    assert draw("mixed", 0).shape == (0, 13)


def test_an_unknown_population_is_refused():
    with pytest.raises(ParamError, match="unknown population 'gold'; known are mixed, broad, range"):
        draw("gold", 1)


def test_the_class_is_that_of_the_paper_s_table_1():
    assert sources.space("layered3") == LAYERED3
    assert tuple(p.name for p in LAYERED3.params) == NAMES
    assert LAYERED3.size == 13
    assert [(s.start, s.stop) for s in LAYERED3.slices.values()] == [
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 6),
        (6, 9),
        (9, 12),
        (12, 13),
    ]
    low, high = LAYERED3.columns("training")
    np.testing.assert_allclose(low, [1e-3, 1e-3, 1.05, *[0.03] * 3, *[0.0] * 3, *[0.0] * 3, 0.0])
    np.testing.assert_allclose(high, [10**-0.5, 1.0, 2.0, *[7.6] * 3, *[9.5] * 3, *[1.0] * 3, 1.0])
    valid_low, valid_high = LAYERED3.columns("valid")
    assert (valid_low <= low).all()
    assert (valid_high >= high).all()


@pytest.mark.parametrize("param", LAYERED3.params, ids=NAMES)
def test_normalisation_maps_the_training_range_to_the_unit_interval(param):
    assert param.normalise(param.low) == pytest.approx(0.0, abs=1e-12)
    assert param.normalise(param.high) == pytest.approx(1.0)
    middle = np.sqrt(param.low * param.high) if param.law == "log10" else 0.5 * (param.low + param.high)
    np.testing.assert_allclose(param.normalise(np.array([middle])), 0.5)


def test_a_vector_is_built_from_names():
    values = {
        "alpha_top": 0.1,
        "alpha_bottom": 0.2,
        "eta_top": 1.5,
        "eta_conductor": (0.2, 0.9, 1.1),
        "k_conductor": [3.9, 2.4, 2.2],
        "albedo": 0.5,
        "sigma_t": np.float32(1.0),
    }
    vector = LAYERED3.vector(values)
    np.testing.assert_allclose(vector, [0.1, 0.2, 1.5, 0.2, 0.9, 1.1, 3.9, 2.4, 2.2, 0.5, 0.5, 0.5, 1.0])
    for change, message in (
        ({"gloss": 1.0}, "unknown parameter 'gloss'"),
        ({"albedo": (0.1, 0.2)}, r"albedo needs 3 number\(s\), got shape \(2,\)"),
        ({"sigma_t": (0.1, 0.2, 0.3)}, r"sigma_t needs 1 number\(s\)"),
        ({"sigma_t": "thick"}, "sigma_t needs number.*'thick'"),
        ({"albedo": [[0.5]]}, "albedo needs 3"),
    ):
        with pytest.raises(ParamError, match=message):
            LAYERED3.vector(values | change)
    del values["sigma_t"]
    with pytest.raises(ParamError, match="missing parameter 'sigma_t'"):
        LAYERED3.vector(values)


def test_parameters_are_found_by_name():
    assert LAYERED3["sigma_t"].symbol == "sigma_t"
    with pytest.raises(ParamError, match="no parameter 'gloss'; it has alpha_top, .*sigma_t"):
        LAYERED3["gloss"]


FINITE_BOUNDS = [
    (bounds, name, side)
    for bounds in ("training", "valid")
    for name in NAMES
    for side in (0, 1)
    if np.isfinite(LAYERED3[name].bounds(bounds)[side])
]


@pytest.mark.parametrize(("bounds", "name", "side"), FINITE_BOUNDS)
def test_a_value_beyond_a_bound_is_refused_with_name_row_and_range(bounds, name, side):
    vectors = draw("mixed", 4)
    param = LAYERED3[name]
    bound = param.bounds(bounds)[side]
    column(vectors, name, param.size - 1)[2] = bound + (2 * side - 1) * 0.01
    low, high = (f"{x:g}" for x in param.bounds(bounds))
    with pytest.raises(ParamError) as caught:
        LAYERED3.check(vectors, bounds)
    message = str(caught.value)
    assert message.startswith(f"material 2: {name} is ")
    assert f"allowed is {low} .. {high}" in message
    assert ("clamp" in message) == (bounds == "training")
    assert "\n" not in message
    clamped = LAYERED3.check(vectors, bounds, clamp=True)
    assert column(clamped, name, param.size - 1)[2] == bound
    clamped[2] = vectors[2]
    np.testing.assert_array_equal(clamped, vectors)


def test_rounding_beyond_a_bound_is_allowed():
    """Values at a bound are accepted after rounding to single precision, and `check` moves them into the range."""
    ends = np.stack(LAYERED3.columns("training"))
    rounded = ends.astype(np.float32)
    checked = LAYERED3.check(rounded, "training")
    assert ((checked >= ends[0]) & (checked <= ends[1])).all()
    np.testing.assert_allclose(checked, ends, rtol=1e-6)


@pytest.mark.parametrize("clamp", (False, True))
@pytest.mark.parametrize("value", (np.nan, np.inf, -np.inf))
def test_infinite_values_and_nan_are_refused_even_with_clamp(value, clamp):
    vectors = draw("mixed", 3)
    vectors[1, 12] = value
    for bounds in ("training", "valid"):
        with pytest.raises(ParamError, match="material 1: sigma_t is "):
            LAYERED3.check(vectors, bounds, clamp=clamp)


def test_arrays_of_another_shape_are_refused():
    assert LAYERED3.check(draw("mixed", 1)[0]).shape == (1, 13)
    assert LAYERED3.check(np.empty((0, 13))).shape == (0, 13)
    for shape in ((2, 12), (13, 2), (2, 2, 13), ()):
        with pytest.raises(ParamError, match=r"class layered3 have shape \(n, 13\)"):
            LAYERED3.check(np.zeros(shape))


def test_check_leaves_its_argument_alone():
    vectors = draw("mixed", 2)
    vectors[0, 12] = 5.0
    before = vectors.copy()
    LAYERED3.check(vectors, "training", clamp=True)
    np.testing.assert_array_equal(vectors, before)


def test_a_class_without_a_conductor_accepts_every_population():
    space = ParamSpace("paint", (Param("gloss", "g", "uniform", 0.0, 1.0, 0.0, 1.0, "how shiny"),))
    for population in POPULATIONS:
        assert space.sample(np.random.default_rng(0), 5, population).shape == (5, 1)


def test_classes_are_registered_by_their_names():
    assert {LAYERED3.name, MEASURED.name, LIBRARY.name} <= set(sources.classes())
    assert {name: sources.space(name).name for name in sources.classes()} == {n: n for n in sources.classes()}
    for name in sources.names():
        assert sources.get(name).space == sources.space(name)


def test_an_unknown_class_is_refused():
    with pytest.raises(
        ParamError, match="there is no class 'paint'; the classes are layered3, .*measured, library"
    ):
        sources.space("paint")
