"""Commands check their outputs before they begin.

If an output cannot be written, the command fails with a message of one line.
"""

import errno
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_cases import commands, parameters
from typer.models import ArgumentInfo

import nma.render.demo  # noqa: F401  # tests replace some of its functions
from nma.images.io import write_exr

WRITING = [words for words, function in commands() if "output" in {name for name, *_ in parameters(function)}]
FUNCTIONS = dict(commands())


def endings(words):
    """Returns the endings of a command's output files, as the option declares them; for a folder, the empty ending."""
    (info,) = (info for name, _, info in parameters(FUNCTIONS[words]) if name == "output")
    return getattr(info.callback, "endings", ("",))


FORMS = [(words, ending) for words in WRITING for ending in endings(words)]


def arguments(words, output):
    """Returns the command-line words of a command that writes `output`.

    The input files do not exist, because the command must refuse a bad output before it reads any input.
    """
    given = []
    for name, _, info in parameters(FUNCTIONS[words]):
        if isinstance(info, ArgumentInfo):
            given.append(output if name == "output" else "nothing.exr")
    positional = "output" in [n for n, _, i in parameters(FUNCTIONS[words]) if isinstance(i, ArgumentInfo)]
    return (*words, *given, *(() if positional else ("-o", output)))


def _renders_nothing(monkeypatch):
    for function in (
        "progressive.render_passes",
        "demo.render_passes",
        "demo.measure",
        "demo.render_seconds",
    ):
        monkeypatch.setattr(f"nma.render.{function}", None)


@pytest.fixture
def bad(tmp_path, monkeypatch):
    """The current folder, which contains a file named `file`. No output can be written to a path like `file/x`."""
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("mine")
    return tmp_path


def test_the_tests_find_all_commands_that_write():
    names = {words[0] for words in WRITING}
    assert {"render", "compare", "demo", "simulate", "dataset", "train", "fit", "principled"} <= names
    assert {("library", "encode"), ("library", "extract"), ("train-library",)} <= set(WRITING)


@pytest.mark.parametrize(("words", "ending"), [form for form in FORMS if form[1]])
def test_the_documentation_has_every_ending(words, ending):
    page = (Path(__file__).parents[1] / "docs/commands.md").read_text()
    section = page.split(f"\n## `nma {words[0]}`\n")[1].split("\n## ")[0]
    assert ending in section, (
        f"docs/commands.md: the section of `nma {words[0]}` must say that the output may end in `{ending}`"
    )


@pytest.mark.parametrize("words", WRITING, ids="-".join)
@pytest.mark.parametrize("output", [".", "..", "/", ""])
def test_a_folder_is_no_output(nma, bad, monkeypatch, words, output):
    """A folder with other files is refused as an output, also for `nma dataset`, whose output is a folder."""

    def write(*args, **kwargs):
        raise AssertionError("nothing may be written")

    monkeypatch.setattr(Path, "write_bytes", write)
    monkeypatch.setattr("zarr.create_array", write)
    code, out, err = nma(*arguments(words, output))
    assert code in (1, 2) and out == "", err
    if output:
        assert "cannot be written" in err or "must end in" in err
    else:
        assert "the path is empty" in err
    assert [path.name for path in bad.iterdir()] == ["file"]


def test_no_command_reads_an_empty_path_as_the_current_folder(nma, bad):
    for words in (
        ("data", "check", ""),
        ("train-library", "", "-o", "x.safetensors"),
        ("train", "layered3", "--data", "", "-o", "x.safetensors"),
        ("library", "list", ""),
    ):
        code, out, err = nma(*words)
        assert (code, out) == (2, "") and "the path is empty" in err, words


def test_only_a_dataset_or_an_empty_folder_becomes_a_dataset(nma, bad):
    small = ("--materials", 1, "--walks", 1600)
    Path("empty").mkdir()
    Path("own").mkdir()
    Path("own/notes.txt").write_text("mine")
    for _ in range(2):
        assert nma("dataset", "layered3", "empty", *small)[0] == 0
    code, out, err = nma("dataset", "layered3", "own", *small)
    assert (code, out, err) == (
        1,
        "",
        "nma: own: cannot be written (a folder with other files); choose a dataset, or a new or an empty folder\n",
    )
    code, _, err = nma("train", "layered3", "--data", "own", "-o", "x.safetensors")
    assert code == 1 and err.count("\n") == 1
    assert "CLASS own" not in err and "`nma dataset CLASS FOLDER` makes one in a new folder" in err
    assert [path.name for path in Path("own").iterdir()] == ["notes.txt"]


def test_the_tests_find_the_endings_of_all_outputs():
    assert {(("principled",), ".xml"), (("data", "merl"), ".binary"), (("simulate",), ".npz")} <= set(FORMS)
    assert [words for words, ending in FORMS if not ending] == [("dataset",)]


@pytest.mark.parametrize(
    ("words", "ending"), FORMS, ids=lambda part: part if isinstance(part, str) else "-".join(part)
)
@pytest.mark.parametrize("place", ["file/sub/x{}", "n" * 300 + "{}", "full/x{}"])
def test_an_output_that_cannot_be_written_is_refused_before_anything_is_read(
    nma, bad, monkeypatch, words, ending, place
):
    if place.startswith("full"):

        def full(*args, **kwargs):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(Path, "write_bytes", full)
    code, out, err = nma(*arguments(words, place.format(ending)))
    assert (code, out) == (1, ""), err
    assert err.startswith("nma: ") and err.count("\n") == 1
    assert "cannot be written" in err
    assert [path.name for path in bad.iterdir()] == ["file"]


def test_errors_of_the_operating_system_are_one_line(nma, monkeypatch):
    def no_folder():
        raise PermissionError(errno.EACCES, "Permission denied", "/locked/cache")

    monkeypatch.setattr("nma.native.build.build_mitsuba", lambda say: no_folder())
    assert nma("mitsuba", "build") == (1, "", "nma: /locked/cache: Permission denied\n")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 74.5 GiB"),
        RuntimeError("jit_malloc(): out of memory! Could not\nallocate 9 GiB"),
        RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 123 bytes."),
    ],
)
def test_too_little_memory_is_one_line(nma, monkeypatch, error):
    def fails():
        raise error

    monkeypatch.setattr("nma.materials.names", fails)
    code, out, err = nma("materials")
    assert (code, out) == (1, "")
    assert err.startswith("nma: out of memory (") and err.count("\n") == 1


@pytest.mark.parametrize("words", [("demo",), ("compare", "gold-red-lacquer"), ("compare", "a.exr", "b.exr")])
def test_missing_packages_are_reported_before_rendering(nma, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    write_exr("a.exr", np.zeros((16, 16, 3)))
    write_exr("b.exr", np.zeros((16, 16, 3)))
    _renders_nothing(monkeypatch)
    for name in ("skimage", "skimage.metrics", "flip_evaluator"):
        monkeypatch.setitem(sys.modules, name, None)
    code, out, err = nma(*words)
    assert (code, out) == (1, "")
    assert err.count("\n") == 1 and "pip install" in err
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("demo", "--adapter", "no-such"), "no-such"),
        (("demo", "--size", 8), "too small for ssim"),
        (("compare", "gold-red-lacquer", "--size", 8), "too small for ssim"),
        (("compare", "gold-red-lacquer", "--adapter", "no-such"), "no-such"),
    ],
)
def test_a_faulty_option_fails_before_rendering(nma, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    _renders_nothing(monkeypatch)
    code, out, err = nma(*words)
    assert (code, out) == (1, "")
    assert message in err.splitlines()[-1] and err.splitlines()[-1].startswith("nma: ")
