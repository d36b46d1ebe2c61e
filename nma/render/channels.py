"""What the channels of a rendered picture are: colours, and what else an integrator of Mitsuba's puts beside them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.images.io import CHANNELS

# IEC 61966-2-1, as `mitsuba.xyz_to_srgb` has it.
_XYZ_TO_SRGB = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]],
    np.float32,
)
_RGBA = [letter.upper() for letter in CHANNELS]


def channel_names(scene: Any, count: int, sensor: int = 0) -> list[str]:
    """The names of the `count` channels of a scene's picture, once it was rendered; all of them differ.

    The film names its own colours first. Its list goes on with all that the integrator computes: `aov` announces its
    nested integrators as RGBA, and then hands them over in the film's format, the first one in place of the film's.
    """
    announced = list(scene.integrator().aov_names())
    film = [channel.name for channel in scene.sensors()[sensor].film().bitmap().struct_()]
    own = film[: len(film) - len(announced)]
    nested = 0
    while [name.rpartition(".")[2] for name in announced[4 * nested : 4 * nested + 4]] == _RGBA:
        nested += 1
    others = [name.rpartition(".")[0] for name in announced[4 : 4 * nested : 4]]
    more = [f"{other}.{name}" for other in others for name in own] + announced[4 * nested :]
    for names in (own + more, more):
        if len(names) == count:
            return names
    return [*own, *(f"channel{k}" for k in range(len(own), count))][:count]


def colours(image: NDArray[np.float32], names: list[str]) -> NDArray[np.float32]:
    """The picture's colours as linear sRGB (height, width, 3): its first three channels if they are such, else grey."""
    if names[:3] == _RGBA[:3]:
        return image[..., :3]
    if names[:3] == ["X", "Y", "Z"]:
        return image[..., :3] @ _XYZ_TO_SRGB.T
    return image[..., :1].repeat(3, axis=2)
