"""A scalar parameter reads one channel of a coloured image. The user must choose this channel by its name."""

import mitsuba as mi
import numpy as np
import pytest
from material_cases import GREYS, write_image
from PIL import Image

import nma.render
from nma import materials
from nma.errors import NmaError
from nma.jit import dr
from nma.render.textures import bitmap_texture

nma.render.use("llvm_ad_rgb")
PACKED = (200, 40, 0)  # the channels of a packed texture: occlusion, roughness, metalness


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")


@pytest.fixture
def packed(tmp_path):
    path = tmp_path / "orm.png"
    Image.fromarray(np.full((4, 4, 3), PACKED, np.uint8)).save(path)
    return {"type": "bitmap", "filename": str(path), "raw": True}


def bsdf(kind, **changes):
    adapter = {"adapter": "layered3-3x32"} if kind == "nma" else {}
    return {"type": kind, "material": "frosted-silver"} | adapter | changes


@pytest.mark.parametrize("kind", ("nma", "layered"))
def test_the_parameter_is_the_value_of_the_chosen_channel(kind, packed):
    for channel, number in zip("rg", PACKED, strict=False):
        loaded = mi.load_dict(bsdf(kind, alpha_bottom=packed, alpha_bottom_channel=channel))
        columns = loaded.inputs.columns(dr.zeros(mi.SurfaceInteraction3f))
        assert columns[1].numpy()[0] == pytest.approx(number / 255)


@pytest.mark.parametrize("kind", ("nma", "layered"))
@pytest.mark.parametrize(
    ("channel", "message"),
    (
        (
            None,
            "coloured.*alpha_bottom is one number per pixel; choose a channel: set `alpha_bottom_channel`",
        ),
        ("b", r"at x=0, y=0, the first of 16 such pixels: \w+ is 0, allowed.*bytes.*`format` \"variant\""),
        ("luminance", "alpha_bottom_channel is 'luminance'; choose r, g or b"),
    ),
)
def test_other_choices_are_refused(kind, packed, channel, message):
    choice = {} if channel is None else {"alpha_bottom_channel": channel}
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict(bsdf(kind, alpha_bottom=packed, **choice))


@pytest.mark.parametrize(("pixel", "coloured"), GREYS)
def test_a_pixel_is_grey_up_to_rounding_in_scenes_and_in_files(pixel, coloured, material_file, tmp_path):
    """test_scalar_inputs.py has the same cases for the C++ plugins."""
    image = np.tile(np.float32(pixel), (2, 3, 1))
    write_image(tmp_path / "image.exr", image)
    material = materials.load(material_file("sigma_t = 0.25", "sigma_t = { texture = 'image.exr' }"))
    loads = (
        lambda: mi.load_dict(bsdf("layered", sigma_t=bitmap_texture(image))),
        material.values["sigma_t"].read,
    )
    for load in loads:
        if coloured:
            with pytest.raises((RuntimeError, NmaError), match="coloured"):
                load()
        else:
            load()


def test_a_channel_is_refused_for_numbers_and_for_colours(packed):
    for changes in ({"alpha_top_channel": "r"}, {"albedo": packed, "albedo_channel": "r"}):
        with pytest.raises(RuntimeError, match="chooses a channel of a texture, but"):
            mi.load_dict(bsdf("nma", **changes))
