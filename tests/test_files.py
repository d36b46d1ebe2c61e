"""Files are written completely or not at all. Outputs that cannot be written are refused before any work."""

import errno
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nma.errors import NmaError, OutputError
from nma.files import try_file, try_folder, whole, whole_folder, write_bytes
from nma.images import io
from nma.sources import nbrdf
from nma.sources.merl import SHAPE, Merl
from nma.table import Tables
from nma.train.plot import plot_losses

ROOT = Path(__file__).parents[1]
IMAGE = np.full((4, 4, 3), 0.5, np.float32)


def contents(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


@pytest.fixture
def places(tmp_path) -> dict[str, Path]:
    """Paths that cannot be written, each with a part of the error message that a write to the path must raise."""
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "file").write_text("mine")
    return {
        "a folder has this name": tmp_path / "folder.npz",
        "a file where a folder is needed": tmp_path / "file" / "sub" / "a.npz",
        "name too long": tmp_path / ("n" * 300 + ".npz"),
        "too long": tmp_path / ("n" * 300) / "a.npz",
        "not a regular file": Path(os.devnull),
    }


@pytest.mark.parametrize("path", [".", "/", ".."])
@pytest.mark.parametrize("write", [try_file, lambda path: write_bytes(path, b"content")])
def test_a_path_without_a_name_is_refused_as_a_folder(tmp_path, monkeypatch, path, write):
    for folder in (tmp_path, Path("/")):
        monkeypatch.chdir(folder)
        with pytest.raises(
            OutputError, match="cannot be written .a folder has this name.; choose another place"
        ):
            write(path)


@pytest.mark.parametrize("write", [try_file, try_folder, lambda path: write_bytes(path, b"content")])
def test_an_empty_path_is_refused_as_empty(write):
    with pytest.raises(OutputError, match="cannot be written .the path is empty.; name a file or a folder"):
        write("")


@pytest.mark.parametrize("write", [try_file, lambda path: write_bytes(path, b"content")])
def test_an_unwritable_path_is_refused_in_one_line_that_says_why(places, tmp_path, write):
    before = contents(tmp_path)
    for reason, path in places.items():
        with pytest.raises(OutputError) as error:
            write(path)
        assert reason in str(error.value).lower()
        assert "\n" not in str(error.value) and len(str(error.value)) < 400
    assert contents(tmp_path) == before


def test_a_trial_leaves_no_trace(tmp_path):
    try_file(tmp_path / "new" / "folder" / "a.npz", tmp_path / "b.npz")
    try_folder(tmp_path / "new" / "folder")
    assert contents(tmp_path) == []
    (tmp_path / "b.npz").write_text("old")
    try_file(tmp_path / "b.npz")
    assert (tmp_path / "b.npz").read_text() == "old"
    with pytest.raises(OutputError, match="a file where a folder is needed"):
        try_folder(tmp_path / "b.npz")


def test_names_as_long_as_the_system_allows_are_written(tmp_path):
    path = tmp_path / ("n" * (os.pathconf(tmp_path, "PC_NAME_MAX") - 4) + ".npz")
    try_file(path)
    write_bytes(path, b"content")
    assert path.read_bytes() == b"content"


def test_a_failed_write_keeps_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.png"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), whole(path) as file:
        file.write_text("new")
        assert file.suffix == ".png"
        1 / 0  # noqa: B018
    assert contents(tmp_path) == ["a.png"]
    assert path.read_text() == "old"


def test_a_folder_is_written_completely_or_not_at_all(tmp_path):
    with pytest.raises(ZeroDivisionError), whole_folder(tmp_path / "made") as folder:
        (folder / "half").touch()
        1 / 0  # noqa: B018
    assert contents(tmp_path) == []
    with whole_folder(tmp_path / "new" / "made") as folder:
        (folder / "all").touch()
    assert contents(tmp_path) == ["new", "new/made", "new/made/all"]


def test_if_two_writers_make_a_folder_the_first_wins(tmp_path):
    with whole_folder(tmp_path / "made") as late:
        (late / "file").write_text("late")
        with whole_folder(tmp_path / "made") as early:
            (early / "file").write_text("early")
    assert contents(tmp_path) == ["made", "made/file"]
    assert (tmp_path / "made" / "file").read_text() == "early"


@pytest.mark.parametrize("program", ["bench", "figures", "tools.map MAP", "nma.export FOLDER"])
def test_a_list_ends_silently_if_the_reader_of_the_pipe_has_ended(program, tmp_path):
    """`python -m bench | head -5` prints no traceback."""
    reading, writing = os.pipe()
    os.close(reading)
    name, *outputs = program.split()
    command = [sys.executable, "-m", name, *(tmp_path / output for output in outputs)]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


def _full(*args, **kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


WRITERS = {
    "tables": lambda path: Tables(np.zeros((1, 0)), np.zeros((1, 2, 2, 2, 3)), np.ones(1, int)).save(path),
    "merl": lambda path: Merl(np.ones((3, *SHAPE))).save(path),
    "png": lambda path: io.write_png(path, IMAGE),
    "exr": lambda path: io.write_exr(path, IMAGE),
    "plot": lambda path: plot_losses([1.0, 2.0, 3.0], path, "losses"),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_raises_one_line_and_leaves_no_file(tmp_path, monkeypatch, writer):
    """On a full disk the error of every writer is one line, and no file remains.

    Every writer uses `whole`. The test makes the last step of `whole` fail, which is a call of `Path.replace`.
    """
    monkeypatch.setattr(Path, "replace", _full)
    with pytest.raises(OutputError, match="No space left on device.*free some space"):
        WRITERS[writer](tmp_path / "a.png")
    assert contents(tmp_path) == []


def test_a_full_disk_is_noticed_by_the_trial(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "write_bytes", _full)
    with pytest.raises(OutputError, match="free some space"):
        try_file(tmp_path / "a.png")


@pytest.mark.parametrize("content", [b"", b"title = 'x'", pickle.dumps([1])])
def test_a_file_that_is_no_archive_is_refused_without_advice_to_unpickle_it(tmp_path, content):
    path = tmp_path / "gold.npz"
    path.write_bytes(content)
    for read in (Tables.load, nbrdf.read):
        with pytest.raises(NmaError, match=r"gold\.npz: .*it is not an \.npz file") as error:
            read(path)
        assert "pickle" not in str(error.value)


def test_a_link_stays_and_the_file_that_it_names_is_replaced(tmp_path):
    real, link = tmp_path / "there" / "real.npz", tmp_path / "link.npz"
    real.parent.mkdir()
    real.write_bytes(b"old")
    link.symlink_to(real)
    write_bytes(link, b"new")
    assert link.is_symlink()
    assert real.read_bytes() == b"new"
    assert contents(real.parent) == ["real.npz"]


def test_the_trial_is_made_where_a_link_leads(tmp_path, monkeypatch):
    """If a path is a symbolic link, `try_file` tests the folder of the linked file, because `whole` writes there."""
    real, link = tmp_path / "there" / "real.npz", tmp_path / "link.npz"
    real.parent.mkdir()
    link.symlink_to(real)
    written = []
    monkeypatch.setattr(Path, "write_bytes", lambda path, content: written.append(path))
    try_file(link)
    assert [path.parent for path in written] == [real.parent]


@pytest.mark.parametrize("mode", [0o600, 0o664])
def test_a_file_keeps_its_permissions(tmp_path, mode):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    path.chmod(mode)
    write_bytes(path, b"new")
    assert path.stat().st_mode & 0o777 == mode
