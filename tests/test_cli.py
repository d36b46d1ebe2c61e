"""The command line: its help, its documentation, and its error messages."""

import re
import shlex
import subprocess
import sys
from itertools import permutations
from pathlib import Path

import pytest
import typer
from cli_cases import commands

from nma import cli

DOCS = Path(__file__).parents[1] / "docs"
APP = typer.main.get_command(cli.app)
COMMANDS = tuple(APP.commands)


# Packages that take long to import, so that `nma --help` and `nma --version` must not import them.
HEAVY = ("numpy", "mitsuba", "drjit", "jax", "zarr", "PIL", "matplotlib")


def test_every_command_has_a_file_of_its_name():
    for words, function in commands():
        file = function.__module__.removeprefix("nma.cli.")
        assert file in cli.COMMANDS
        assert file in words[0].split("-")  # for example, the code of `nma train-library` is in library.py


def test_help_and_version_import_no_slow_package():
    for option in ("--help", "--version"):
        code = f"""
import sys
from nma.cli import app
sys.argv = ["nma", "{option}"]
try:
    app()
finally:
    sys.stderr.write(" ".join(name for name in {HEAVY} if name in sys.modules))
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(nma, command):
    code, out, _ = nma(command, "--help")
    assert code == 0
    assert APP.commands[command].help.split(".")[0].split()[0] in out


def test_the_documentation_has_every_command_with_every_option():
    """docs/commands.md has a section for each command, which lists exactly the options of the command."""
    text = (DOCS / "commands.md").read_text()
    sections = dict(re.findall(r"^## `nma ([\w-]+)`\n(.*?)(?=^## |\Z)", text, re.M | re.S))
    missing, extra = (sorted(a - b) for a, b in permutations((set(COMMANDS), set(sections))))
    assert not missing, f"docs/commands.md: add a section '## `nma {missing[0]}`' with a table of its options"
    assert not extra, f"docs/commands.md: there is no command {extra[0]}; remove its section"
    for command, section in sections.items():
        options = {
            max(p.opts, key=len) for p in APP.commands[command].params if p.param_type_name == "option"
        }
        documented = set(re.findall(r"^\| `(--[\w-]+)", section, re.M))
        assert documented == options - {"--help"}, (
            f"docs/commands.md: the table in the section of `nma {command}` needs a row '| `--OPTION` |' for each "
            "option of the command, and no others"
        )


def test_the_examples_of_the_documentation_parse():
    """The parser accepts every line that starts with `nma` in the code blocks of all pages."""
    pages = [*DOCS.glob("*.md"), DOCS.parent / "README.md"]
    blocks = [
        b for page in pages for b in re.findall(r"^```(?:sh)?\n(.*?)^```", page.read_text(), re.M | re.S)
    ]
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("nma ")]
    assert len(lines) > 20
    for line in lines:
        _, command, *arguments = shlex.split(re.split(r"\s# ", line)[0])
        APP.commands[command].make_context(command, arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("render", "gold-red-laquer"), "did you mean 'gold-red-lacquer'"),
        (("render", "gold-red-lacquer", "--set", "alpha_tip=1"), "did you mean 'alpha_top'"),
        (("render", "no.xml"), "no scene file"),
        (("render", "gold-red-lacquer", "--camera", "side"), "unknown camera"),
        (("render", "gold-red-lacquer", "--model", "layers"), "unknown model"),
        (("render", "gold-red-lacquer", "--variant", "metal_rgb"), "no variant"),
        (("render", "gold-red-lacquer", "--variant", "llvm_ad_mono"), "rendered in RGB"),
        (("demo", "--variant", "llvm_ad_spectral"), "rendered in RGB"),
        (
            ("train", "layered3", "--stream", 1, "-o", "x.safetensors", "--network", "\u00b2x\u00b2"),
            "DEPTHxWIDTH",
        ),
        (
            ("train", "layered3", "--stream", 1, "-o", "x.safetensors", "--network", "99999x99999"),
            "at most 64x1024",
        ),
        (("render", "gold-red-lacquer", "--adapter", "no-such"), "no-such"),
        (("compare", "a.exr", "b.exr"), "does not exist"),
        (("evaluate", "no-such", "--reference", "no.npz"), "no-such"),
        (("info", "no.safetensors"), "no.safetensors"),
    ],
)
def test_a_mistake_is_one_line_on_stderr(nma, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, out, err = nma(*arguments)
    assert (code, out) == (1, "")
    assert err.startswith("nma: ") and err.count("\n") == 1
    assert message in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ("render", "scene.xml", "--camera", "top"),
        ("render", "gold-red-lacquer", "-D", "a=1"),
        ("render", "gold-red-lacquer", "--size", "big"),
        ("render", "gold-red-lacquer", "--size", ""),
        ("compare", "a.exr", "b.exr", "--set", "alpha_top=.1"),
        ("compare", "a.exr", "b.exr", "--size", 64),
        ("render", "gold-red-lacquer", "-o", "gold.jpg"),
        ("render", "gold-red-lacquer", "--set", "alpha_top"),
        ("simulate", "-o", "x.npz"),
        ("train", "layered3", "--stream", 1, "-o", "x.safetensors", "--preset", "anisotropic"),
        ("data", "merl", "gold-red-lacquer", "--material", "x", "-o", "x.binary"),
    ],
)
def test_wrong_usage_exits_with_2(nma, arguments):
    assert nma(*arguments)[0] == 2
