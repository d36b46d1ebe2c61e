"""Materials on the command line: what `nma materials` shows, and what `--set` changes."""

import json

import numpy as np
import pytest
from PIL import Image

from nma import materials
from nma.cli.preview import read_change
from nma.errors import MaterialError

HEAD = 'class = "layered3"\n[parameters]\nalpha_top = 0.01\neta_top = 1.5\nconductor = "Au"\nalbedo = 0.5\n'
TEXTURED = (
    'title = "Worn [/b] gold"\n'
    + HEAD
    + 'alpha_bottom = { texture = "orm.png", channel = "g" }\nsigma_t = 0.5\n'
)


@pytest.fixture
def textured(tmp_path):
    """A material file with a packed image."""
    Image.fromarray(np.full((4, 4, 3), (255, 25, 0), np.uint8)).save(tmp_path / "orm.png")
    (tmp_path / "worn.toml").write_text(TEXTURED)
    return tmp_path / "worn.toml"


@pytest.mark.parametrize("name", materials.names())
def test_json_has_the_exact_numbers_of_a_material_in_the_order_of_its_class(nma, name):
    code, out, _ = nma("materials", name, "--json")
    facts, material = json.loads(out), materials.load(name)
    assert code == 0
    assert facts["parameters"] == material.vector().tolist()
    assert list(facts["values"]) == [p.name for p in material.space.params]
    np.testing.assert_array_equal(material.space.vector(facts["values"]), material.vector())
    assert (facts["name"], facts["class"], facts["title"]) == (name, "layered3", material.title)


def test_json_without_a_name_lists_all_materials(nma):
    code, out, _ = nma("materials", "--json")
    assert code == 0
    assert [facts["name"] for facts in json.loads(out)] == list(materials.names())


def test_a_textured_material_has_files_in_place_of_numbers(nma, textured):
    facts = json.loads(nma("materials", textured, "--json")[1])
    assert facts["parameters"] is None
    texture = facts["values"]["alpha_bottom"]
    assert (texture["path"], texture["channel"]) == (str(textured.parent / "orm.png"), "g")
    assert facts["values"]["sigma_t"] == 0.5


def test_a_material_is_shown_as_a_table_whatever_its_title(nma, textured):
    code, out, err = nma("materials", textured)
    assert code == 0, err
    assert "Worn [/b] gold" in out and "orm.png" in out


@pytest.mark.parametrize(
    ("text", "change"),
    [
        ("alpha_top=.2", ("alpha_top", 0.2)),
        ("albedo=.9,.1,.1", ("albedo", [0.9, 0.1, 0.1])),
        ("albedo=#3366ee", ("albedo", "#3366ee")),
        ("conductor=Ag", ("conductor", "Ag")),
        ("sigma_t=wear.png", ("sigma_t", {"texture": "wear.png"})),
        ("sigma_t=wear, old.png", ("sigma_t", {"texture": "wear, old.png"})),
        ("sigma_t=orm.png,channel=g", ("sigma_t", {"texture": "orm.png", "channel": "g"})),
        (
            "albedo=a.png,raw=true,uv_scale=4,scale=.5",
            ("albedo", {"texture": "a.png", "raw": True, "uv_scale": 4.0, "scale": 0.5}),
        ),
    ],
)
def test_set_says_what_a_material_file_does(text, change):
    assert read_change(text) == change


def test_a_coloured_image_may_be_set_by_a_channel(textured):
    name, value = read_change(f"sigma_t={textured.parent / 'orm.png'},channel=r")
    changed = materials.load(textured).changed({name: value}, "--set")
    np.testing.assert_array_equal(changed.textures["sigma_t"].read(), 1.0)
    with pytest.raises(MaterialError, match="--set, sigma_t: channel is 'x'"):
        changed.changed(dict([read_change(f"sigma_t={textured.parent / 'orm.png'},channel=x")]), "--set")
