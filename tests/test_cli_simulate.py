"""`nma simulate` writes reference files, and resumes after an interruption."""

import dataclasses
import errno
import shutil
from pathlib import Path

import numpy as np

from nma import sources, table
from nma.params import LAYERED3
from nma.sources.layered import Layered3
from nma.table import Tables


def test_paths_are_printed_as_they_are(nma, tmp_path):
    """A printed path has no line breaks, and its brackets are not read as markup."""
    path = tmp_path / "a folder [bold] of {many} letters in its name" / ("n" * 60 + "[/x].npz")
    code, _, err = nma("simulate", "--draw", 1, "--walks", 1600, "-o", path)
    assert code == 0
    assert f"{path}: 1 material(s), 1,600 walks each\n" in err


def test_faulty_parameters_are_refused_in_one_line(nma, tmp_path):
    path, params = tmp_path / "x.npz", np.zeros((1, 13))
    for arrays, message in (
        ({"params": params[:0]}, "the array `params` of shape (0, 13) has no materials; add a row"),
        ({"params": params, "class": "x" * 100_000}, "x...; this version simulates layered3"),
        ({"params": params, "class": "\x1b[31mred"}, "its materials are of class '\\x1b[31mred'"),
    ):
        np.savez(path, **arrays)
        code, _, told = nma("simulate", "--params", path, "-o", tmp_path / "y.npz")
        assert code == 1 and message in told and told.count("\n") == 1 and len(told) < 700, told


def test_tables_that_cannot_be_fitted_are_refused_before_the_training(nma, tmp_path):
    """`nma fit` and `nma principled` refuse tables without bins or materials, and parameters out of range.

    The weights file records the parameters, and a file with parameters out of range could not be loaded.
    """
    path, params = tmp_path / "x.npz", np.tile(LAYERED3.sample(np.random.default_rng(0), 1), (2, 1))
    bad = params.copy()
    bad[1, 0] = 7.0
    values, walks = np.ones((2, *table.ISOTROPIC.shape)), np.array([1000])
    for arrays, message in (
        (
            {"params": params, "table": values[:, :0]},
            "x.npz: the table of shape (2, 0, 40, 40, 3) has no bins",
        ),
        (
            {"params": params[:0], "table": values[:0]},
            "x.npz: the table of shape (0, 40, 40, 40, 3) has no materials",
        ),
        ({"params": bad, "table": values}, "x.npz: material 1: alpha_top is 7, allowed is 0.0001 .. 1"),
        (
            {"params": params, "table": values, "class": "x" * 100_000},
            "x..., but this version has only",
        ),
    ):
        np.savez(path, walks=walks, **{"class": "layered3", **arrays})
        for command in ("fit", "principled"):
            code, _, told = nma(command, path, "--material", 1, "-o", tmp_path / "y.safetensors")
            assert code == 1 and message in told and told.count("\n") == 1 and len(told) < 700, told


def test_a_disk_that_fills_up_during_the_work_ends_in_one_line(nma, tmp_path, monkeypatch):
    save = np.savez_compressed

    def fills_up(file, **arrays):
        save(file, **arrays)
        if not file.name.startswith(str(tmp_path / "x.npz.parts")):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fills_up)
    code, out, err = nma("simulate", "--draw", 1, "--walks", 1600, "-o", tmp_path / "x.npz")
    assert (code, out) == (1, "")
    assert "nma: " in err.splitlines()[-1] and "No space left" in err.splitlines()[-1]
    # The folder x.npz.parts keeps the simulated material, so that the next run of the command need not simulate it.
    assert [path.name for path in tmp_path.iterdir()] == ["x.npz.parts"]
    monkeypatch.undo()
    monkeypatch.setattr(table, "tabulate", None)
    assert nma("simulate", "--draw", 1, "--walks", 1600, "-o", tmp_path / "x.npz")[0] == 0


def test_a_damaged_part_is_simulated_again(nma, tmp_path):
    output = tmp_path / "x.npz"
    run = ("simulate", "--draw", 2, "--walks", 1600, "--seed", 5, "-o")
    assert nma(*run, tmp_path / "right.npz")[0] == 0
    parts = tmp_path / "x.npz.parts"
    parts.mkdir()
    for key in table.stream_keys(5, range(2)):
        (parts / f"layered3-{key:016x}-1600.npz").write_bytes(b"PK\x03\x04damaged")
    code, _, err = nma(*run, output)
    assert code == 0, err
    np.testing.assert_array_equal(Tables.load(output).values, Tables.load(tmp_path / "right.npz").values)
    assert not parts.exists()


def test_only_a_part_of_the_same_simulation_is_used_again(nma, tmp_path, monkeypatch):
    """The parts of an interrupted run are not used for another material, other walks, another seed or another class.

    In this test, all runs leave their parts. A run that equals the run before simulates nothing.
    """

    class Other(Layered3):
        space = dataclasses.replace(LAYERED3, name="other")

    made = []

    def blank(source, params, walks, keys):
        made.append(keys)
        return Tables(params, np.zeros((1, 2, 2, 2, 3)), np.array([walks]), None, source.space.name)

    monkeypatch.setattr(sources, "get", lambda name: Other() if name == "other" else Layered3())
    monkeypatch.setattr("nma.cli.simulate._remove", lambda parts: None)
    monkeypatch.setattr(table, "tabulate", blank)
    files = [tmp_path / f"{k}.npz" for k in range(2)]
    for k, path in enumerate(files):
        np.savez(path, params=LAYERED3.sample(np.random.default_rng(k), 1))
    first = {"--params": files[0], "--walks": 100, "--seed": 1, "--class": "layered3"}
    for number, change in enumerate(
        ({"--params": files[1]}, {"--walks": 200}, {"--seed": 2}, {"--class": "other"})
    ):
        output = tmp_path / f"output-{number}.npz"
        for options, simulated in ((first, 1), (first | change, 1), (first | change, 0)):
            made.clear()
            code, _, err = nma(
                "simulate", *(word for option in options.items() for word in option), "-o", output
            )
            assert code == 0, err
            assert len(made) == simulated, options
            found = Tables.load(output)
            np.testing.assert_array_equal(found.params, np.load(options["--params"])["params"])
            assert (found.class_name, *found.walks) == (options["--class"], options["--walks"])


def test_a_run_survives_if_another_run_removes_its_parts(nma, tmp_path, monkeypatch):
    """Two runs write the same output, and the first run removes the temporary folder that the second run still uses.

    The temporary folder holds the finished parts of the output. The test removes the folder just before the second run
    renames a part. A failure means that the second run stops with an error.
    """
    replace, taken = Path.replace, []

    def without_folder(self, target):
        if not taken:
            taken.append(shutil.rmtree(tmp_path / "x.npz.parts"))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", without_folder)
    code, _, err = nma("simulate", "--draw", 2, "--walks", 1600, "-o", tmp_path / "x.npz")
    assert code == 0, err
    assert taken and [path.name for path in tmp_path.iterdir()] == ["x.npz"]


def test_a_finished_run_deletes_only_its_own_parts(nma, tmp_path):
    notes = tmp_path / "x.npz.parts/notes.txt"
    notes.parent.mkdir()
    notes.write_text("mine")
    (notes.parent / ".nma-0123456789ab.partial.npz").touch()
    assert nma("simulate", "--draw", 1, "--walks", 1600, "-o", tmp_path / "x.npz")[0] == 0
    assert list(notes.parent.iterdir()) == [notes]
