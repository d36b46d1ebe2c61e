"""Images in material files: their colours, channels and repeats, and the files that are refused."""

import struct
import zlib

import mitsuba as mi
import numpy as np
import pytest
from material_cases import write_image

from nma import materials
from nma.errors import MaterialError, TextureError


def test_colours_are_made_linear_and_numbers_are_not(material_file, tmp_path):
    pixels = np.full((2, 4, 3), 128, np.uint8)
    write_image(tmp_path / "image.png", pixels)
    colour = materials.load(material_file("albedo = 0.5", "albedo = { texture = 'image.png' }")).values[
        "albedo"
    ]
    assert colour.read().shape == (2, 4, 3)
    np.testing.assert_allclose(colour.read(), 0.21586, atol=1e-4)  # the sRGB byte 128 in linear light

    texture = "{ texture = 'image.png', scale = 0.5, offset = 0.1 }"
    number = materials.load(material_file("sigma_t = 0.25", f"sigma_t = {texture}")).values["sigma_t"]
    assert number.read().shape == (2, 4, 1)
    np.testing.assert_allclose(number.read(), 0.1 + 0.5 * 128 / 255, atol=1e-6)


def test_a_colour_may_be_given_in_hexadecimal_digits_of_srgb(material_file):
    """The colour #3366ee is (51, 102, 238) / 255 in sRGB, and is converted to linear light."""
    for digits in ("#3366ee", "#3366EE"):
        material = materials.load(material_file("albedo = 0.5", f"albedo = '{digits}'"))
        np.testing.assert_allclose(material.values["albedo"], [0.0331048, 0.1328683, 0.8549926], rtol=1e-5)
    edges = materials.load(material_file("albedo = 0.5", "albedo = '#000aff'")).values["albedo"]
    np.testing.assert_allclose(edges, [0.0, 10 / 255 / 12.92, 1.0])
    changed = materials.load(material_file()).changed({"albedo": "#3366ee"})
    np.testing.assert_allclose(changed.values["albedo"], material.values["albedo"])


PACKED = np.array([[[255, 25, 0, 128], [0, 51, 255, 255]]], np.uint8)


@pytest.mark.parametrize("ending", ["png", "exr"])
def test_a_channel_of_a_packed_image_is_chosen_by_its_letter(material_file, tmp_path, ending):
    pixels = PACKED if ending == "png" else PACKED.astype(np.float32) / 255
    write_image(tmp_path / f"orm.{ending}", pixels)
    for n, letter in enumerate("rgba"):
        given = f"sigma_t = {{ texture = 'orm.{ending}', channel = '{letter}' }}"
        texture = materials.load(material_file("sigma_t = 0.25", given)).values["sigma_t"]
        np.testing.assert_allclose(texture.read()[..., 0], PACKED[..., n] / 255, atol=1e-6)


def test_only_the_chosen_channel_must_lie_in_the_range(material_file, tmp_path):
    write_image(tmp_path / "orm.png", PACKED)
    for letter, good in zip("rgba", (False, True, False, True), strict=True):
        given = f"alpha_bottom = {{ texture = 'orm.png', channel = '{letter}' }}"
        texture = materials.load(material_file("alpha_bottom = 0.2", given)).values["alpha_bottom"]
        if good:
            texture.read()
            continue
        with pytest.raises(TextureError, match="alpha_bottom"):
            texture.read()


def test_a_coloured_image_for_one_number_is_refused_unless_a_channel_is_chosen(material_file, tmp_path):
    """If a scalar parameter gets a coloured image, the error message says how to choose one channel of the image.

    A grey image with three equal channels is accepted without a choice.
    """
    write_image(tmp_path / "orm.png", PACKED[..., :3].copy())
    texture = materials.load(material_file("sigma_t = 0.25", "sigma_t = { texture = 'orm.png' }")).values[
        "sigma_t"
    ]
    with pytest.raises(
        TextureError, match=r"orm.png is coloured, .* \{ texture = 'orm.png', channel = 'g' \}"
    ):
        texture.read()
    write_image(tmp_path / "orm.png", np.repeat(PACKED[..., 1:2], 3, axis=2))
    np.testing.assert_allclose(texture.read()[..., 0], PACKED[..., 1] / 255, atol=1e-6)


