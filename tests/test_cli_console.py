"""The output of commands is readable on terminals of every width."""

import io
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from nma import progress
from nma.cli import console
from nma.evaluate.metrics import FIGURES
from nma.train import fit
from nma.train.recipe import SINGLE


def printed(monkeypatch, width, *table):
    """Prints a table for a terminal of the given width, and returns the printed lines."""
    monkeypatch.setattr(console, "out", Console(width=width, file=io.StringIO()))
    console.out.print(console.table(*table))
    return [line.rstrip() for line in console.out.file.getvalue().splitlines()]


def _figures():
    rng = np.random.default_rng(0)
    return [(f"{n}", *map(float, 10 ** rng.uniform(-5, 2, len(FIGURES)))) for n in range(3)]


@pytest.mark.parametrize("width", [40, 60, 80, 132])
def test_numbers_are_never_broken(monkeypatch, width):
    rows = _figures()
    lines = printed(monkeypatch, width, ("material", *FIGURES), rows, "tiny.safetensors against [x].npz")
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    for _, *figures in rows:
        for figure in figures:
            assert console.number(figure) in words


def test_the_figures_of_an_evaluation_fit_80_columns(monkeypatch):
    """A row of typical figures of merit fits into one line of 80 columns, without lost digits."""
    row = ("mean", 0.002731, 0.004236, 0.09136, 0.07076, 0.001586, 64.42, 0.00521, 0.001035)
    lines = printed(monkeypatch, 80, ("material", *FIGURES), [row])
    assert len(row) == 1 + len(FIGURES)
    assert lines[-1].split() == [
        "mean",
        ".002731",
        ".004236",
        ".09136",
        ".07076",
        ".001586",
        "64.42",
        ".00521",
        ".001035",
    ]


@pytest.mark.parametrize("width", [60, 80])
def test_sentences_are_broken_between_words(monkeypatch, width):
    sentence = "Burnished gold under a glossy red lacquer, orange in the highlights"
    lines = printed(monkeypatch, width, ("name", "", "number"), [("gold", sentence, 1.25)])
    assert max(map(len, lines)) <= width
    assert set(sentence.split()) <= set(" ".join(lines).split())
    assert "1.25" in " ".join(lines)


def test_numbers_have_four_digits_or_two_where_they_are_tiny():
    shown = [console.number(x) for x in (0.0138249, -0.5, 0.0, 1.0, 64.4213, 1.5e-6, np.inf)]
    assert shown == [".01382", "-.5", "0", "1", "64.42", "1.5e-06", "inf"]


@pytest.mark.parametrize("width", [60, 80])
def test_the_output_of_commands_fits_the_terminal(nma, monkeypatch, width):
    monkeypatch.setattr(console, "out", Console(width=width))
    for words in (("materials",), ("materials", "gold-red-lacquer"), ("info",), ("info", "layered3-3x32")):
        code, out, err = nma(*words)
        assert code == 0, err
        assert max(map(len, out.splitlines())) <= width, words


def test_a_fit_shows_a_bar_only_on_terminals_and_only_without_a_callback(monkeypatch):
    class Bar:
        made = 0

        def __init__(self, recipe, title):
            Bar.made += 1

        def __enter__(self):
            return self

        def __exit__(self, *args):
            pass

        def update(self, run):
            pass

    monkeypatch.setattr(progress, "TrainingBar", Bar)
    monkeypatch.setattr(fit, "_fit_values", lambda source, recipe, record, show, budget: show(None))
    for terminal, given, bars in ((True, None, 1), (True, lambda run: None, 0), (False, None, 0)):
        Bar.made = 0
        monkeypatch.setattr(sys.stderr, "isatty", lambda terminal=terminal: terminal)
        fit.fit(object(), SINGLE, progress=given)
        assert Bar.made == bars


def test_the_bar_of_a_short_training_is_full_at_its_end(monkeypatch):
    """The progress bar shows 30/30 steps even if a training reports its loss only once, at the end."""
    monkeypatch.setattr(progress, "err", Console(file=io.StringIO(), width=100))
    with progress.TrainingBar(SimpleNamespace(steps=30, bins_per_step=1)) as bar:
        bar.update(SimpleNamespace(step=30, log_losses=[0.1]))
    assert "30/30" in progress.err.file.getvalue()


def test_a_bar_counts_and_returns_the_rate_of_work(monkeypatch):
    monkeypatch.setattr(progress, "err", Console(file=io.StringIO(), width=120))
    monkeypatch.setattr(console, "time", SimpleNamespace(perf_counter=iter((10.0, 12.0)).__next__))
    with console.counting("simulating", 3, "Mwalks/s") as show:
        assert show(3, 5.0, note="gold") == 2.5
    shown = progress.err.file.getvalue()
    assert all(text in shown for text in ("simulating", "3/3", "2.5 Mwalks/s", "gold"))
