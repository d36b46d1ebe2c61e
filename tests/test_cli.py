"""The command line: what it prints where, what it writes, and how it fails."""

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import typer

from nma import cli, network
from nma.adapter import Adapter, encoding
from nma.cli.learn import _finite
from nma.evaluate.metrics import FIGURES
from nma.images.io import read_image, write_exr
from nma.params import LAYERED3
from nma.target import PRINCIPLED_PARAMS
from nma.target.decode import output_size

DOCS = Path(__file__).parents[1] / "docs"
APP = typer.main.get_command(cli.app)
COMMANDS = tuple(APP.commands)
SCENE = """
<scene version="3.0.0">
    <default name="alpha" value="0.2"/>
    <integrator type="path"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, -4, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/></film>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere">
        <bsdf type="BSDF">
            <string name="material" value="gold-red-lacquer"/>
            <float name="alpha_bottom" value="$alpha"/>
        </bsdf>
    </shape>
</scene>
"""


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """An adapter that has learnt nothing."""
    inputs = encoding.size("layered3", LAYERED3, True)
    layers = network.init(np.random.default_rng(0), [inputs, 8, 8, output_size(2, PRINCIPLED_PARAMS)])
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    Adapter(LAYERED3, "layered3", layers, 2, True, PRINCIPLED_PARAMS).save(path)
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(nma, command):
    code, out, _ = nma(command, "--help")
    assert code == 0
    assert APP.commands[command].help.split(".")[0].split()[0] in out


def test_the_documentation_has_every_command_with_every_option():
    """docs/commands.md has a section for each command, and in it exactly the options that the command takes."""
    text = (DOCS / "commands.md").read_text()
    sections = dict(re.findall(r"^## `nma ([\w-]+)`\n(.*?)(?=^## |\Z)", text, re.M | re.S))
    assert set(sections) == set(COMMANDS)
    for command, section in sections.items():
        options = {
            max(p.opts, key=len) for p in APP.commands[command].params if p.param_type_name == "option"
        }
        documented = set(re.findall(r"^\| `(--[\w-]+)", section, re.M))
        assert documented == options - {"--help"}, command


def test_the_examples_of_the_documentation_parse():
    """Every line that starts with `nma` in a block of code, in all pages."""
    pages = [*DOCS.glob("*.md"), DOCS.parent / "README.md"]
    blocks = [
        b for page in pages for b in re.findall(r"^```(?:sh)?\n(.*?)^```", page.read_text(), re.M | re.S)
    ]
    lines = [line for block in blocks for line in block.splitlines() if line.startswith("nma ")]
    assert len(lines) > 20
    for line in lines:
        _, command, *arguments = shlex.split(re.split(r"\s# ", line)[0])
        APP.commands[command].make_context(command, arguments)


def test_simulate_and_evaluate_print_one_json_object_and_nothing_else(nma, weights, tmp_path):
    drawn, again = tmp_path / "drawn.npz", tmp_path / "again.npz"
    assert nma("simulate", "--draw", 2, "--walks", 16_000, "--seed", 3, "-o", drawn)[0] == 0
    code, out, _ = nma("simulate", "--params", drawn, "--walks", 16_000, "--seed", 3, "-o", again)
    assert (code, out) == (0, "")
    with np.load(drawn) as one, np.load(again) as two:
        assert one["params"].shape == (2, 13)
        for name in ("params", "table", "walks", "error"):
            np.testing.assert_array_equal(one[name], two[name])
    code, out, _ = nma("evaluate", weights, "--reference", again, "--json")
    assert code == 0
    result = json.loads(out)
    assert set(result) == {"mean", "materials"}
    assert len(result["materials"]) == 2
    for figures in (result["mean"], *result["materials"]):
        assert tuple(figures) == FIGURES
        assert np.isfinite(list(figures.values())).all()
    for name in FIGURES:
        assert result["mean"][name] == pytest.approx(np.mean([m[name] for m in result["materials"]]))


def test_json_has_no_infinity():
    """The PSNR of equal tables is infinite."""
    assert _finite({"psnr": float("inf"), "ae": 0.0}) == {"psnr": None, "ae": 0.0}


@pytest.mark.parametrize("model", ["nma", "layered"])
def test_render_writes_exr_and_png(nma, weights, tmp_path, model):
    options = ("--model", model, "--adapter", weights, "--size", "20x16", "--spp", 2, "--set", "alpha_top=.2")
    code, out, err = nma("render", "gold-red-lacquer", "-o", tmp_path / "gold.png", *options)
    assert (code, out) == (0, ""), err
    assert "gold.exr" in err
    linear = read_image(tmp_path / "gold.exr")
    assert linear.shape == (16, 20, 3)
    assert 0.05 < linear.mean() < 1.0
    assert (tmp_path / "gold.png").stat().st_size > 200


@pytest.mark.parametrize("bsdf", ["nma", "layered"])
def test_render_knows_the_bsdfs_in_a_scene_file(nma, weights, tmp_path, bsdf):
    scene = tmp_path / "scene.xml"
    text = SCENE.replace('type="BSDF">', f'type="{bsdf}">')
    if bsdf == "nma":
        text = text.replace(
            '<string name="mat', f'<string name="adapter" value="{weights}"/><string name="mat'
        )
    scene.write_text(text)
    code, _, err = nma("render", scene, "-o", tmp_path / "a.exr")
    assert code == 0, err
    image = read_image(tmp_path / "a.exr")
    assert image.shape == (16, 24, 3)
    assert image[8, 12].mean() < 0.99 < image[0, 0].mean()
    assert nma("render", scene, "-o", tmp_path / "b.exr", "--size", 12, "-D", "alpha=0.3")[0] == 0
    assert read_image(tmp_path / "b.exr").shape == (12, 12, 3)


