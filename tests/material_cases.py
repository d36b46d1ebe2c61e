"""The text of a material file and a function that writes images, which several test files share."""

from pathlib import Path

import numpy as np

PLAIN = """
title = "Test"
class = "layered3"
[parameters]
alpha_top = 0.1
alpha_bottom = 0.2
eta_top = 1.5
conductor = "Au"
albedo = 0.5
sigma_t = 0.25
"""


# Each entry is a pixel and whether this pixel counts as coloured. Rounding may make the channels of a grey pixel differ
# a little.
GREYS = (
    ((0.5, 0.5 + 0.8e-6, 0.5), False),
    ((0.5, 0.5 + 1.3e-6, 0.5), True),
    ((0.5, 0.5, 0.5 - 1.3e-6), True),
    ((0.5, 0.5 + 0.8e-6, 0.5 - 0.8e-6), True),
    ((4.0, 4.0 - 3e-6, 4.0), False),
    ((4.0, 4.0 - 5e-6, 4.0), True),
)


def write_image(path: Path, pixels: np.ndarray) -> Path:
    import mitsuba as mi

    mi.Bitmap(pixels).write(str(path))
    return path
