"""Libraries of many materials in one network: training, files, codes of new materials, folders of measurements."""

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("jax", reason="training needs JAX, the extra [train]", exc_type=ImportError)
pytest.importorskip("optax", reason="training needs optax, the extra [train]", exc_type=ImportError)

from nma import network
from nma.adapter import Adapter
from nma.adapter.library import Library
from nma.errors import NmaError, ParamError, SourceError, TableError, WeightsError
from nma.evaluate import evaluate
from nma.native.runtime import Runtime
from nma.params import LAYERED3, LIBRARY
from nma.sources import catalogue
from nma.sources.merl import SHAPE, Merl
from nma.table import ISOTROPIC, Tables, collection
from nma.target import PRINCIPLED_PARAMS
from nma.train import library as training
from nma.train import loop

COLOURS = np.array([[0.8, 0.1, 0.1], [0.1, 0.7, 0.2], [0.5, 0.5, 0.9], [0.5, 0.4, 0.2]])
NAMES = ("red", "green", "blue")
TINY = replace(
    training.RECIPE,
    network="2x16",
    instances=1,
    bounded=False,
    rows=64,
    bins_per_row=4,
    points_law="centre",
    albedo=0.0,
    learning_rate=2e-2,
    average=0.9,
    steps=250,
)
CODING = replace(TINY, steps=150, learning_rate=5e-2)
# The log loss that training must reach within 250 steps, from an initial log loss above .02.
REACHED = 0.003


def matte(rho):
    """Returns noise-free tables of Lambertian materials with albedos `rho` (n, 3)."""
    cosines = (np.arange(40) + 0.5) / 40
    values = rho[:, None, None, None, :] / math.pi * cosines[None, None, :, None, None]
    values = np.broadcast_to(values, (len(rho), *ISOTROPIC.shape)).astype(np.float32)
    return Tables(np.zeros((len(rho), 0)), values, np.full(len(rho), 1 << 40))


@pytest.fixture(scope="module")
def tables():
    return matte(COLOURS)


@pytest.fixture(scope="module")
def made(tables):
    return training.train_library(NAMES, tables[:3], TINY, {"data": "paper"})


@pytest.fixture(scope="module")
def library(made):
    return made[0]


@pytest.fixture
def saved(library, tmp_path):
    library.save(tmp_path / "library.safetensors")
    return tmp_path / "library.safetensors"


def test_a_hundred_materials_have_7159_parameters():
    codes = np.zeros((100, 32), np.float32)
    layers = training.initial_layers(training.RECIPE, LIBRARY)
    adapter = Adapter(LIBRARY, "raw", layers, 2, True, PRINCIPLED_PARAMS)
    assert Library(adapter, tuple(map(str, range(100))), codes).parameters == 7_159


def test_training_learns_three_materials(made, library, tables):
    run = made[1]
    assert np.mean(run.log_losses[-50:]) < REACHED < np.mean(run.log_losses[:50])
    own = Tables(library.codes[:1].astype(np.float64), tables.values[:1], tables.walks[:1])
    assert evaluate(library.adapter, own).mean["log_loss"] < REACHED


def test_codes_stay_within_the_range_of_the_class(library):
    free = np.array([-1e3, -1.0, 0.0, 0.1, 1e3])
    codes = np.asarray(training.code_of(free))
    assert (np.abs(codes) <= LIBRARY["code"].high).all()
    np.testing.assert_allclose(training.free_of(codes[1:4]), free[1:4], atol=1e-5)
    np.testing.assert_array_equal(LIBRARY.check(library.codes, "training"), library.codes)


def test_a_library_is_read_back_from_its_file_and_is_an_adapter(library, saved):
    again = Library.load(saved)
    assert again.names == NAMES
    assert again.parameters == library.parameters
    np.testing.assert_array_equal(again.codes, library.codes)
    adapter = Adapter.load(saved)
    assert adapter.space == LIBRARY
    assert adapter.training["names"] == list(NAMES)
    assert adapter.training["data"] == "paper"
    mu = np.linspace(0.1, 1.0, 5)
    np.testing.assert_array_equal(
        adapter.numbers(again.codes, mu), library.adapter.numbers(library.codes, mu)
    )


