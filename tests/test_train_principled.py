"""Fits one principled BRDF to a material: the fit, its export to Mitsuba, and the command `nma principled`."""

import json
from dataclasses import replace

import numpy as np
import pytest
from target_cases import random_directions, random_principled, stacked

from nma import materials, sources
from nma.adapter import Adapter
from nma.errors import ParamError, TableError
from nma.evaluate import tabulate_adapter
from nma.export.mitsuba import principled_dict, principled_xml
from nma.jit import dr
from nma.ops import Color, Vec3
from nma.params import LAYERED3
from nma.sources.mitsuba_bsdf import from_dict, from_string
from nma.sources.nbrdf import WEIGHTS
from nma.table import Tables, stream_keys, tabulate
from nma.table.values import tabulate_values
from nma.target import Principled, eval_principled
from nma.train.principled import CONSTANT, Constant, fit_constant

RED = Principled(Color(0.7, 0.15, 0.05), 0.35, 0.1, 0.6, 0.2, 0.3, 0.5, 0.6, 0.8, flatness=0.2)
# The recipe of `nma principled` with fewer steps and points, to save time.
SHORT = replace(CONSTANT, steps=400, rows=16, points=32)


@pytest.fixture(scope="module")
def red() -> Tables:
    """The table of the BRDF `RED`, computed with Mitsuba's own plugin `principled`."""
    return tabulate_values(from_dict(principled_dict(RED)), points=16)


@pytest.fixture(scope="module")
def coated(red) -> Tables:
    """The table of the BRDF `RED` as if it were a table of the class `layered3`, with the parameters of that class."""
    return Tables(LAYERED3.sample(np.random.default_rng(0), 1), red.values, red.walks)


@pytest.fixture(scope="module")
def fit(coated) -> Constant:
    return fit_constant(coated, SHORT, {"material": "red"})


# ---- The fit ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_principled_brdf_is_recovered_from_its_table(fit):
    assert fit.log_loss < 0.0005
    assert fit.log_loss == fit.figures["log_loss"] == fit.adapter.training["log_loss"]
    np.testing.assert_allclose(fit.principled.base_color, RED.base_color, atol=0.03)
    for name in ("roughness", "metallic", "clearcoat", "clearcoat_gloss"):
        assert getattr(fit.principled, name) == pytest.approx(getattr(RED, name), abs=0.06), name


@pytest.mark.slow
def test_the_best_of_several_fits_has_the_least_error_of_values_and_albedo(fit):
    record = fit.adapter.training
    starts = record["log_loss_of_starts"]
    errors = {s: starts[s] + SHORT.albedo * record["albedo_error_of_starts"][s] ** 2 for s in starts}
    assert record["start"] == min(errors, key=errors.get)
    assert record["albedo_error"] == fit.figures["albedo_error"] < 0.002
    assert fit.brightness == pytest.approx(1.0, abs=0.005)


@pytest.mark.slow
def test_a_highlight_that_the_log_loss_ignores_keeps_its_energy():
    """A fit to copper under a blue medium and a smooth coat is as bright as that material, within 4 %.

    A fit that minimised the log loss alone was 14 % too dark, with an albedo error of .076. A failure means that the
    loss no longer contains the albedo error.
    """
    changes = {
        "alpha_top": 0.002,
        "alpha_bottom": 0.05,
        "albedo": [0.02, 0.1, 0.9],
        "sigma_t": 0.3,
        "conductor": "Cu",
    }
    vector = materials.load("copper-purple-medium").changed(changes).vector()
    tables = tabulate(sources.get("layered3"), vector[None], 1_000_000, stream_keys(0, [0]), error=False)
    fit = fit_constant(tables, SHORT)
    assert fit.brightness == pytest.approx(1.0, abs=0.04)
    assert fit.figures["albedo_error"] < 0.05


@pytest.mark.slow
def test_the_fit_is_an_adapter_that_can_be_saved(fit, coated, tmp_path):
    fit.adapter.save(tmp_path / "red.safetensors")
    loaded = Adapter.load(tmp_path / "red.safetensors")
    assert (loaded.variant, loaded.reciprocal) == ("single", True)
    assert loaded.training["material"] == "red"
    tables = [tabulate_adapter(a, coated.params, directions=1) for a in (fit.adapter, loaded)]
    np.testing.assert_array_equal(*tables)
    numbers = loaded.numbers(coated.params, [0.1, 0.9])[0]
    np.testing.assert_array_equal(numbers[0], numbers[1])
    np.testing.assert_allclose(numbers[0][:4], [*fit.principled.base_color, fit.principled.roughness])


