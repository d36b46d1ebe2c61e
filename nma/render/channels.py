"""Finds the names of the channels of a rendered picture: colours, and the other channels that Mitsuba's integrators
write."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.images.io import CHANNELS

# The matrix of IEC 61966-2-1, with the digits of `mitsuba.xyz_to_srgb`.
_XYZ_TO_SRGB = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]],
    np.float32,
)
_RGBA = [letter.upper() for letter in CHANNELS]


def channel_names(scene: Any, count: int, sensor: int = 0) -> list[str]:
    """The names of the `count` channels of a scene's rendered picture; all names differ. The scene must have been
    rendered.

    The film lists its own colours first, then all channels of the integrator. The integrator `aov` declares four RGBA
    channels for each nested integrator, but writes the channels of the film's format. The channels of the first nested
    integrator replace the film's own colours.
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
    """The colours of a picture, as linear sRGB (height, width, 3).

    If `names` says that the first three channels are RGB or XYZ, these channels are returned as RGB. If the first three
    channels are neither RGB nor XYZ, the first channel is returned as grey.
    """
    if names[:3] == _RGBA[:3]:
        return image[..., :3]
    if names[:3] == ["X", "Y", "Z"]:
        return image[..., :3] @ _XYZ_TO_SRGB.T
    return image[..., :1].repeat(3, axis=2)
