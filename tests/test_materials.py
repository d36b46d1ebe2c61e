"""Named materials, the format of their files, and the corpus of conductors."""

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from nma import materials
from nma.data import load_conductors
from nma.errors import MaterialError, TextureError
from nma.params import LAYERED3

ROOT = Path(__file__).parents[1]
PLAIN = """
title = "Test"
class = "layered3"
[parameters]
alpha_top = 0.1
alpha_bottom = 0.2
eta_top = 1.5
conductor = "Au"
albedo = 0.5
sigma_t = 0.25
"""


@pytest.fixture
def write(tmp_path):
    """Writes a material file, PLAIN with some text replaced, and returns its path."""

    def write(old: str = "", new: str = "") -> Path:
        assert old in PLAIN
        path = tmp_path / "test.toml"
        path.write_text(PLAIN.replace(old, new, 1))
        return path

    return write


def write_image(path: Path, pixels: np.ndarray) -> Path:
    mi.Bitmap(pixels).write(str(path))
    return path


@pytest.mark.parametrize("name", materials.names())
def test_a_named_material_lies_in_the_training_range(name):
    material = materials.load(name)
    vector = material.vector()
    assert vector.shape == (material.space.size,)
    material.space.check(vector, "training")
    assert material.title
    assert material.description.endswith(".")


def test_there_are_enough_materials_and_enough_smooth_ones():
    vectors = [materials.load(name).vector() for name in materials.names()]
    assert len(vectors) >= 12
    assert sum(vector[0] < 0.01 for vector in vectors) >= 4


def test_no_named_material_uses_a_metal_held_out_of_training():
    metals = load_conductors()
    unseen = np.hstack([metals.eta, metals.k])[metals.held_out]
    for name in materials.names():
        assert not (materials.load(name).vector()[3:9] == unseen).all(axis=1).any()


def test_the_documentation_lists_every_named_material():
    text = (ROOT / "docs" / "materials.md").read_text()
    assert [name for name in materials.names() if f"`{name}`" not in text] == []


def test_a_file_reads_into_the_vector_of_its_class(write):
    material = materials.load(write())
    gold = load_conductors().names.index("Au")
    eta, k = load_conductors().eta[gold], load_conductors().k[gold]
    np.testing.assert_array_equal(material.vector(), [0.1, 0.2, 1.5, *eta, *k, 0.5, 0.5, 0.5, 0.25])
    assert material.name == "test"


def test_parameters_can_be_changed_as_in_a_file(write, tmp_path):
    changed = materials.load(write()).changed(
        {"conductor": "Ag", "alpha_top": 0.3, "albedo": [0.1, 0.2, 0.3]}
    )
    silver = load_conductors().names.index("Ag")
    assert changed.values["eta_conductor"] == tuple(load_conductors().eta[silver])
    np.testing.assert_array_equal(changed.vector()[[0, 1, 9, 10, 11]], [0.3, 0.2, 0.1, 0.2, 0.3])
    for wrong in ({"alpha_tip": 0.1}, {"alpha_top": 2.0}, {"sigma_t": {"texture": str(tmp_path / "no.png")}}):
        with pytest.raises(MaterialError, match="--set"):
            changed.changed(wrong, "--set")


def test_a_conductor_may_be_given_by_its_index(write):
    material = materials.load(write('conductor = "Au"', "eta_conductor = [1, 2, 3]\nk_conductor = 4"))
    np.testing.assert_array_equal(material.vector()[3:9], [1, 2, 3, 4, 4, 4])


def test_sources_take_what_adapters_do_not_know(write):
    assert materials.load(write("sigma_t = 0.25", "sigma_t = 5")).vector()[-1] == 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sigma_t = 0.25", "", "sigma_t missing"),
        ("sigma_t", "sigma_s", r"unknown key 'sigma_s' \(did you mean 'sigma_t'\?\)"),
        ("title", "titel", r"unknown key 'titel' \(did you mean 'title'\?\)"),
        ('title = "Test"', "", "'title' is missing"),
        ("layered3", "layered4", "no class 'layered4'; there is layered3"),
        ('"Au"', '"Gold"', "no conductor 'Gold'"),
        ('"Au"', '"Aux"', r"did you mean 'Au'\?"),
        ("albedo", "k_conductor = 1\nalbedo", "either conductor or k_conductor"),
        ("albedo = 0.5", "albedo = [1, 2]", "must be a number or a list of 3"),
        ("albedo = 0.5", "albedo = 1.5", r"albedo .* allowed is 0 \.\. 1"),
        ("alpha_top = 0.1", "alpha_top = nan", r"alpha_top .* \[nan\]"),
        ("alpha_top = 0.1", "alpha_top = true", "alpha_top is True, but must be a number"),
        ("alpha_top = 0.1", "alpha_top =", "is no TOML file"),
        ("albedo = 0.5", "albedo = { texture = 'none.png' }", "there is no texture .*none.png"),
        ("albedo = 0.5", "albedo = { texture = 'x', gain = 2 }", "unknown key 'gain'"),
        ("albedo = 0.5", "albedo = { scale = 2 }", "texture must be a file name"),
    ],
)
def test_a_faulty_file_is_refused_with_its_name_and_the_fault(write, old, new, message):
    with pytest.raises(MaterialError, match=f"test.toml.*{message}"):
        materials.load(write(old, new))


