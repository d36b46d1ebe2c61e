"""Tests of the documentation pages: every Python and C++ block runs, and every link has a target."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from adapter_cases import random_adapter

from nma.adapter import Adapter
from nma.adapter.library import Library
from nma.params import LIBRARY
from nma.train import recipe as recipes

import nma.render  # noqa: F401  # isort: skip
import mitsuba as mi  # isort: skip

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "runtime/README.md"])
# TRAINING is the page whose code blocks train adapters. MEASURED is the file of measurements that some blocks read.
TRAINING = "docs/bring-your-own.md"
MEASURED = "paper_white_rgb.bsdf"


def blocks(language):
    """Returns all code blocks in a language, as a dictionary.

    The keys are page and index, such as docs/python.md-0.
    """
    return {
        f"{page.relative_to(ROOT)}-{number}": block
        for page in PAGES
        for number, block in enumerate(
            re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.M | re.S)
        )
    }


PYTHON = blocks("python")
SLOW = [name for name, text in PYTHON.items() if name.startswith(TRAINING) or "Library" in text]


@pytest.fixture
def cheap(tmp_path, monkeypatch):
    """A working folder in which code blocks run fast.

    The blocks get a tiny network, one sample per pixel and few training steps.
    """
    load, tiny, render = Adapter.load, random_adapter(hidden="2x8"), mi.render
    shipped = lambda name: tiny if str(name) in nma.shipped() else load(name)
    monkeypatch.setattr(Adapter, "load", staticmethod(shipped))
    monkeypatch.setattr(mi, "render", lambda *args, **kwargs: render(*args, **kwargs | {"spp": 1}))
    monkeypatch.setattr(mi.util, "write_bitmap", partial(mi.util.write_bitmap, write_async=False))
    for name, preset in recipes.PRESETS.items():
        quick = replace(preset, network="1x8", rows=32, steps=30, albedo=0.0)
        monkeypatch.setitem(recipes.PRESETS, name, quick)
    monkeypatch.chdir(tmp_path)
    variant = mi.variant() or "llvm_ad_rgb"
    yield tmp_path
    mi.set_variant(variant)


def test_every_page_about_python_has_python_blocks():
    pages = {name.rpartition("-")[0] for name in PYTHON}
    assert {"README.md", "docs/mitsuba.md", "docs/python.md", "docs/materials.md", TRAINING} <= pages


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PYTHON if name not in SLOW])
def test_python_blocks_of_the_pages_run(name, cheap):
    run_block(PYTHON[name], cheap)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_python_blocks_that_train_run(name, cheap, request):
    if MEASURED in PYTHON[name]:
        shutil.copy(request.getfixturevalue("measurements") / "rgl" / MEASURED, cheap)
    if "library.safetensors" in PYTHON[name]:
        small_library().save(cheap / "library.safetensors")
    names = run_block(PYTHON[name], cheap)
    if "fit(" in PYTHON[name]:
        assert names["run"].step == 30
        assert names["adapter"].space.name == "measured"


def run_block(text, folder):
    """Runs a code block as a program and returns the variables of the program.

    Asserts that the pictures of the program are finite and that its files are not empty.
    """
    text = text.replace("range(30)", "range(2)")
    if "__main__" in text:
        (folder / "block.py").write_text(text)
        done = subprocess.run([sys.executable, "block.py"], capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return {}
    names: dict = {}
    exec(text, names)
    if "image" in names:
        assert np.isfinite(np.array(names["image"])).all()
    for written in re.findall(r'write_bitmap\("(.*?)"', text):
        assert (folder / written).stat().st_size > 100
    return names


def small_library():
    rng = np.random.default_rng(0)
    adapter = random_adapter(name="raw", hidden="2x8", space=LIBRARY)
    return Library(adapter, ("brass", "blue-rubber"), rng.normal(size=(2, LIBRARY.size)).astype(np.float32))


@pytest.mark.parametrize("name", blocks("cpp"))
def test_cpp_blocks_of_the_pages_compile_and_run(name, compiler, tmp_path):
    """A C++ block compiles and runs as the body of `main`, after declarations of the variables that the block uses."""
    includes, lines = blocks("cpp")[name].split("\n\n", 1)
    given = "float parameters[13] = {.02f, .1f, 1.5f, .1f, .4f, 1.4f, 4.f, 2.4f, 1.6f, .9f, .3f, .2f, .5f};\n"
    given += "const nma::Direction wi{.6f, 0.f, .8f}, wo{0.f, .6f, .8f};\nconst float u0 = .1f, u1 = .2f, u2 = .3f;\n"
    check = "return s.pdf > 0.f && v.pdf > 0.f ? 0 : 1;\n"
    (tmp_path / "page.cpp").write_text(f"{includes}\nint main() {{\n{given}{lines}{check}}}\n")
    command = [
        compiler,
        "-std=c++17",
        f"-I{ROOT / 'runtime'}",
        tmp_path / "page.cpp",
        "-o",
        tmp_path / "page",
    ]
    subprocess.run(command, check=True)
    subprocess.run([tmp_path / "page"], cwd=ROOT, check=True)


def test_links_between_pages_lead_somewhere():
    """Every link of a page leads to an existing file. If a link names a heading, the file contains this heading."""
    broken = []
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            path, _, heading = link.partition("#")
            if link.startswith(("http", "mailto")):
                continue
            target = (page.parent / path).resolve() if path else page
            # A source distribution has no pictures of experiments (pyproject.toml).
            if (target.suffix, target.parents[1]) == (".png", ROOT / "figures") and not (
                ROOT / ".git"
            ).exists():
                continue
            if not target.exists() or (heading and heading not in headings(target)):
                broken.append(f"{page.name}: {link}")
    assert not broken


def headings(page):
    """Lists the anchors of the headings of a page: lower case, hyphens for blanks, no punctuation."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    return [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]