def test_only_isotropic_tables_of_one_material_are_fitted(red):
    with pytest.raises(TableError, match="one material, but the table has 2 materials"):
        fit_constant(Tables.concatenate([red, red]))
    with pytest.raises(TableError, match="isotropic tables"):
        fit_constant(Tables(np.zeros((1, 0)), np.zeros((1, 2, 4, 2, 4, 3)), np.ones(1, np.int64)))


# ---- The export ------------------------------------------------------------------------------------------------------


def lanes(w: Vec3) -> Vec3:
    return Vec3(*(dr.auto.Float(np.asarray(x, np.float32)) for x in w))


def instances() -> list[Principled]:
    """Returns random BRDFs, and BRDFs with `specular` near the ends of its range.

    Near an end of the range of `specular`, the export may write the parameter `eta` instead.
    """
    many = random_principled(np.random.default_rng(4), 8)
    one = [
        Principled(Color(*(float(c[n]) for c in many.base_color)), *(float(x[n]) for x in many[1:11]))
        for n in range(8)
    ]
    return [
        *one,
        RED._replace(specular=0.0, metallic=0.5),
        RED._replace(specular=1.6),
        RED._replace(specular=1.0),
        RED._replace(specular=1e-6, metallic=0.5),
    ]


@pytest.mark.parametrize("p", instances())
@pytest.mark.parametrize("form", ["dictionary", "XML"])
def test_mitsuba_evaluates_the_export_to_the_same(p, form):
    """Mitsuba's values of the exported BSDF equal ours within 2e-4 relative, away from the horizon.

    The gloss of the clearcoat is limited to 0.8, because Mitsuba loses digits of narrower clearcoats in single
    precision. A failure means that the export writes a wrong parameter.
    """
    p = p._replace(clearcoat_gloss=min(p.clearcoat_gloss, 0.8))
    bsdf = from_dict(principled_dict(p)) if form == "dictionary" else from_string(principled_xml(p))
    rng = np.random.default_rng(5)
    wi, wo = random_directions(rng, 4000), random_directions(rng, 4000)
    expected = stacked(eval_principled(p, wi, wo))
    value = stacked(Vec3(*(c.numpy() for c in bsdf.eval(lanes(wi), lanes(wo)))))
    compared = (wi.z > 1e-2) & (wo.z > 1e-2)
    np.testing.assert_allclose(value[:, compared], expected[:, compared], rtol=2e-4, atol=1e-6)


def test_specular_beyond_mitsuba_s_range_is_written_as_eta():
    assert principled_dict(RED)["specular"] == 0.6
    assert "eta" not in principled_dict(RED)
    for specular, eta in ((0.0, 1.00001), (1.6, 2.114153)):
        description = principled_dict(RED._replace(specular=specular))
        assert "specular" not in description
        assert description["eta"] == pytest.approx(eta, abs=1e-6)


@pytest.mark.parametrize("change", [{"anisotropic": -2.0}, {"specular": 13.0}, {"roughness": float("nan")}])
def test_parameters_that_mitsuba_does_not_allow_are_refused(change):
    with pytest.raises(ParamError, match=next(iter(change))):
        principled_dict(RED._replace(**change))


# ---- The command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def fitted(fit, monkeypatch) -> list[tuple]:
    """Makes the command use the fixture `fit` as the result for every input.

    The value of `fitted` is a list of the pairs (tables, record) that the command gave to `fit_constant`.
    """
    given = []

    def find(tables, recipe, record, **options):
        given.append((tables, record))
        return fit

    monkeypatch.setattr("nma.train.principled.fit_constant", find)
    return given


@pytest.mark.slow
def test_the_command_prints_json_and_nothing_else_on_stdout(nma, fit, red, monkeypatch, tmp_path):
    """The command prints the same BRDF as the fixture `fit`, because `fit_constant` is deterministic.

    The table in this test has no class and no parameters of a material, because the fit does not need them.
    """
    monkeypatch.setattr("nma.train.principled.CONSTANT", SHORT)
    red.save(tmp_path / "red.npz")
    code, out, err = nma("principled", tmp_path / "red.npz")
    assert code == 0, err
    assert json.loads(out) == principled_dict(fit.principled)
    assert f"log loss {fit.log_loss:.5f}" in err


