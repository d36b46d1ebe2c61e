"""The options of all commands declare bounds or choices, and refuse all other values."""

from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from cli_cases import commands, numbers

import nma as package
from nma import cli, materials, sources
from nma.cli import options
from nma.params import Population
from nma.target import TARGETS
from nma.train.recipe import Recipe

NUMBERS = list(numbers())
IDS = [f"{'-'.join(words)}{option}" for words, option, _ in NUMBERS]


def test_the_tests_find_every_command():
    assert {("render",), ("demo",), ("library", "encode"), ("mitsuba", "build")} <= {w for w, _ in commands()}
    assert len(NUMBERS) > 30


@pytest.mark.parametrize(("words", "option", "info"), NUMBERS, ids=IDS)
def test_every_number_has_bounds_and_a_number_outside_is_wrong_usage(nma, words, option, info):
    assert info.min is not None and info.max is not None
    for value in (info.min - 1, 2 * info.max + 1, "nan"):
        code, out, err = nma(*words, option, value)
        assert (code, out) == (2, ""), value
        assert f"'{option}'" in err and "Traceback" not in err


def test_the_choices_of_options_are_the_values_that_the_code_declares():
    hints = get_type_hints(Recipe)
    assert options.TARGETS == get_args(hints["target"]) == tuple(TARGETS)
    assert options.POINTS_LAWS == get_args(hints["points_law"])
    assert options.LOSSES == get_args(hints["loss"])
    assert options.POPULATIONS == get_args(Population)


@pytest.mark.parametrize(
    "words",
    [
        *(
            ("fit", "gold-red-lacquer", "-o", "x.safetensors", f"--{o}", "no")
            for o in ("target", "loss", "points-law", "variant")
        ),
        *(
            ("train", "layered3", "-o", "x.safetensors", "--stream", 1, f"--{o}", "no")
            for o in ("preset", "variant", "loss")
        ),
        ("simulate", "--draw", 1, "-o", "x.npz", "--population", "no"),
        ("dataset", "layered3", "x", "--population", "unseen_metals"),
    ],
    ids=lambda words: "".join(words[:1] + words[-2:-1]),
)
def test_an_unknown_choice_is_wrong_usage(nma, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    code, out, err = nma(*words)
    assert (code, out) == (2, "")
    assert f"'{words[-2]}'" in err and "is not one of" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "ending"),
    [
        (("simulate", "--draw", 1, "--walks", 100), ".npz"),
        (("fit", "gold-red-lacquer"), ".safetensors"),
        (("train", "layered3", "--stream", 1), ".safetensors"),
        (("train-library", "merl"), ".safetensors"),
        (("library", "encode", "a.safetensors", "b.bsdf"), ".safetensors"),
        (("library", "extract", "a.safetensors", "b"), ".safetensors"),
        (("principled", "gold-red-lacquer"), ".xml"),
        (("data", "merl", "gold-red-lacquer"), ".binary"),
        (("render", "gold-red-lacquer"), ".png"),
        (("compare", "a.png", "b.png"), ".png"),
        (("demo",), ".png"),
    ],
    ids=lambda given: given if isinstance(given, str) else given[0],
)
def test_an_output_must_have_the_ending_of_its_format(nma, tmp_path, monkeypatch, words, ending):
    """A command refuses an output file whose name has a wrong ending, because no command would read this file.

    The command checks the name before any other work.
    """
    monkeypatch.chdir(tmp_path)
    for name in ("x", "x.bin"):
        code, out, err = nma(*words, "-o", name)
        assert (code, out) == (2, "")
        assert f"{name} must end in {ending}" in err
    assert list(tmp_path.iterdir()) == []


def test_the_longest_ending_of_a_name_counts():
    """A file whose name ends in .blend.json has the format of this ending, not the format of .json."""
    endings = (".xml", ".json", ".blend.json")
    for name, found in (
        ("a.json", ".json"),
        ("a.v2.json", ".json"),
        ("a.blend.json", ".blend.json"),
        (".json", None),
        ("json", None),
        ("a.JSON", None),
    ):
        assert options.ending(Path("folder.xml", name), endings) == found


def test_a_network_is_refused_before_a_material_is_simulated(nma, tmp_path, monkeypatch):
    monkeypatch.setattr("nma.cli.reading.known_of", None)
    code, _, err = nma("fit", "gold-red-lacquer", "--network", "0x8", "-o", tmp_path / "x.safetensors")
    assert code == 1 and "DEPTHxWIDTH" in err


def test_the_version_is_printed(nma):
    assert nma("--version") == (0, f"nma {package.__version__}\n", "")


def test_an_interrupted_command_says_whether_the_next_run_continues(nma, tmp_path, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(materials, "load", interrupted)
    monkeypatch.setattr(sources, "get", interrupted)
    stored = "nma: interrupted; run the same command again to continue from its stored results\n"
    lost = "nma: interrupted; unfinished results were not written; run the command again\n"
    for words, message in (
        (("simulate", "--draw", 1, "-o", "x.npz"), stored),
        (("dataset", "layered3", "x.zarr"), stored),
        (("train", "layered3", "--stream", 1, "-o", "x.safetensors"), stored),
        (("materials",), lost),
        (("render", "gold-red-lacquer"), lost),
        (("fit", "gold-red-lacquer", "-o", "x.safetensors"), lost),
        (("data", "merl", "gold-red-lacquer", "-o", "x.binary"), lost),
    ):
        assert nma(*words) == (130, "", message), words


def test_the_help_of_every_resuming_command_says_that_the_command_resumes():
    told = {words[-1] for words, function in commands() if "continues a killed run" in function.__doc__}
    assert told == set(cli.RESUMING)
