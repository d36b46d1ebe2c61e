"""The pages about rendering do what they say: their Python runs."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from nma import encoding, network
from nma.adapter import Adapter
from nma.params import LAYERED3
from nma.target import PRINCIPLED_PARAMS
from nma.target.decode import output_size
from nma.train import recipe as recipes

import nma.render  # noqa: F401  # isort: skip
import mitsuba as mi  # isort: skip

DOCS = Path(__file__).parents[1] / "docs"


def blocks(page):
    """The page's Python, block by block."""
    return re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(), re.M | re.S)


BLOCKS = blocks("mitsuba.md")
OWN = blocks("bring-your-own.md")


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_python_of_the_page_on_mitsuba_runs(number, tmp_path, monkeypatch):
    """With a tiny network in place of the shipped one, one sample per pixel and few steps, to save time."""
    inputs = encoding.size("layered3", LAYERED3, True)
    layers = network.init(np.random.default_rng(0), [inputs, 8, 8, output_size(2, PRINCIPLED_PARAMS)])
    adapter = Adapter(LAYERED3, "layered3", layers, 2, True, PRINCIPLED_PARAMS)
    render = mi.render
    monkeypatch.setattr(Adapter, "load", staticmethod(lambda name: adapter))
    monkeypatch.setattr(mi, "render", lambda *args, **kwargs: render(*args, **kwargs | {"spp": 1}))
    monkeypatch.setattr(mi.util, "write_bitmap", partial(mi.util.write_bitmap, write_async=False))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    variant = mi.variant() or "llvm_ad_rgb"
    try:
        exec(BLOCKS[number].replace("range(30)", "range(2)"), names)
    finally:
        mi.set_variant(variant)
    assert np.isfinite(np.array(names["image"])).all()


@pytest.mark.parametrize("number", range(len(OWN)))
def test_python_of_the_page_on_own_materials_runs(number, tmp_path, monkeypatch):
    """With few steps and one sample per pixel, to save time."""
    render = mi.render
    for name, preset in recipes.PRESETS.items():
        monkeypatch.setitem(
            recipes.PRESETS, name, replace(preset, network="1x8", rows=32, steps=30, albedo=0.0)
        )
    monkeypatch.setattr(mi, "render", lambda *args, **kwargs: render(*args, **kwargs | {"spp": 1}))
    monkeypatch.setattr(mi.util, "write_bitmap", partial(mi.util.write_bitmap, write_async=False))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(OWN[number], names)
    if "fit(" in OWN[number]:
        assert names["run"].step == 30
        assert names["adapter"].space.name == "measured"
    if "image" in names:
        assert np.isfinite(np.array(names["image"])).all() and (tmp_path / "mine.png").is_file()
