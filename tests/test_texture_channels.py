"""A scalar parameter reads one channel of a coloured image. The user must choose this channel by its name."""

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import nma.render
from nma.jit import dr

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
        ("luminance", "alpha_bottom_channel is 'luminance'; take r, g or b"),
    ),
)
def test_other_choices_are_refused(kind, packed, channel, message):
    choice = {} if channel is None else {"alpha_bottom_channel": channel}
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict(bsdf(kind, alpha_bottom=packed, **choice))


def test_a_channel_is_refused_for_numbers_and_for_colours(packed):
    for changes in ({"alpha_top_channel": "r"}, {"albedo": packed, "albedo_channel": "r"}):
        with pytest.raises(
            RuntimeError, match="chooses a channel of a texture for a parameter of one number"
        ):
            mi.load_dict(bsdf("nma", **changes))
