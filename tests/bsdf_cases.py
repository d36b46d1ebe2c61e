"""Helpers for the tests of BSDFs: a texture with one special pixel, and the error message for a faulty BSDF."""

import mitsuba as mi
import numpy as np
import pytest

from nma.render.textures import bitmap_texture


def load_error(description):
    """Returns the error message with which `mi.load_dict` refuses the description of a BSDF."""
    with pytest.raises(RuntimeError) as e:
        mi.load_dict(description)
    return str(e.value)


def texture(value, channels=1):
    """Returns a texture of .5 everywhere, but with `value` in the pixel at x=5, y=2."""
    pixels = np.full((4, 8, channels), 0.5, np.float32)
    pixels[2, 5] = value
    return bitmap_texture(pixels)
