"""Named materials, the format of material files, and the list of conductors."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nma import materials
from nma.conductors import load_conductors
from nma.errors import MaterialError, NmaError
from nma.microfacet import fresnel_conductor
from nma.params import LAYERED3

ROOT = Path(__file__).parents[1]


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
    missing = [name for name in materials.names() if f"`{name}`" not in text]
    assert not missing, f"add {', '.join(missing)} to the list of named materials in docs/materials.md"


def test_a_file_reads_into_the_vector_of_its_class(material_file):
    material = materials.load(material_file())
    gold = load_conductors().names.index("Au")
    eta, k = load_conductors().eta[gold], load_conductors().k[gold]
    np.testing.assert_array_equal(material.vector(), [0.1, 0.2, 1.5, *eta, *k, 0.5, 0.5, 0.5, 0.25])
    assert material.name == "test"


def test_parameters_can_be_changed_as_in_a_file(material_file, tmp_path):
    changed = materials.load(material_file()).changed(
        {"conductor": "Ag", "alpha_top": 0.3, "albedo": [0.1, 0.2, 0.3]}
    )
    silver = load_conductors().names.index("Ag")
    assert changed.values["eta_conductor"] == tuple(load_conductors().eta[silver])
    np.testing.assert_array_equal(changed.vector()[[0, 1, 9, 10, 11]], [0.3, 0.2, 0.1, 0.2, 0.3])
    for wrong in ({"alpha_tip": 0.1}, {"alpha_top": 2.0}, {"sigma_t": {"texture": str(tmp_path / "no.png")}}):
        with pytest.raises(MaterialError, match="--set"):
            changed.changed(wrong, "--set")


def test_a_conductor_may_be_given_by_its_index(material_file):
    material = materials.load(material_file('conductor = "Au"', "eta_conductor = [1, 2, 3]\nk_conductor = 4"))
    np.testing.assert_array_equal(material.vector()[3:9], [1, 2, 3, 4, 4, 4])


@pytest.mark.parametrize("given", ["sigma_t = 1001", "sigma_t = 1e30", "sigma_t = 1e300"])
def test_a_medium_through_which_walks_would_not_end_is_refused(material_file, given):
    with pytest.raises(MaterialError, match=r"sigma_t is .* allowed is 0 \.\. 1000"):
        materials.load(material_file("sigma_t = 0.25", given))
    assert materials.load(material_file("sigma_t = 0.25", "sigma_t = 1000")).vector()[-1] == 1000


def test_a_metal_whose_reflectance_overflows_is_refused(material_file):
    """A conductor with an index of refraction of 1e4 is allowed and reflects over 99.9 % of the light.

    An index of 1e10 is refused, because the conductor would look black in single precision.
    """
    with pytest.raises(MaterialError, match=r"k_conductor is .* allowed is 0 \.\. 10000"):
        materials.load(material_file('conductor = "Au"', "eta_conductor = 1\nk_conductor = 1e10"))
    largest = materials.load(material_file('conductor = "Au"', "eta_conductor = 1e4\nk_conductor = 1e4"))
    reflectance = fresnel_conductor(np.float32(0.5), *(np.float32(x) for x in largest.vector()[[3, 6]]))
    assert reflectance == pytest.approx(1.0, abs=1e-3)


def test_a_file_may_hold_values_beyond_the_training_range_of_adapters(material_file):
    assert materials.load(material_file("sigma_t = 0.25", "sigma_t = 5")).vector()[-1] == 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sigma_t = 0.25", "", "no value for sigma_t"),
        ("sigma_t", "sigma_s", r"unknown key 'sigma_s' \(did you mean 'sigma_t'\?\)"),
        ("title", "titel", r"unknown key 'titel' \(did you mean 'title'\?\)"),
        ('title = "Test"', "", "'title' is missing"),
        ("layered3", "layered4", "no class 'layered4'; the classes are layered3"),
        ('"Au"', '"Gold"', "no conductor 'Gold'"),
        ('"Au"', '"Aux"', r"did you mean 'Au'\?"),
        ('"Au"', '"au"', r"did you mean 'Au'\?"),
        ("albedo", "k_conductor = 1\nalbedo", "either conductor or k_conductor"),
        ("albedo = 0.5", "albedo = [1, 2]", "must be a number or a list of 3"),
        ("albedo = 0.5", "albedo = 1.5", r"albedo is 1.5, allowed is 0 \.\. 1"),
        ("alpha_top = 0.1", "alpha_top = nan", r"alpha_top is nan, allowed"),
        ("alpha_top = 0.1", "alpha_top = true", "alpha_top is True, but must be a number"),
        ("alpha_top = 0.1", "alpha_top =", "is no TOML file"),
        ("alpha_top = 0.1", "alpha_top = .1", "is no TOML file.*line.*; numbers begin with a digit, 0.05"),
        ("alpha_top = 0.1", "alpha_top = 2", r"alpha_top is 2, allowed"),
        ("albedo = 0.5", "albedo = { texture = 'none.png' }", "there is no texture .*none.png"),
        ("albedo = 0.5", "albedo = { texture = 'x', gain = 2 }", "unknown key 'gain'"),
        ("albedo = 0.5", "albedo = { scale = 2 }", "texture must be the name of a file"),
        ('title = "Test"', "title = [1]", r"title is \[1\], but must be text"),
        ('"layered3"', "['layered3']", "class is .*, but must be text"),
        ('"layered3"', "{ a = 1 }", "class is .*, but must be text"),
        ('"Au"', "['Au']", r"no conductor \['Au'\]"),
        ("[parameters]", "parameters = 1\n[more]", "unknown key 'more'"),
        ("alpha_top = 0.1", "alpha_top = { width = 1 }", "unknown key 'width'"),
        ("alpha_top = 0.1", f"alpha_top = 1{'0' * 400}", r"alpha_top is inf, allowed"),
        ("alpha_top = 0.1", f"alpha_top = -1{'0' * 400}", r"alpha_top is -inf, allowed"),
        ("alpha_top = 0.1", f"alpha_top = 1{'0' * 9000}", "is no TOML file: Exceeds the limit"),
        ("alpha_top = 0.1", f"alpha_top = [0x{'f' * 9000}, 1]", "too many digits, but must be a number"),
        ("alpha_top = 0.1", "alpha_top = inf", r"alpha_top is inf, allowed"),
        ("alpha_top = 0.1", "alpha_top = 1979-05-27", "must be a number"),
        ("alpha_top = 0.1", f"alpha_top = {'[' * 9000}{']' * 9000}", "nested too deeply"),
        ("alpha_top = 0.1", f"alpha_top{'.a' * 2000} = 1", "unknown key 'a'"),
        ("alpha_top = 0.1", '"alpha\\ntop" = 1', r"unknown key 'alpha\\ntop'"),
        ("albedo = 0.5", 'albedo = { texture = "a\\u0000b.png" }', r"there is no texture .*a\\x00b.png"),
        ("albedo = 0.5", f"albedo = {{ texture = '{'x' * 5000}' }}", r"there is no texture .*x\.\.\."),
        ("albedo = 0.5", "albedo = { texture = '.' }", "there is no texture"),
        ("albedo = 0.5", "albedo = { texture = 'x', scale = nan }", "scale is nan, but must be a finite"),
        (
            "albedo = 0.5",
            f"albedo = {{ texture = 'x', offset = 1{'0' * 400} }}",
            "offset is .* must be a finite",
        ),
        ("albedo = 0.5", "albedo = { texture = 'x', scale = true }", "scale is True"),
        ("albedo = 0.5", "albedo = '3366ee'", "a colour '#3366ee'"),
        ("albedo = 0.5", "albedo = '#3366e'", "a colour has six digits"),
        ("eta_top = 1.5", "eta_top = '#3366ee'", "eta_top is .* no colour"),
        (
            'conductor = "Au"',
            "eta_conductor = '#3366ee'\nk_conductor = 1",
            "eta_conductor is .* no colour",
        ),
        ("[parameters]", "uv_scale = 0\n[parameters]", "uv_scale is 0, but must be above 0"),
        ("[parameters]", "uv_scale = [1]\n[parameters]", "uv_scale is .*, but must be a finite number"),
    ],
)
def test_a_faulty_file_is_refused_with_its_name_and_the_fault(material_file, old, new, message):
    with pytest.raises(MaterialError, match=f"test.toml.*{message}") as error:
        materials.load(material_file(old, new))
    assert len(str(error.value)) < 1000 and "\n" not in str(error.value)


# Texts that replace keys and values of a correct material file. Most of the replacements make the file faulty.
NASTY = (
    "0.5",
    "1",
    "-1",
    "1e999",
    "nan",
    "true",
    '""',
    "[]",
    "[[1]]",
    "{}",
    "{ texture = 1 }",
    "1979-05-27",
    "=",
    "#",
)
NASTY += (
    "{ texture = 'test.toml', channel = 'g' }",
    "{ texture = '' }",
    "[parameters]",
    "[[parameters]]",
    "albedo",
)
NASTY += (
    "'#3366ee'",
    "'layered3'",
    "'measured'",
    "'library'",
    '"\\u0000"',
    "\0",
    "\n",
    "\ufeff",
    "\ud800",
    "title",
)
NASTY += ("[" * 3000, "1" * 400, "1" * 5000, "0x" + "f" * 9000, '"' + "a" * 5000 + '"', "a" + ".a" * 900)


def test_any_file_either_loads_or_is_refused_in_one_line(material_file):
    """Each of 400 randomly damaged files either loads or raises an error of one short line.

    Each damaged file is a correct file with one or two keys or values replaced, and sometimes with a piece cut out.
    """
    path, rng = material_file(), np.random.default_rng(0)
    good = [re.split("( = )", line) for line in path.read_text().strip().splitlines()]
    loaded = refused = 0
    for _ in range(400):
        lines = [list(parts) for parts in good]
        for _ in range(rng.integers(1, 3)):
            parts = lines[rng.integers(len(lines))]
            parts[rng.choice([0, len(parts) - 1], p=[0.2, 0.8])] = NASTY[rng.integers(len(NASTY))]
        text = "\n".join(map("".join, lines)).encode("utf-8", "surrogatepass")
        start = rng.integers(len(text))
        path.write_bytes(text[:start] + text[start + rng.choice([0, 0, 0, 1, 30]) :])
        try:
            materials.load(path)
            loaded += 1
        except NmaError as error:
            assert len(str(error)) < 1000 and "\n" not in str(error)
            refused += 1
    assert loaded > 5 and refused > 200


def test_a_byte_order_mark_and_windows_line_ends_are_accepted(material_file):
    path = material_file()
    plain = materials.load(path).vector()
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(materials.load(path).vector(), plain)


def test_a_file_that_is_too_large_is_not_read(material_file):
    path = material_file()
    path.write_text("#" * (materials.MAX_BYTES + 1))
    with pytest.raises(MaterialError, match="more than 1,048,576 bytes"):
        materials.load(path)


@pytest.mark.parametrize("name", ["a\0b", "a\0b.toml", "x" * 5000, "x" * 5000 + ".toml", "a\nb"])
def test_a_name_that_no_file_can_have_is_refused(name):
    with pytest.raises(MaterialError, match="there is no material") as error:
        materials.load(name)
    assert len(str(error.value)) < 700 and "\n" not in str(error.value)


def test_an_unknown_name_is_refused_with_a_suggestion():
    with pytest.raises(
        MaterialError,
        match=r"no material 'gold-lacquer' \(did you mean 'gold-red-lacquer'\?\).*nma materials",
    ):
        materials.load("gold-lacquer")
    with pytest.raises(MaterialError, match="no material file .*missing.toml"):
        materials.load("missing.toml")


def test_the_list_of_conductors_is_as_the_conventions_say():
    metals = load_conductors()
    assert len(metals) == 51
    assert (metals.eta.min().round(3), metals.eta.max().round(2)) == (0.038, 7.51)
    assert (metals.k.min().round(3), metals.k.max().round(2)) == (0.114, 9.22)
    assert sum(metals.held_out[metals.distinct()]) == 8


def test_no_metal_is_both_trained_on_and_held_out():
    metals = load_conductors()
    values = np.hstack([metals.eta, metals.k])
    for unseen in values[metals.held_out]:
        distance = np.abs(values[~metals.held_out] / unseen - 1).max(axis=1)
        assert distance.min() > 0.05


def test_the_script_reproduces_the_committed_list_of_conductors(tmp_path):
    out = tmp_path / "conductors.csv"
    subprocess.run(
        [sys.executable, ROOT / "tools" / "make_conductors.py", out], check=True, capture_output=True
    )
    shipped = ROOT / "nma" / "conductors" / "conductors.csv"
    assert out.read_text() == shipped.read_text()


def test_a_vector_becomes_a_material_and_back():
    vector = LAYERED3.sample(np.random.default_rng(1), 1)[0]
    material = materials.Material.of_vector("drawn-1", vector, LAYERED3)
    np.testing.assert_allclose(material.vector(), vector)
    assert material.title == "Drawn 1"
    assert isinstance(material.values["albedo"], tuple)


@pytest.mark.parametrize("name", materials.names())
def test_descriptions_promise_no_effect_that_the_class_lacks(name):
    """No description of a material mentions effects such as brushing or flakes.

    The model cannot show brushing or flakes, because its layers are isotropic and homogeneous.
    """
    text = materials.load(name).description.lower()
    assert not [word for word in ("brush", "flake", "spark", "scratch", "grain", "fibre") if word in text]
