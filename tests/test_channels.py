"""Every channel of a rendered scene is written under its own name, and the picture shows the scene's colours."""

import mitsuba as mi
import numpy as np
import pytest

import nma.render
from nma.errors import ParamError, one_line
from nma.images.io import read_image
from nma.images.size import MOST_PIXELS
from nma.render.load import load_scene
from nma.render.progressive import render_passes

nma.render.use("llvm_ad_rgb")
SKY = (0.2, 0.5, 0.9)
SCENE = """
<scene version="3.0.0">
    {integrator}
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, -6, 0" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><rfilter type="box"/><string name="pixel_format" value="{pixels}"/>
            <integer name="width" value="{size}"/><integer name="height" value="{size}"/></film>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    </sensor>
    <emitter type="constant"><rgb name="radiance" value=".2 .5 .9"/></emitter>
    <shape type="sphere"><bsdf type="diffuse"/></shape>
</scene>
"""
PATH = '<integrator type="path"/>'
NORMALS = ["n.X", "n.Y", "n.Z"]


def aov(aovs, *nested):
    nested = "".join(f'<integrator name="{name}" type="path"/>' for name in nested)
    return f'<integrator type="aov"><string name="aovs" value="{aovs}"/>{nested}</integrator>'


@pytest.mark.parametrize(
    ("pixels", "integrator", "names"),
    [
        ("rgb", PATH, ["R", "G", "B"]),
        ("rgba", PATH, ["R", "G", "B", "A"]),
        ("xyz", PATH, ["X", "Y", "Z"]),
        ("luminance", PATH, ["Y"]),
        ("luminance_alpha", PATH, ["Y", "A"]),
        ("rgb", aov("d:depth", "one"), ["R", "G", "B", "d.T"]),
        ("rgb", aov("d:depth,n:sh_normal", "one"), ["R", "G", "B", "d.T", *NORMALS]),
        ("rgba", aov("d:depth,n:sh_normal", "one"), ["R", "G", "B", "A", "d.T", *NORMALS]),
        ("xyz", aov("d:depth", "one"), ["X", "Y", "Z", "d.T"]),
        ("rgb", aov("d:depth", "one", "two"), ["R", "G", "B", "two.R", "two.G", "two.B", "d.T"]),
        ("rgb", aov("d:depth"), ["d.T"]),
        ("rgb", '<integrator type="moment"><integrator name="one" type="path"/></integrator>', 9),
    ],
)
def test_channels_have_the_names_of_what_they_hold(nma, tmp_path, pixels, integrator, names):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(integrator=integrator, pixels=pixels, size=9))
    code, _, err = nma("render", path, "-o", tmp_path / "a.exr")
    assert code == 0, err
    bitmap = mi.Bitmap(str(tmp_path / "a.exr"))
    found = [channel.name for channel in bitmap.struct_()]
    assert sorted(found) == sorted(names) if isinstance(names, list) else len(found) == names
    values = np.array(bitmap).reshape(9, 9, -1)
    if "d.T" in found:
        depth = values[..., found.index("d.T")]
        assert depth[4, 4] == pytest.approx(5.0, abs=0.1) and depth[0, 0] == 0
    if {"R", "Y", "X"} & set(found):
        # The corner of the picture shows the sky: its luminance in grey formats, its colour in other formats.
        grey = "luminance" in pixels
        sky = np.full(3, np.dot(SKY, (0.2126, 0.7152, 0.0722))) if grey else np.array(SKY)
        np.testing.assert_allclose(read_image(tmp_path / "a.exr")[0, 0], sky, rtol=1e-3)
        np.testing.assert_allclose(read_image(tmp_path / "a.png")[0, 0], sky, rtol=0.03)


def test_pictures_too_large_for_memory_are_refused_before_rendering(nma, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(integrator=PATH, pixels="rgb", size=9))
    for subject in ("gold-red-lacquer", path):
        code, out, err = nma("render", subject, "--size", 65536, "-o", tmp_path / "a.png")
        assert (code, out) == (2, "") and "too large" in err
    path.write_text(SCENE.format(integrator=PATH, pixels="rgb", size=20000))
    with pytest.raises(
        ParamError, match=f"20000 x 20000 pixels is too large; choose at most {MOST_PIXELS:,}"
    ):
        render_passes(load_scene(path), 1)


@pytest.mark.parametrize("size", ["0", "x", "16x", "16x16x16", "-4", "1e3", "\u00b2", "9" * 5000, "16x0"])
def test_malformed_sizes_are_refused(nma, size):
    code, out, err = nma("render", "gold-red-lacquer", "--size", size)
    assert (code, out) == (2, "") and "Traceback" not in err


def test_an_error_of_several_lines_becomes_one_line(tmp_path):
    text = SCENE.format(integrator=PATH, pixels="rgb", size=9)
    inner = '<string name="material" value="wet-nickel"/><bsdf name="alpha_top" type="roughconductor"/>'
    (tmp_path / "scene.xml").write_text(
        text.replace('<bsdf type="diffuse"/>', f'<bsdf type="nma">{inner}</bsdf>')
    )
    with pytest.raises(nma.render.load.SceneError) as error:
        load_scene(tmp_path / "scene.xml")
    assert "alpha_top needs" in str(error.value) and "RoughConductor[" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_message_after_a_traceback_is_kept_whole():
    trace = 'Traceback (most recent call last):\n  File "a.py", line 1, in f\n    g()\n'
    assert one_line(f"at line 3: {trace}ValueError: got A[\n  1\n]\n") == "at line 3: got A[ 1 ]"
    assert one_line(f"at x: {trace}mod.Bad: one\n\nDuring it:\n\n{trace}Worse: two") == "at x: two"
    assert one_line(trace) == ""
    assert len(one_line("word " * 1000)) <= 600
