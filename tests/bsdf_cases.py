"""What the tests of BSDFs share: an image with one odd pixel, and the error of a description."""

import mitsuba as mi
import numpy as np
import pytest

from nma.render.textures import bitmap_texture


def load_error(description):
    """What `mi.load_dict` says of a description that it refuses."""
    with pytest.raises(RuntimeError) as e:
        mi.load_dict(description)
    return str(e.value)


def texture(value, channels=1):
    """An image of .5 with `value` at x=5, y=2."""
    pixels = np.full((4, 8, channels), 0.5, np.float32)
    pixels[2, 5] = value
    return bitmap_texture(pixels)
