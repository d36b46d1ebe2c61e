"""A new class of materials needs only one file and one line in a registry.

The new file contains the parameters of the class and its source. The tests use the example of docs/how-it-is-built.md.
"""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nma.render
from nma import sources
from nma.adapter import Adapter
from nma.errors import ParamError, TableError
from nma.export import names, printed
from nma.params import LAYERED3, ParamSpace
from nma.render.load import SceneError, load_dict
from nma.table import ISOTROPIC, Tables
from nma.table.dataset import Settings
from nma.train.recipe import CLASS, PAPER, for_class
from nma.train.run import train_class

FILE = '''
"""A stack of layers of which only two parameters vary."""

from nma.params import Param, ParamSpace
from nma.sources.layered import Layered3


class Bare(Layered3):
    space = ParamSpace(
        "bare",
        (
            Param("alpha", "a", "log10", 1e-2, 1.0, 1e-4, 1.0, "microfacet width"),
            Param("tint", "t", "uniform", 0.0, 1.0, 0.0, 1.0, "colour of the medium", 3),
        ),
    )

    def gather(self, columns):
        alpha, *tint = columns
        constant = lambda *values: [0.0 * alpha + value for value in values]
        metal = constant(0.2, 0.2, 0.2, 3.0, 3.0, 3.0)
        return super().gather([alpha, alpha, *constant(1.5), *metal, *tint, *constant(0.5)])
'''
LINE = {"bare": "bare:Bare"}
MATERIAL = 'title = "Steel"\ndescription = "Bare."\nclass = "bare"\n[parameters]\nalpha = 0.2\ntint = [0.5, 0.6, 0.7]\n'


@pytest.fixture
def bare(monkeypatch, tmp_path):
    """The path of a material file of the class `bare`.

    The fixture adds the file of the class and its line in the registry.
    """
    folder = tmp_path / "sources"
    folder.mkdir()
    (folder / "bare.py").write_text(FILE)
    monkeypatch.setattr(sources, "__path__", [*sources.__path__, str(folder)])
    monkeypatch.setattr(sources, "CLASSES", sources.CLASSES | LINE)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "steel.toml").write_text(MATERIAL)
    yield tmp_path / "steel.toml"
    sys.modules.pop("nma.sources.bare", None)


def test_a_class_trains_with_its_own_encoding_or_with_its_plain_parameters(bare):
    space = sources.space("bare")
    assert for_class(LAYERED3, target="principled") == CLASS
    assert for_class(space, steps=10).encoding == "raw"
    assert for_class(space, "paper") == PAPER
    assert for_class(space, "single").encoding == "direction"


def test_the_class_is_known_by_its_name(bare):
    assert {"layered3", "measured", "library", "bare"} <= set(sources.classes())
    assert sources.space("bare").name == "bare"


def test_another_key_than_the_name_of_the_class_is_refused_at_once(bare, nma, monkeypatch):
    monkeypatch.setattr(sources, "CLASSES", {"naked": "bare:Bare"})
    told = "the key 'naked' of CLASSES is not the name of its class, which is 'bare'; make both names equal"
    for use in (sources.space, sources.get):
        with pytest.raises(ParamError, match=told):
            use("naked")
    code, _, err = nma("dataset", "naked", "new.zarr")
    assert code == 1 and told in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "param", "message"),
    [
        ("rough-metal", "tint", "the class 'rough-metal' cannot be a name in C++; use lower-case letters"),
        ("Metal", "tint", "the class 'Metal' cannot be a name in C++; use lower-case letters"),
        ("float", "tint", "the class 'float' cannot be a name in C++, where 'float' has another meaning"),
        ("layered", "tint", "the class 'layered' cannot be a name in C++, where"),
        ("geometry", "tint", "the class 'geometry' cannot be a name in C++, where"),
        ("bare", "columns", "the parameter 'columns' of the class 'bare' cannot be a name in C++, where"),
        ("bare", "tint 2", "the parameter 'tint 2' of the class 'bare' cannot be a name in C++; use"),
        ("bare", "2nd", "the parameter '2nd' of the class 'bare' cannot be a name in C++; use"),
        ("bare", "a__b", "the parameter 'a__b' of the class 'bare' cannot be a name in C++; use"),
    ],
)
def test_names_that_cpp_does_not_allow_are_not_exported(bare, monkeypatch, name, param, message):
    space = ParamSpace(name, (replace(sources.space("bare")["tint"], name=param),))
    monkeypatch.setattr(sources, "CLASSES", {name: "bare:Bare"})
    monkeypatch.setattr(sources._at("bare:Bare"), "space", space)
    for file in ("classes", "constants"):
        with pytest.raises(ParamError, match=re.escape(message)) as caught:
            printed(f"nma/generated/{file}.h")
        assert "\n" not in str(caught.value)


def test_no_class_can_have_the_name_of_a_namespace_of_the_runtime():
    headers = [f for f in (Path(__file__).parents[1] / "runtime").rglob("*") if f.suffix in (".h", ".inl")]
    text = "".join(file.read_text() for file in headers)
    found = set(re.findall(r"^namespace (?:nma::)?(\w+) \{", text, re.M)) - {
        "nma",
        "mitsuba",
        *sources.names(),
    }
    assert found and found <= names._NAMESPACES


