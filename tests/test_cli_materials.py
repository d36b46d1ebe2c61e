"""`nma materials` lists the named materials. `nma materials NAME` shows a single material."""

import json

import numpy as np
import pytest
from PIL import Image

from nma import materials

HEAD = 'class = "layered3"\n[parameters]\nalpha_top = 0.01\neta_top = 1.5\nconductor = "Au"\nalbedo = 0.5\n'
TEXTURED = (
    'title = "Worn [/b] gold"\n'
    + HEAD
    + 'alpha_bottom = { texture = "orm.png", channel = "g" }\nsigma_t = 0.5\n'
)


@pytest.fixture
def textured(tmp_path):
    """The path of a material file in which one parameter is a channel of a packed image."""
    Image.fromarray(np.full((4, 4, 3), (255, 25, 0), np.uint8)).save(tmp_path / "orm.png")
    (tmp_path / "worn.toml").write_text(TEXTURED)
    return tmp_path / "worn.toml"


@pytest.mark.parametrize("name", materials.names())
def test_json_has_the_exact_parameters_of_a_material_in_the_order_of_its_class(nma, name):
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


def test_a_material_with_brackets_in_its_title_is_shown_as_a_table(nma, textured):
    code, out, err = nma("materials", textured)
    assert code == 0, err
    assert "Worn [/b] gold" in out and "orm.png" in out