def test_a_killed_run_resumes_as_if_nothing_had_happened(made, tables, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "_CHECKPOINT_SECONDS", 0.0)
    checkpoint = tmp_path / "run.ckpt"
    arguments = NAMES, tables[:3], TINY, {"data": "paper"}

    def kill(run):
        if run.step == 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        training.train_library(*arguments, checkpoint=checkpoint, progress=kill)
    steps = []
    again, run = training.train_library(
        *arguments, checkpoint=checkpoint, progress=lambda run: steps.append(run.step)
    )
    assert steps[0] == 150
    assert run.losses == made[1].losses
    np.testing.assert_array_equal(again.codes, made[0].codes)
    for ours, theirs in zip(again.adapter.layers, made[0].adapter.layers, strict=True):
        np.testing.assert_array_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])
    with pytest.raises(NmaError, match="other data"):
        training.train_library(NAMES, tables[:3], TINY, {"data": "others"}, checkpoint=checkpoint)


@pytest.mark.slow
def test_encoding_a_new_material_beats_the_nearest_code(library, tables):
    layers = [(matrix.copy(), bias.copy()) for matrix, bias in library.adapter.layers]
    found = training.encode(library, tables[3:], recipe=CODING)
    assert found.nearest in NAMES
    assert found.log_loss < 0.7 * found.nearest_log_loss
    assert found.code.shape == (32,)
    LIBRARY.check(found.code, "training")
    for (matrix, bias), (before, bias_before) in zip(library.adapter.layers, layers, strict=True):
        np.testing.assert_array_equal(matrix, before)
        np.testing.assert_array_equal(bias, bias_before)
    # Of all codes in the library, each material's own code fits the table of this material best.
    nearest = [
        np.argmin(training._judge(library.codes, library, tables[k : k + 1], CODING)) for k in range(3)
    ]
    assert nearest == [0, 1, 2]
    with pytest.raises(TableError, match="one table"):
        training.encode(library, tables, recipe=CODING)


