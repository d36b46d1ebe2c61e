"""`nma` parses every command in the documentation pages, and the commands of each page run one after the other."""

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import typer

from nma import cli
from nma.images.io import write_exr
from nma.params import LAYERED3
from nma.sources.merl import SHAPE, Merl

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "runtime/README.md"])


def lines(page):
    """Returns the commands of a page: all lines of code blocks that name no language, after removal of comments."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.M | re.S)
    text = "".join(body for language, body in blocks if not language)
    return [words for line in text.splitlines() if (words := shlex.split(line, comments=True))]


COMMANDS = {str(p.relative_to(ROOT)): [w[1:] for w in lines(p) if w[0] == "nma"] for p in PAGES}
COMMANDS = {page: commands for page, commands in COMMANDS.items() if commands}
# Options that the tests append to a command to save time. `nma` uses the last value of an option that occurs twice.
CHEAP = {
    "demo": "--size 16 --spp 1 --runs 2 --reference-spp 2",
    "render": "--size 16 --spp 1",
    "simulate": "--walks 40000",
    "dataset": "--materials 4 --walks 40000",
    "train": "--steps 50 --network 1x8",
    "fit": "--steps 50 --network 1x8",
    "principled": "--steps 50",
    "train-library": "--steps 50 --network 1x8",
    "library encode": "--steps 50",
}
# Files that only users with the measured materials have.
MEASURED = ("paper_white_rgb.bsdf", "merl_nbrdf_weights.npz", "rgl-isotropic_nbrdf_weights.npz")


def cheap(words):
    """Returns the command with options that make it fast: fewer samples, walks, steps and materials."""
    text = " ".join(words)
    more = next((options for start, options in CHEAP.items() if text.startswith(start)), "")
    if "--draw" in words:
        more += " --draw 4"
    if "--stream" in words:
        more += " --stream 4 --walks 40000"
    if words[0] == "compare" and not any(word.endswith(".exr") for word in words):
        more += " --size 16 --spp 2"
    if words[0] == "fit" and not any(word.endswith((".bsdf", ".xml")) for word in words):
        more += " --walks 40000"
    return [str(Path(word).expanduser()) if word.startswith("~") else word for word in words] + more.split()


def parsed(words):
    """Parses a command line as `nma` does, without running the command. Returns the click context of the command."""
    command, context = typer.main.get_command(cli.app), None
    name, rest = "nma", list(words)
    while True:
        context = command.make_context(name, rest, parent=context)
        rest = [*context._protected_args, *context.args]
        if not (rest and hasattr(command, "resolve_command")):
            return context
        name, command, rest = command.resolve_command(context, rest)


@pytest.mark.parametrize("page", COMMANDS)
def test_nma_parses_the_commands_of_the_pages(page):
    for words in COMMANDS[page]:
        parsed(words)


def test_the_parser_refuses_unknown_commands_and_options():
    for words in (
        ["render", "wet-nickel", "--sizes", "16"],
        ["paint"],
        ["render", "wet-nickel", "--spp", "0"],
    ):
        with pytest.raises(Exception, match="No such|should be greater"):
            parsed(words)


def test_the_makefile_has_every_goal_that_pages_name():
    goals = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    wanted = {words[1] for page in PAGES for words in lines(page) if words[0] == "make"}
    wanted |= {goal for page in PAGES for goal in re.findall(r"`make ([\w-]+)", page.read_text())}
    assert "test" in wanted and wanted <= goals


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the files that commands of the pages read, except for the measured materials."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "home/merl").mkdir(parents=True)
    for name, value in (("brass", 200.0), ("blue-rubber", 100.0)):
        Merl(np.full((3, *SHAPE), value)).save(tmp_path / f"home/merl/{name}.binary")
    for name in ("plastic.xml", "material.xml"):
        (tmp_path / name).write_text('<bsdf version="3.0.0" type="roughplastic"/>')
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0">
            <default name="roughness" value=".2"/>
            <integrator type="path"/>
            <sensor type="perspective"/>
            <emitter type="constant"/>
            <shape type="sphere"><bsdf type="roughconductor"><float name="alpha" value="$roughness"/></bsdf></shape>
        </scene>"""
    )
    (tmp_path / "teapot.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 4/2 2/3\n"
    )
    (tmp_path / "my-material.toml").write_text((ROOT / "nma/materials/wet-nickel.toml").read_text())
    np.savez(tmp_path / "reference.npz", params=LAYERED3.sample(np.random.default_rng(0), 2))
    for name in ("test.exr", "reference.exr"):
        write_exr(tmp_path / name, np.random.default_rng(len(name)).random((16, 16, 3)))
    return tmp_path


def measured_files(folder, origin):
    """Copies the measurements from `origin` to `folder`, with only a few networks of each file."""
    shutil.copy(origin / "rgl" / MEASURED[0], folder)
    for place, wanted in (("merl_nbrdf", None), ("rgl_nbrdf", "cg_sunflower_rgb")):
        (source,) = (origin / place).glob("*.npz")
        with np.load(source) as data:
            keep = [list(data["names"]).index(wanted)] if wanted else [0, 1]
            np.savez(folder / source.name, names=data["names"][keep], weights=data["weights"][keep])


@pytest.mark.slow
@pytest.mark.parametrize("page", COMMANDS)
def test_commands_of_the_pages_run(page, folder, nma, fast_steps, request):
    commands = COMMANDS[page]
    if any(word in MEASURED for words in commands for word in words):
        measured_files(folder, request.getfixturevalue("measurements"))
    for words in commands:
        code, _, err = nma(*cheap(words))
        assert code == 0, (words, err)
