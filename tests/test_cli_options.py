"""Options are checked where they are declared, for every command alike."""

from typing import get_args, get_type_hints

import pytest
from cli_cases import commands, numbers

import nma as package
from nma import materials
from nma.cli import options
from nma.params import Population
from nma.target import TARGETS
from nma.train.recipe import Recipe

NUMBERS = list(numbers())
IDS = [f"{'-'.join(words)}{option}" for words, option, _ in NUMBERS]


def test_every_command_is_looked_at():
    assert {("render",), ("demo",), ("library", "encode"), ("mitsuba", "build")} <= {w for w, _ in commands()}
    assert len(NUMBERS) > 30


@pytest.mark.parametrize(("words", "option", "info"), NUMBERS, ids=IDS)
def test_every_number_has_bounds_and_what_lies_outside_is_wrong_usage(nma, words, option, info):
    assert info.min is not None and info.max is not None
    for value in (info.min - 1, 2 * info.max + 1, "nan"):
        code, out, err = nma(*words, option, value)
        assert (code, out) == (2, ""), value
        assert f"'{option}'" in err and "Traceback" not in err


def test_words_to_choose_from_are_those_that_are_declared():
    hints = get_type_hints(Recipe)
    assert options.TARGETS == get_args(hints["target"]) == tuple(TARGETS)
    assert options.POINTS_LAWS == get_args(hints["points_law"])
    assert options.LOSSES == get_args(hints["loss"])
    assert options.POPULATIONS == get_args(Population)


@pytest.mark.parametrize(
    "words",
    [
        *(
            ("fit", "gold-red-lacquer", "-o", "x", f"--{o}", "no")
            for o in ("target", "loss", "points-law", "variant")
        ),
        *(
            ("train", "layered3", "-o", "x", "--stream", 1, f"--{o}", "no")
            for o in ("preset", "variant", "loss")
        ),
        ("simulate", "--draw", 1, "-o", "x", "--population", "no"),
        ("dataset", "layered3", "x", "--population", "unseen_metals"),
    ],
    ids=lambda words: "".join(words[:1] + words[-2:-1]),
)
def test_words_that_are_none_of_these_are_wrong_usage(nma, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = nma(*words)
    assert (code, out) == (2, "")
    assert f"'{words[-2]}'" in err and "is not one of" in err
    assert list(tmp_path.iterdir()) == []


def test_the_version_is_printed(nma):
    assert nma("--version") == (0, f"nma {package.__version__}\n", "")


def test_an_interrupted_command_says_so(nma, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(materials, "names", interrupted)
    code, out, err = nma("materials")
    assert (code, out) == (130, "")
    assert err == "nma: interrupted; run the same command again to go on where it can be resumed\n"
