"""The size of an image is read from its header. An image too large for memory is refused before it is decoded."""

import struct
import zlib

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from nma import materials
from nma.errors import NmaError
from nma.images.io import ImageError, load_bitmap, read_image, write_exr
from nma.images.size import header_size
from nma.render.load import load_scene
from nma.render.scene import preview_scene

FORMATS = ("png", "jpg", "bmp", "tga", "ppm", "hdr", "pfm", "exr")


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant(mi.variant() or "llvm_ad_rgb")


def image(path, kind, width=7, height=5):
    """Writes a black image file of the given format and returns its path."""
    if kind in ("hdr", "pfm", "exr"):
        mi.Bitmap(np.zeros((height, width, 3), np.float32)).write(str(path))
    else:
        Image.new("RGB", (width, height)).save(path)
    return path


def bomb(path, kind):
    """Writes a small image file whose header claims a huge size, and returns its path."""
    content, large = image(path, kind).read_bytes(), 65_000 if kind in ("jpg", "tga") else 100_000
    old, new = (_written(kind, *size) for size in ((7, 5), (large, large)))
    assert old in content
    path.write_bytes(content.replace(old, new))
    return path


def _written(kind, width, height):
    """Returns the bytes that state the size of an image in the header of the file format `kind`."""
    match kind:
        case "png":
            ihdr = b"IHDR" + struct.pack(">II5B", width, height, 8, 2, 0, 0, 0)
            return ihdr + struct.pack(">I", zlib.crc32(ihdr))
        case "jpg":
            return struct.pack(">HH", height, width)
        case "bmp" | "tga":
            return struct.pack("<ii" if kind == "bmp" else "<HH", width, height)
        case "exr":
            return struct.pack("<4i", 0, 0, width - 1, height - 1)
        case "hdr":
            return b"-Y %d +X %d" % (height, width)
    return b"%d %d" % (width, height)


@pytest.mark.parametrize("kind", FORMATS)
def test_the_header_has_the_size_of_the_image(tmp_path, kind):
    path = image(tmp_path / f"a.{kind}", kind)
    assert header_size(path) == (7, 5)
    assert read_image(path).shape == (5, 7, 3)


@pytest.mark.parametrize("kind", FORMATS)
def test_an_image_too_large_for_memory_is_refused_by_its_header(tmp_path, monkeypatch, kind):
    path = bomb(tmp_path / f"bomb.{kind}", kind)
    assert path.stat().st_size < 2000
    monkeypatch.setattr(mi, "Bitmap", None)
    with pytest.raises(
        ImageError, match=r"bomb.* has (100000 x 100000|65000 x 65000) pixels according to its header"
    ):
        read_image(path)


def test_huge_textures_and_environment_maps_are_refused(tmp_path):
    texture = {"texture": str(bomb(tmp_path / "bomb.png", "png"))}
    material = materials.load("wet-nickel").changed({"alpha_top": texture}, "--set")
    with pytest.raises(NmaError, match="bomb.png has .* pixels"):
        material.values["alpha_top"].read()
    with pytest.raises(NmaError, match="bomb.hdr has .* pixels"):
        preview_scene({"type": "diffuse"}, envmap=bomb(tmp_path / "bomb.hdr", "hdr"))


def test_scene_files_that_name_a_huge_image_are_refused(tmp_path):
    (tmp_path / "textures").mkdir()
    bomb(tmp_path / "textures" / "bomb.png", "png")
    texture = '<texture type="bitmap"><string name="filename" value="textures/bomb.png"/></texture>'
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><bsdf type="diffuse">{texture}</bsdf></scene>'
    )
    with pytest.raises(NmaError, match="bomb.png has .* pixels"):
        load_scene(tmp_path / "scene.xml")


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xd8", b"\xff\xd8\xff\xff\xff\xff", b"BM", b"P6 1", b"no image at all"]
)
def test_a_file_that_is_no_image_has_no_size(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    assert header_size(tmp_path / "a.png") is None
    with pytest.raises(ImageError, match="a.png") as error:
        read_image(tmp_path / "a.png")
    assert "\n" not in str(error.value)


def test_a_folder_is_no_image(tmp_path):
    with pytest.raises(ImageError, match="cannot be read: Is a directory"):
        load_bitmap(tmp_path)
    assert header_size(write_exr(tmp_path / "a.exr", np.zeros((2, 3)))) == (3, 2)