def test_materials_of_the_class_are_shown(bare, nma):
    code, out, _ = nma("materials", bare)
    assert code == 0 and "tint" in out


def test_simulate_takes_the_class_of_the_material(bare, nma):
    assert nma("simulate", "--material", bare, "--walks", "20000", "-o", "steel.npz")[0] == 0
    assert Tables.load("steel.npz").params.shape == (1, 4)
    code, _, told = nma("simulate", "--material", bare, "--material", "wet-nickel", "-o", "two.npz")
    assert code == 2
    assert "classes bare, layered3" in told


def test_files_of_tables_name_the_class(bare, nma):
    """A command refuses tables of a class that it does not expect, and the error message says what to do."""
    assert nma("simulate", "--class", "bare", "--draw", 1, "--walks", 1600, "-o", "drawn.npz")[0] == 0
    with np.load("drawn.npz") as arrays:
        assert str(arrays["class"]) == "bare"
    for command, advice in (
        (
            "simulate --params drawn.npz -o x.npz",
            "drawn.npz: its materials are of class 'bare'; add --class bare",
        ),
        (
            "evaluate layered3-3x32 --reference drawn.npz",
            "drawn.npz: the tables are of class 'bare', but layered3-3x32 is for class layered3; choose tables of",
        ),
    ):
        code, _, told = nma(*command.split())
        assert code == 1 and advice in told and told.count("\n") == 1, told
    assert nma(*"simulate --class bare --params drawn.npz --walks 1600 -o again.npz".split())[0] == 0


@pytest.mark.parametrize(
    ("command", "advice"),
    [
        (
            "render steel.toml",
            "the adapter layered3-3x32 is for class layered3; choose an adapter of class bare",
        ),
        (
            "render steel.toml --model layered",
            "simulates only class layered3; `nma simulate` makes a table of steel",
        ),
        ("compare steel.toml", "choose an adapter of class bare: `nma train` makes one, and `nma fit`"),
        ("data merl steel.toml -o x.binary", "choose an adapter of class bare"),
    ],
)
def test_a_material_of_the_class_is_refused_where_another_class_is_needed(bare, nma, command, advice):
    code, _, told = nma(*command.split())
    assert code == 1
    assert "steel" in told and "is of class bare" in told and advice in told
    assert told.count("\n") == 1 and "clamp" not in told


def test_a_scene_refuses_a_material_of_another_class(bare):
    nma.render.use("llvm_ad_rgb")
    for model in ("nma", "layered"):
        with pytest.raises(
            SceneError, match="is of class bare, but this BSDF needs class layered3; choose a material"
        ):
            load_dict({"type": model, "material": str(bare)})


@pytest.mark.parametrize("command", ["fit x.npz -o x.safetensors", "principled x.npz"])
def test_tables_of_an_unknown_class_are_refused_by_name(command, nma, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Tables(np.zeros((1, 5)), np.ones((1, *ISOTROPIC.shape)), np.ones(1, int), class_name="paint").save(
        "x.npz"
    )
    code, _, told = nma(*command.split())
    assert code == 1
    assert "x.npz: its materials are of class 'paint', but this version has only layered3, " in told


def test_training_refuses_data_of_another_class(bare):
    data = Settings("layered3", 1, 1600, 0)
    with pytest.raises(TableError, match="of class 'layered3', but the adapter is for class bare"):
        train_class(sources.space("bare"), for_class(sources.space("bare")), data, {})


def test_cpp_gets_the_parameters_of_the_class(bare):
    classes, constants = (printed(f"nma/generated/{name}.h") for name in ("classes", "constants"))
    assert "bare_parameters()" in classes
    assert "namespace bare {" in constants and "constexpr int TINT = 1;" in constants


@pytest.mark.slow
def test_a_class_is_sampled_trained_judged_and_prepared(bare, nma, fast_steps):
    for words in (
        "dataset bare bare.zarr --materials 4 --walks 20000",
        "train bare --data bare.zarr -o bare.safetensors --steps 20 --network 1x8",
        f"simulate --material {bare} --walks 20000 -o steel.npz",
        "evaluate bare.safetensors --reference steel.npz",
        f"render {bare} --adapter bare.safetensors --size 8 --spp 1 -o steel.png",
        f"fit {bare} --walks 20000 --steps 20 --network 1x8 -o alone.safetensors",
        "fit steel.npz --steps 20 --network 1x8 -o same.safetensors",
    ):
        code, _, told = nma(*words.split())
        assert code == 0, (words, told)
    space = sources.space("bare")
    adapter = Adapter.load("bare.safetensors")
    assert (adapter.space, adapter.encoding) == (space, "raw")
    for alone in map(Adapter.load, ("alone.safetensors", "same.safetensors")):
        assert alone.space == space
        np.testing.assert_allclose(alone.material, [0.2, 0.5, 0.6, 0.7])
    assert np.isfinite(adapter.numbers(space.sample(np.random.default_rng(0), 3), [0.2, 0.9])).all()
