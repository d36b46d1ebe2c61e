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


def write_image(path: Path, pixels: np.ndarray) -> Path:
    import mitsuba as mi

    mi.Bitmap(pixels).write(str(path))
    return path