@pytest.mark.slow
def test_a_bsdf_is_fitted_and_rendered(nma, tmp_path):
    bsdf, fit = tmp_path / "matte.xml", tmp_path / "matte.safetensors"
    bsdf.write_text('<bsdf version="3.0.0" type="diffuse"/>')
    options = ("--network", "1x8", "--steps", "20", "--albedo", "0")
    status, _, err = nma("fit", bsdf, "-o", fit, *options)
    assert status == 0, err
    assert "at 20,000 pairs of directions: log_loss" in err
    status, _, err = nma("render", fit, "-o", tmp_path / "matte.png", "--size", "16", "--spp", "1")
    assert status == 0, err
    assert (tmp_path / "matte.png").is_file()
    status, _, err = nma("render", fit, "--model", "layered")
    assert status == 2
    assert "--model cannot be used with an adapter" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("render", "gold-red-laquer"), "did you mean 'gold-red-lacquer'"),
        (("render", "gold-red-lacquer", "--set", "alpha_tip=1"), "did you mean 'alpha_top'"),
        (("render", "no.xml"), "no scene file"),
        (("render", "gold-red-lacquer", "--camera", "side"), "unknown camera"),
        (("render", "gold-red-lacquer", "--model", "layers"), "unknown model"),
        (("render", "gold-red-lacquer", "--variant", "metal_rgb"), "no variant"),
        (("render", "gold-red-lacquer", "--variant", "llvm_ad_mono"), "rendered in RGB"),
        (("demo", "--variant", "llvm_ad_spectral"), "rendered in RGB"),
        (
            ("train", "layered3", "--stream", 1, "-o", "x.safetensors", "--network", "\u00b2x\u00b2"),
            "DEPTHxWIDTH",
        ),
        (
            ("train", "layered3", "--stream", 1, "-o", "x.safetensors", "--network", "99999x99999"),
            "at most 64x1024",
        ),
        (("render", "gold-red-lacquer", "--adapter", "no-such"), "no-such"),
        (("compare", "a.exr", "b.exr"), "does not exist"),
        (("evaluate", "no-such", "--reference", "no.npz"), "no-such"),
        (("info", "no.safetensors"), "no.safetensors"),
    ],
)
def test_a_mistake_is_one_line_on_stderr(nma, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, out, err = nma(*arguments)
    assert (code, out) == (1, "")
    assert err.startswith("nma: ") and err.count("\n") == 1
    assert message in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ("render", "scene.xml", "--camera", "top"),
        ("render", "gold-red-lacquer", "-D", "a=1"),
        ("render", "gold-red-lacquer", "--size", "big"),
        ("render", "gold-red-lacquer", "--size", ""),
        ("compare", "a.exr", "b.exr", "--set", "alpha_top=.1"),
        ("compare", "a.exr", "b.exr", "--size", 64),
        ("render", "gold-red-lacquer", "-o", "gold.jpg"),
        ("render", "gold-red-lacquer", "--set", "alpha_top"),
        ("simulate", "-o", "x.npz"),
        ("train", "layered3", "--stream", 1, "-o", "x.safetensors", "--preset", "anisotropic"),
        ("data", "merl", "gold-red-lacquer", "--material", "x", "-o", "x.binary"),
    ],
)
def test_wrong_usage_exits_with_2(nma, arguments):
    assert nma(*arguments)[0] == 2


def test_compare_two_images(nma, tmp_path):
    image = np.random.default_rng(0).random((16, 16, 3), dtype=np.float32)
    a, b = write_exr(tmp_path / "a.exr", image), write_exr(tmp_path / "b.exr", image * 1.1)
    code, out, _ = nma("compare", a, b, "--json", "-o", tmp_path / "difference.png")
    assert code == 0
    errors = json.loads(out)
    assert tuple(errors) == ("l1", "l2", "mape", "smape", "mrse", "ssim", "flip_hdr", "flip_ldr")
    assert errors["l1"] == pytest.approx(0.1 * image.mean(), rel=1e-5)
    assert (tmp_path / "difference.png").is_file()
    assert "flip_hdr" in nma("compare", a, b)[1]


@pytest.mark.slow
def test_compare_a_material_with_its_reference(nma, weights):
    options = ("--adapter", weights, "--size", 16, "--spp", 2, "--json")
    code, out, err = nma("compare", "gold-red-lacquer", *options)
    assert code == 0, err
    assert tuple(json.loads(out)["noise"]) == tuple(json.loads(out))[:-1]


@pytest.mark.slow
def test_demo_draws_two_rows_and_prints_six_lines(nma, weights, tmp_path, monkeypatch):
    """And needs no library for SSIM, which would take longest to install."""
    monkeypatch.setitem(sys.modules, "skimage", None)
    options = ("--size", 16, "--spp", 1, "--runs", 2, "--reference-spp", 2, "--adapter", weights)
    code, out, err = nma("demo", "-o", tmp_path / "demo.png", *options)
    assert code == 0, err
    assert [len(re.findall(f"^{bsdf} ", out, re.M)) for bsdf in ("principled", "layered", "nma")] == [2, 2, 2]
    height, width, _ = read_image(tmp_path / "demo.png").shape
    assert height > 2 * 16 and width > 3 * 16
    shown = [line for line in err.replace("\n", " ").split(str(tmp_path / "demo.png")) if ": " in line]
    assert ["figures" in text for text in shown[-4:]] == [False, False, True, True]