@pytest.mark.parametrize("pixels", [PACKED[..., 1:2], PACKED[..., 1::2]], ids=["grey", "grey and alpha"])
def test_a_grey_image_has_equal_channels_r_g_and_b(material_file, tmp_path, pixels):
    path = write_image(tmp_path / "grey.png", pixels.copy())
    assert materials.load(material_file()).changed({"albedo": {"texture": str(path)}}).textures[
        "albedo"
    ].read().shape == (1, 2, 3)
    for choice in ({}, {"channel": "r"}, {"channel": "b"}):
        changed = materials.load(material_file()).changed({"sigma_t": {"texture": str(path), **choice}})
        np.testing.assert_allclose(changed.textures["sigma_t"].read(), pixels[..., :1] / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("channel = 'x'", "channel is 'x', but must be 'r', 'g', 'b' or 'a'"),
        ("channel = 1", "channel is 1"),
        ("channel = 'rg'", "channel is 'rg'"),
        ("channel = ''", "channel is ''"),
        ("channel = ['g']", "channel is"),
    ],
)
def test_an_unknown_channel_is_refused(material_file, tmp_path, given, message):
    write_image(tmp_path / "orm.png", PACKED)
    with pytest.raises(MaterialError, match=message):
        materials.load(material_file("sigma_t = 0.25", f"sigma_t = {{ texture = 'orm.png', {given} }}"))
    with pytest.raises(MaterialError, match="a channel is for parameters of one number"):
        materials.load(material_file("albedo = 0.5", "albedo = { texture = 'orm.png', channel = 'g' }"))
    write_image(tmp_path / "orm.png", PACKED[..., :3].copy())
    texture = materials.load(
        material_file("sigma_t = 0.25", "sigma_t = { texture = 'orm.png', channel = 'a' }")
    )
    with pytest.raises(TextureError, match="no alpha channel"):
        texture.values["sigma_t"].read()


def test_an_image_without_colour_channels_is_refused_with_the_names_of_its_channels(material_file, tmp_path):
    kind = mi.Bitmap.PixelFormat.MultiChannel
    mi.Bitmap(np.zeros((2, 2, 2), np.float32), kind, ["Z", "ID"]).write(str(tmp_path / "other.exr"))
    texture = materials.load(material_file("sigma_t = 0.25", "sigma_t = { texture = 'other.exr' }")).values[
        "sigma_t"
    ]
    with pytest.raises(TextureError, match="channels Z, ID; a texture needs R, G, B"):
        texture.read()


def test_images_repeat_as_often_as_the_file_says(material_file, tmp_path):
    """The `uv_scale` of a material applies to all textures that have no `uv_scale` of their own.

    The `uv_scale` also applies to textures that are added to a loaded material.
    """
    write_image(tmp_path / "image.png", PACKED)
    both = "alpha_bottom = { texture = 'image.png', channel = 'g', uv_scale = 2.5 }\nalbedo = { texture = 'image.png' }"
    path = material_file("alpha_bottom = 0.2", both)
    path.write_text(
        path.read_text().replace("albedo = 0.5", "").replace("[parameters]", "uv_scale = 4\n[parameters]")
    )
    material = materials.load(path)
    assert [t.uv_scale for t in material.textures.values()] == [2.5, 4.0]
    added = material.changed({"sigma_t": {"texture": str(tmp_path / "image.png"), "channel": "g"}})
    assert added.textures["sigma_t"].uv_scale == 4.0
    assert materials.load(material_file()).uv_scale == 1.0


def test_a_textured_material_has_no_vector(material_file, tmp_path):
    write_image(tmp_path / "image.png", np.zeros((2, 2, 3), np.uint8))
    material = materials.load(material_file("albedo = 0.5", "albedo = { texture = 'image.png' }"))
    assert list(material.textures) == ["albedo"]
    with pytest.raises(MaterialError, match="albedo come from textures"):
        material.vector()


@pytest.mark.parametrize("fault", [np.nan, np.inf, -0.5, 2.0])
def test_a_texture_with_a_forbidden_value_is_refused_with_the_pixel(material_file, tmp_path, fault):
    pixels = np.full((3, 5, 3), 0.5, np.float32)
    pixels[2, 4, 1] = fault
    write_image(tmp_path / "image.exr", pixels)
    texture = materials.load(material_file("albedo = 0.5", "albedo = { texture = 'image.exr' }")).values[
        "albedo"
    ]
    with pytest.raises(TextureError, match=r"image.exr at x=4, y=2: albedo is .*, allowed is 0 .. 1"):
        texture.read()


def test_a_file_that_is_no_image_is_refused(material_file, tmp_path):
    (tmp_path / "image.png").write_text("no image")
    texture = materials.load(material_file("albedo = 0.5", "albedo = { texture = 'image.png' }")).values[
        "albedo"
    ]
    with pytest.raises(TextureError, match="image.png cannot be read"):
        texture.read()


def test_an_image_that_claims_too_many_pixels_is_refused_before_it_is_decoded(material_file, tmp_path):
    header = struct.pack(">4sIIBBBBB", b"IHDR", 100_000, 100_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    texture = materials.load(material_file("albedo = 0.5", "albedo = { texture = 'bomb.png' }")).values[
        "albedo"
    ]
    with pytest.raises(TextureError, match="bomb.png has 100000 x 100000 pixels"):
        texture.read()
