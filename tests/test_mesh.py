"""Meshes in place of the shader ball: their position and size, their normals and texture coordinates, faulty files."""

import numpy as np
import pytest
from adapter_cases import random_anisotropic_adapter

import nma.render
from nma.images.io import read_image
from nma.render.load import load_dict
from nma.render.mesh import HEIGHT, LIFT, WIDTH, MeshError, mesh_shape
from nma.render.scene import preview_scene
from nma.render.shaderball import shader_ball, write_ply
from nma.render.textures import bitmap_texture

nma.render.use("llvm_ad_rgb")
import mitsuba as mi  # noqa: E402

# A wedge far from the origin, whose height (y) is twice its width (x).
OBJ = """
v 10 0 5\nv 12 0 5\nv 12 0 6\nv 10 4 5
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1
f 1/1 3/3 2/2\nf 1/1 2/2 4/4\nf 2/2 3/3 4/4\nf 3/3 1/1 4/4
"""
PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face {}\nproperty list uchar int vertex_indices\nend_header\n{}\n"


@pytest.fixture
def wedge(tmp_path):
    path = tmp_path / "wedge.obj"
    path.write_text(OBJ)
    return path


def params(shape):
    return mi.traverse(load_dict(shape))


def bounds(shape):
    points = np.array(params(shape)["vertex_positions"]).reshape(-1, 3)
    return points.min(axis=0), points.max(axis=0)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_mesh_stands_on_the_floor_in_the_middle_as_large_as_the_ball(wedge, up):
    low, high = bounds(mesh_shape(wedge, up=up))
    assert low[2] == pytest.approx(LIFT, abs=1e-5)
    assert (low + high)[:2] == pytest.approx([0.0, 0.0], abs=1e-5)
    extent = high - low
    full = extent[2] / HEIGHT if up == "y" else extent[1] / WIDTH
    assert full == pytest.approx(1.0, rel=1e-5)
    # The mesh keeps the proportions of the file.
    assert sorted(extent / extent.max()) == pytest.approx([0.25, 0.5, 1.0], rel=1e-5)


def test_normals_and_texture_coordinates_are_kept(tmp_path):
    ball = shader_ball(0.2)
    path = tmp_path / "ball.ply"
    write_ply(path, ball._replace(vertices=3.0 * ball.vertices + [4.0, 5.0, 6.0]))
    kept = params(mesh_shape(path, coordinates=True))
    assert np.array(kept["vertex_normals"]) == pytest.approx(ball.normals.ravel(), abs=1e-5)
    assert np.array(kept["vertex_texcoords"]) == pytest.approx(ball.uv.ravel(), abs=1e-5)


def test_a_flat_mesh_lies_above_the_floor(tmp_path):
    path = tmp_path / "sheet.ply"
    path.write_text(PLY.format(3, 1, "0 0 0\n1 0 0\n0 1 0\n3 0 1 2"))
    low, high = bounds(mesh_shape(path))
    assert low[2] == high[2] == pytest.approx(LIFT)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "there is no mesh"),
        ("", "cannot be read"),
        ("ply\nnonsense", "cannot be read"),
        (PLY.format(0, 0, ""), "empty"),
        (PLY.format(3, 0, "0 0 0\n1 0 0\n0 1 0"), "empty"),
        (PLY.format(3, 1, "0 0 0\nnan 0 0\n0 1 0\n3 0 1 2"), "NaN or infinite|cannot be read"),
        (PLY.format(3, 1, "1 2 3\n1 2 3\n1 2 3\n3 0 1 2"), "no extent"),
        (
            PLY.format(3, 2, "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 99"),
            "triangle 1 refers to vertex 99, but the mesh has 3 vertices",
        ),
    ],
)
def test_a_mesh_that_cannot_be_shown_is_refused(tmp_path, text, message):
    path = tmp_path / "mesh.ply"
    if text is not None:
        path.write_text(text)
    with pytest.raises(MeshError, match=message) as error:
        mesh_shape(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_an_unknown_file_format_or_axis_is_refused(wedge, tmp_path):
    with pytest.raises(MeshError, match=r"must end in \.ply or \.obj"):
        mesh_shape(tmp_path / "mesh.stl")
    with pytest.raises(MeshError, match="choose z or y"):
        mesh_shape(wedge, up="x")


def test_textures_and_anisotropic_adapters_need_texture_coordinates(tmp_path, wedge):
    bare = tmp_path / "bare.ply"
    bare.write_text(PLY.format(3, 1, "0 0 0\n1 0 0\n0 1 1\n3 0 1 2"))
    plain = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    textured = {"type": "diffuse", "reflectance": bitmap_texture(np.full((2, 2), 0.5))}
    preview_scene(plain, mesh=bare)
    preview_scene(textured, mesh=wedge, mesh_up="y")
    random_anisotropic_adapter("1x8").save(tmp_path / "anisotropic.safetensors")
    anisotropic = {"type": "nma", "adapter": str(tmp_path / "anisotropic.safetensors")}
    for needy in (textured, anisotropic):
        with pytest.raises(MeshError, match="no texture coordinates"):
            preview_scene(needy, mesh=bare)


def test_render_shows_a_mesh_with_clamped_samples(nma, wedge, tmp_path):
    common = ("gold-red-lacquer", "--adapter", "layered3-3x32", "--size", 24, "--spp", 4)
    mesh = ("--mesh", wedge, "--mesh-up", "y", "--clamp-samples", "0.5", "--lighting", "outdoors")
    code, _, err = nma("render", *common, *mesh, "-o", tmp_path / "wedge.png")
    assert code == 0, err
    assert 0.0 < read_image(tmp_path / "wedge.exr").max() <= 0.5
    for wrong in (("--mesh-up", "y"), ("--envmap", "x.exr", "--lighting", "studio")):
        code, _, err = nma("render", *common, *wrong)
        assert code == 2 and "cannot be used with" in err
    code, _, err = nma("render", *common, "--mesh", tmp_path / "no.ply", "-o", tmp_path / "no.png")
    assert code == 1 and "there is no mesh" in err
