"""Options are checked where they are declared, for every command alike."""

import pytest
from cli_cases import commands, numbers

import nma as package
from nma import materials

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


def test_the_version_is_printed(nma):
    assert nma("--version") == (0, f"nma {package.__version__}\n", "")


def test_an_interrupted_command_says_so(nma, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(materials, "names", interrupted)
    code, out, err = nma("materials")
    assert (code, out) == (130, "")
    assert err == "nma: interrupted; run the same command again to go on where it can be resumed\n"