def test_an_unknown_name_is_refused_with_a_suggestion():
    with pytest.raises(
        MaterialError,
        match=r"no material 'gold-lacquer' \(did you mean 'gold-red-lacquer'\?\).*nma materials",
    ):
        materials.load("gold-lacquer")
    with pytest.raises(MaterialError, match="no material file .*missing.toml"):
        materials.load("missing.toml")


def test_colours_are_made_linear_and_numbers_are_not(write, tmp_path):
    pixels = np.full((2, 4, 3), 128, np.uint8)
    write_image(tmp_path / "image.png", pixels)
    colour = materials.load(write("albedo = 0.5", "albedo = { texture = 'image.png' }")).values["albedo"]
    assert colour.read().shape == (2, 4, 3)
    np.testing.assert_allclose(colour.read(), 0.21586, atol=1e-4)  # sRGB 128 in linear light

    texture = "{ texture = 'image.png', scale = 0.5, offset = 0.1 }"
    number = materials.load(write("sigma_t = 0.25", f"sigma_t = {texture}")).values["sigma_t"]
    assert number.read().shape == (2, 4, 1)
    np.testing.assert_allclose(number.read(), 0.1 + 0.5 * 128 / 255, atol=1e-6)


def test_a_textured_material_has_no_vector(write, tmp_path):
    write_image(tmp_path / "image.png", np.zeros((2, 2, 3), np.uint8))
    material = materials.load(write("albedo = 0.5", "albedo = { texture = 'image.png' }"))
    assert list(material.textures) == ["albedo"]
    with pytest.raises(MaterialError, match="albedo come from textures"):
        material.vector()


@pytest.mark.parametrize("fault", [np.nan, np.inf, -0.5, 2.0])
def test_a_texture_with_a_forbidden_value_is_refused_with_its_place(write, tmp_path, fault):
    pixels = np.full((3, 5, 3), 0.5, np.float32)
    pixels[2, 4, 1] = fault
    write_image(tmp_path / "image.exr", pixels)
    texture = materials.load(write("albedo = 0.5", "albedo = { texture = 'image.exr' }")).values["albedo"]
    with pytest.raises(TextureError, match=r"image.exr: 1 of 45 values .* albedo \(0 .. 1\), .* x=4, y=2"):
        texture.read()


def test_a_file_that_is_no_image_is_refused(write, tmp_path):
    (tmp_path / "image.png").write_text("no image")
    texture = materials.load(write("albedo = 0.5", "albedo = { texture = 'image.png' }")).values["albedo"]
    with pytest.raises(TextureError, match="image.png cannot be read"):
        texture.read()


def test_the_corpus_of_conductors_is_what_the_conventions_say():
    metals = load_conductors()
    assert len(metals) == 51
    assert (metals.eta.min().round(3), metals.eta.max().round(2)) == (0.038, 7.51)
    assert (metals.k.min().round(3), metals.k.max().round(2)) == (0.114, 9.22)
    assert sum(metals.held_out[metals.distinct()]) == 8


def test_no_metal_is_both_seen_and_held_out():
    metals = load_conductors()
    values = np.hstack([metals.eta, metals.k])
    for unseen in values[metals.held_out]:
        distance = np.abs(values[~metals.held_out] / unseen - 1).max(axis=1)
        assert distance.min() > 0.05


def test_the_corpus_is_what_its_script_makes(tmp_path):
    out = tmp_path / "conductors.csv"
    subprocess.run(
        [sys.executable, ROOT / "tools" / "make_conductors.py", out], check=True, capture_output=True
    )
    shipped = ROOT / "nma" / "data" / "conductors.csv"
    assert out.read_text() == shipped.read_text()


def test_a_vector_becomes_a_material_and_back():
    vector = LAYERED3.sample(np.random.default_rng(1), 1)[0]
    material = materials.Material.of_vector("drawn-1", vector, LAYERED3)
    np.testing.assert_allclose(material.vector(), vector)
    assert material.title == "Drawn 1"
    assert isinstance(material.values["albedo"], tuple)