def test_mixtures_and_single_materials(library):
    mixed = library.mix(["red", "blue"], [3, 1])
    np.testing.assert_allclose(mixed, 0.75 * library.codes[0] + 0.25 * library.codes[2], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(library.mix(["red"], [1]), library.code("red"))
    one, mu = library.material(mixed, "mixed"), np.linspace(0.05, 1.0, 20)
    assert (one.space.name, one.encoding, one.training["material"]) == ("measured", "direction", "mixed")
    np.testing.assert_allclose(
        one.numbers(np.zeros((1, 0)), mu), library.adapter.numbers(mixed[None], mu), atol=1e-5
    )
    more = library.add("mixed", mixed)
    np.testing.assert_array_equal(more.code("mixed"), mixed)
    assert len(library.names) == 3


def test_the_runtime_in_cpp_reads_a_library(compiler, library, saved):
    runtime = Runtime(saved)
    assert (runtime.parameters, runtime.size) == (32, library.adapter.size)
    mu = np.linspace(0.05, 1.0, 30, dtype=np.float32)
    codes = np.repeat(library.codes[:1], 30, axis=0)
    inputs = np.concatenate([codes, mu[:, None]], axis=1)
    expected = network.forward(library.adapter.layers, inputs)
    np.testing.assert_allclose(runtime.outputs(codes, mu), expected, rtol=1e-4, atol=1e-4)


def test_errors_name_the_mistake(library, saved, tmp_path):
    for call, words in (
        (lambda: library.code("rde"), "no material 'rde'.*did you mean 'red'"),
        (lambda: library.mix(["red", "blue"], [1]), "2 materials need 2 weights"),
        (lambda: library.mix(["red", "blue"], [1, -1]), "of at least 0"),
        (lambda: library.mix(["red"], [0]), "all 0"),
        (lambda: library.material(np.full(32, 9.0)), "code.*allowed is -4 .. 4"),
        (lambda: library.add("red", library.codes[0]), "has a material 'red'"),
    ):
        with pytest.raises(ParamError, match=words) as caught:
            call()
        assert "\n" not in str(caught.value)
    with pytest.raises(WeightsError, match="class layered3, not a library; `nma train-library`"):
        Library.load("layered3-3x32")
    plain = tmp_path / "plain.safetensors"
    Adapter.load(saved).save(plain)
    with pytest.raises(WeightsError, match="plain.safetensors.*not a library"):
        Library.load(plain)
    odd = {**library.adapter.training, "names": [[name] for name in NAMES]}
    replace(library.adapter, training=odd).save(plain, {"codes": library.codes})
    with pytest.raises(WeightsError, match="plain.safetensors.*not a library"):
        Library.load(plain)
    with pytest.raises(WeightsError, match="a name occurs twice"):
        Library(library.adapter, ("a", "a", "b"), library.codes)
    with pytest.raises(WeightsError, match="class layered3"):
        Library(replace(library.adapter, space=LAYERED3), NAMES, library.codes)
    with pytest.raises(TableError, match="needs . tables of shape"):
        training.train_library(NAMES, matte(COLOURS), TINY, {})


def xml(path, rho):
    colour = ", ".join(map(str, rho))
    path.write_text(f'<bsdf version="3.0.0" type="diffuse"><rgb name="reflectance" value="{colour}"/></bsdf>')


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with three Mitsuba BSDFs, and with a README and a subfolder that are not materials."""
    folder = tmp_path_factory.mktemp("materials")
    for name, rho in zip(NAMES, COLOURS[:3], strict=True):
        xml(folder / f"{name}.xml", rho)
    (folder / "README.md").write_text("nothing")
    (folder / "more").mkdir()
    return folder


def test_folders_single_files_and_files_of_many_networks_are_collections(folder, tmp_path, measurements):
    assert [member.name for member in collection.members(folder)] == sorted(NAMES)
    assert [member.name for member in collection.members(folder / "red.xml")] == ["red"]
    assert collection.origin(collection.members(folder)) == "*.xml"
    networks = collection.members(measurements / "merl_nbrdf/merl_nbrdf_weights.npz")
    assert len(networks) == 100
    assert collection.origin(networks) == "NBRDF-MERL"
    assert networks[0].read().name == f"NBRDF-MERL {networks[0].name}"


def test_a_merl_file_is_a_collection_of_one(tmp_path):
    planes = np.full((3, *SHAPE), 100.0)
    Merl(planes).save(tmp_path / "grey.binary")
    (member,) = collection.members(tmp_path)
    assert member.name == "grey"
    # A killed run leaves an unfinished file behind, which is no material.
    (tmp_path / ".nma-0123456789ab.partial.binary").write_bytes(b"unfinished")
    assert collection.members(tmp_path) == [member]
    assert [finding.path for finding in catalogue.check(tmp_path)] == [member.path]
    assert isinstance(member.read(), Merl)


def test_empty_missing_and_ambiguous_collections_are_refused(folder, tmp_path):
    with pytest.raises(SourceError, match="no such folder or file; `nma data`"):
        collection.members(tmp_path / "nowhere")
    with pytest.raises(SourceError, match="holds no material; files of materials end in .binary"):
        collection.members(tmp_path)
    xml(tmp_path / "a.xml", COLOURS[0])
    (tmp_path / "a.bsdf").write_bytes(b"")
    with pytest.raises(SourceError, match="2 materials are called 'a'"):
        collection.members(tmp_path)


def test_tables_are_cached_until_their_file_changes(folder, tmp_path, monkeypatch):
    made, plain = [], collection.tabulate_values
    monkeypatch.setattr(
        collection, "tabulate_values", lambda values: (made.append(values.name), plain(values, points=16))[1]
    )
    xml(tmp_path / "red.xml", COLOURS[0])
    xml(tmp_path / "green.xml", COLOURS[1])
    members, seen = collection.members(tmp_path), []
    first = collection.tables(members, tmp_path / "tables", seen.append)
    assert (len(made), seen) == (2, [1, 2])
    np.testing.assert_allclose(first.albedo()[0, 20], COLOURS[1], rtol=1e-3)
    again = collection.tables(members, tmp_path / "tables")
    assert len(made) == 2
    np.testing.assert_array_equal(again.values, first.values)
    assert (again.params.shape, again.class_name) == ((2, 0), "measured")
    xml(tmp_path / "red.xml", COLOURS[2])
    changed = collection.tables(members, tmp_path / "tables")
    assert len(made) == 3
    np.testing.assert_allclose(changed.albedo()[1, 20], COLOURS[2], rtol=1e-3)
    for kept in (tmp_path / "tables").iterdir():
        kept.write_bytes(b"damaged")
    collection.tables(members, tmp_path / "tables")
    assert len(made) == 5


def test_materials_of_one_file_have_tables_of_their_own(tmp_path, monkeypatch):
    made = []

    def table(member):
        made.append(member.material)
        return Tables(
            np.zeros((1, 0)), np.full((1, 2, 2, 2, 3), float(len(made))), np.array([1]), None, "measured"
        )

    monkeypatch.setattr(collection, "_table", table)
    (tmp_path / "two.npz").write_bytes(b"two materials")
    members = [collection.Member(name, tmp_path / "two.npz", name) for name in ("first", "second")]
    for _ in range(2):
        found = collection.tables(members, tmp_path / "tables")
        assert found.values[:, 0, 0, 0, 0].tolist() == [1.0, 2.0]
    assert made == ["first", "second"]


@pytest.mark.slow
def test_the_commands_train_list_encode_and_extract(nma, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "RECIPE", TINY)
    monkeypatch.setattr(training, "ENCODING", CODING)
    made, more, one = (tmp_path / "new" / f"{name}.safetensors" for name in ("made", "more", "one"))

    code, out, err = nma("train-library", folder, "-o", made)
    assert code == 0, err
    library = Library.load(made)
    assert out.startswith(f"3 materials (*.xml), {library.parameters:,} parameters: 96 of codes")
    assert {p.name for p in made.parent.iterdir()} == {made.name, f"{made.name}.tables", "made.loss.png"}
    assert nma("library", "list", made)[:2] == (0, "blue\ngreen\nred\n")
    xml(tmp_path / "brown.xml", COLOURS[3])
    code, out, err = nma("library", "encode", made, tmp_path / "brown.xml", "-o", more)
    assert code == 0, err
    assert out.startswith("brown: log loss 0.00")
    np.testing.assert_array_equal(Library.load(more).codes[:3], library.codes)
    assert nma("library", "extract", more, "brown=.5", "red", "-o", one)[0] == 0
    np.testing.assert_allclose(
        Adapter.load(one).training["code"], Library.load(more).mix(["brown", "red"], [1, 2]), rtol=1e-5
    )
    for arguments, words in (
        (("library", "encode", more, tmp_path / "brown.xml", "-o", more), "has a material 'brown'; give"),
        (("library", "extract", more, "pink", "-o", one), "no material 'pink'"),
        (("library", "list", one), "not a library"),
        (("train-library", tmp_path / "nowhere", "-o", one), "no such folder or file"),
    ):
        code, out, err = nma(*arguments)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert words in err


def test_a_missing_library_is_refused_with_the_command_that_makes_libraries(nma, tmp_path):
    for words in (("list", "no"), ("extract", "no", "gold", "-o", "x.safetensors")):
        code, _, told = nma("library", *(tmp_path / "no.safetensors" if w == "no" else w for w in words))
        assert (
            code == 1
            and told == f"nma: {tmp_path}/no.safetensors: no such library; `nma train-library` makes one\n"
        )