@pytest.mark.slow
@pytest.mark.parametrize(("brightness", "words"), [(0.8, "20.0 % too dark"), (1.1, "10.0 % too bright")])
def test_a_fit_that_misses_the_albedo_comes_with_a_warning(
    nma, fit, red, monkeypatch, tmp_path, brightness, words
):
    red.save(tmp_path / "red.npz")
    found = fit
    monkeypatch.setattr("nma.train.principled.fit_constant", lambda *_, **__: found)
    assert "warning" not in nma("principled", tmp_path / "red.npz")[2]
    found = fit._replace(figures=fit.figures | {"albedo_error": 0.128}, brightness=brightness)
    code, out, err = nma("principled", tmp_path / "red.npz")
    assert code == 0 and json.loads(out)
    assert f"log loss {fit.log_loss:.5f} over the table, albedo error 0.1280" in err
    assert f"warning: an albedo error of 0.1280 is above 0.05 ({words} in all)" in err


@pytest.mark.slow
def test_the_command_writes_what_mitsuba_loads(nma, fit, fitted, red, tmp_path):
    red.save(tmp_path / "red.npz")
    folder = tmp_path / "new"
    for ending in ("xml", "json", "safetensors"):
        code, out, err = nma("principled", tmp_path / "red.npz", "-o", folder / f"red.{ending}")
        assert code == 0, err
        assert f"red.{ending}" + ("" if ending == "safetensors" else " for Mitsuba") in err
    assert sorted(p.name for p in folder.iterdir()) == ["red.json", "red.safetensors", "red.xml"]
    assert Adapter.load(folder / "red.safetensors").size == 12
    description = json.loads((folder / "red.json").read_text())
    assert description == json.loads(out) == principled_dict(fit.principled)
    wi, wo = (lanes(random_directions(np.random.default_rng(n), 100)) for n in (6, 7))
    one, other = from_dict(description), sources.read(folder / "red.xml")
    for a, b in zip(one.eval(wi, wo), other.eval(wi, wo), strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())


@pytest.mark.slow
def test_named_materials_values_and_tables_are_sources(nma, fitted, red, monkeypatch, tmp_path):
    monkeypatch.setattr("nma.table.values.POINTS", 16)
    xml, both, networks = tmp_path / "red.xml", tmp_path / "both.npz", tmp_path / "networks.npz"
    xml.write_text(principled_xml(RED))
    np.savez(networks, names=np.array(["a", "b"]), weights=np.zeros((2, WEIGHTS), np.float32))
    black = Tables(red.params, 0 * red.values, red.walks, red.error)
    Tables.concatenate([black, red]).save(both)
    for arguments in (
        ("gold-red-lacquer", "--walks", 16_000, "--seed", 3),
        (xml,),
        (both, "--material", 1),
        (networks, "--material", "b"),
    ):
        code, _, err = nma("principled", *arguments)
        assert code == 0, err
    (gold, *records), tables = [r for _, r in fitted], [t for t, _ in fitted]
    assert gold == {
        "data": "material gold-red-lacquer",
        "material": "gold-red-lacquer",
        "walks_per_material": 16_000,
    }
    assert [r["material"] for r in records] == ["red", "both 1", "b"]
    assert [t.params.shape for t in tables] == [(1, 13), (1, 0), (1, 0), (1, 0)]
    np.testing.assert_array_equal(tables[1].values, red.values)
    np.testing.assert_array_equal(tables[2].values, red.values)
    assert not tables[3].values.any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("gold-red-laquer",), "did you mean 'gold-red-lacquer'"),
        (("no.toml",), "no material file"),
        (("no.bsdf",), "no.bsdf"),
        (("no.npz",), "no such file"),
        (("picture.png",), "no source reads such files"),
        (("both.npz",), "choose one with --material 0 .. 1"),
        (("both.npz", "--material", "2"), "not '2'"),
        (("networks.npz",), "say which"),
        (("networks.npz", "--material", "b"), "no material 'b'"),
        (("brushed.xml",), "anisotropic"),
    ],
)
def test_a_mistake_is_one_line_on_stderr(nma, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    Tables(np.zeros((2, 0)), np.zeros((2, 2, 2, 2, 3)), np.ones(2, np.int64)).save("both.npz")
    np.savez("networks.npz", names=np.array(["a"]), weights=np.zeros((1, WEIGHTS), np.float32))
    (tmp_path / "brushed.xml").write_text(principled_xml(RED._replace(anisotropic=0.9)))
    code, out, err = nma("principled", *arguments)
    assert (code, out) == (1, "")
    assert err.startswith("nma: ") and err.count("\n") == 1
    assert message in err


@pytest.mark.parametrize("arguments", [("-o", "gold.txt"), ("--material", "gold")])
def test_wrong_usage_exits_with_2(nma, arguments):
    assert nma("principled", "gold-red-lacquer", *arguments)[0] == 2
