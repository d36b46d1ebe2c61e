"""`nma render` writes pictures of materials, of scenes, and of adapters of one material."""

import pytest

from nma.images.io import read_image

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


@pytest.mark.parametrize("model", ["nma", "layered"])
def test_render_writes_exr_and_png(nma, untrained, tmp_path, model):
    shown = ("gold-red-lacquer", "--set", "alpha_top=.2", "--model", model, "--adapter", untrained)
    code, out, err = nma("render", *shown, "-o", tmp_path / "gold.png", "--size", "20x16", "--spp", 2)
    assert (code, out) == (0, ""), err
    assert "gold.exr" in err
    linear = read_image(tmp_path / "gold.exr")
    assert linear.shape == (16, 20, 3)
    assert 0.05 < linear.mean() < 1.0
    assert (tmp_path / "gold.png").stat().st_size > 200


@pytest.mark.parametrize("bsdf", ["nma", "layered"])
def test_render_loads_our_bsdfs_in_a_scene_file(nma, untrained, tmp_path, bsdf):
    scene = tmp_path / "scene.xml"
    text = SCENE.replace('type="BSDF">', f'type="{bsdf}">')
    if bsdf == "nma":
        text = text.replace(
            '<string name="mat', f'<string name="adapter" value="{untrained}"/><string name="mat'
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
def test_a_bsdf_is_fitted_and_rendered(nma, fast_steps, tmp_path):
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
