"""The `.binary` files of the MERL BRDF database: reading, evaluation, and writing from any isotropic source.

The database is that of Matusik et al. 2003, "A Data-Driven Reflectance Model". A file has three little-endian int32
(90, 90, 180), then three planes of float64 for red, green and blue. Within a plane phi_d varies fastest, then theta_d,
then theta_h. The grid is uniform in the square root of theta_h, in theta_d and in phi_d. Each channel has its own scale
(`SCALE`). A negative number means that the entry was not measured.

The azimuths phi_d and phi_d + pi share an entry. Exchanging view and light adds pi to phi_d, so the format assumes that
materials are reciprocal.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.errors import SourceError
from nma.files import write_bytes
from nma.jit import dr
from nma.ops import Color, Vec3
from nma.sources import files
from nma.sources.base import Values
from nma.sources.files import Format, Measurements
from nma.sources.half_difference import angles, directions
from nma.sources.lookup import Lookup

SHAPE = (90, 90, 180)
# Factors for red, green and blue that convert a number in the file to f [1/sr].
SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
# The size of every MERL file in bytes.
BYTES = 12 + 3 * 8 * math.prod(SHAPE)

# `Merl.of` marks an entry as not measured if the cosine of either direction is smaller than `_MIN_COS`, because the
# division of f cos(theta_o) by cos(theta_o) would lose too many digits.
_MIN_COS = 1e-4
_NO_DATA = -1.0


class Merl:
    """A measured isotropic BRDF (`Values`).

    `planes` (3, 90, 90, 180) float64 are the numbers of the file, with the axes channel, theta_h, theta_d and phi_d.

    The database's own reader rounds angles down to the index of an entry, so for this reader an entry applies to a
    whole cell of the grid. In this class, an entry is the value at the middle of its cell. Between the middles, `eval`
    interpolates linearly, from measured entries only.
    """

    isotropic = True

    def __init__(self, planes: NDArray[np.float64], name: str = "MERL file"):
        if planes.shape != (3, *SHAPE):
            raise SourceError(f"{name}: MERL planes have shape {(3, *SHAPE)}, got {planes.shape}")
        self.planes, self.name = planes, name
        measured = (planes >= 0).all(axis=0)
        # The fourth channel is 1 where an entry was measured, else 0.
        cells = np.concatenate([planes * SCALE[:, None, None, None], np.ones((1, *SHAPE))]) * measured
        self._lookup = Lookup(np.moveaxis(cells, 0, -1), (False, False, True))

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr], or 0 where none of the neighbouring entries was measured."""
        theta_h, theta_d, phi_d = angles(wo, wi)
        position = (
            SHAPE[0] * dr.sqrt(theta_h * (2.0 / math.pi)),
            SHAPE[1] * (2.0 / math.pi) * theta_d,
            SHAPE[2] / math.pi * dr.select(phi_d < 0, phi_d + math.pi, phi_d),
        )
        *f, measured = self._lookup.linear(position)
        above = (wi.z > 0) & (wo.z > 0) & (measured > 0)
        return Color(*f) * dr.select(above, wo.z / dr.maximum(measured, 1e-9), 0.0)

    @staticmethod
    def load(path: str | Path) -> Merl:
        """Reads a file. Raises `SourceError` with the fault if the file is missing or damaged."""
        return Merl(read(path), Path(path).stem)

    def save(self, path: str | Path) -> None:
        """Writes a file, atomically."""
        write_bytes(path, np.array(SHAPE, "<i4").tobytes() + self.planes.astype("<f8").tobytes())

    @staticmethod
    def of(values: Values) -> Merl:
        """Samples any isotropic source at MERL's resolution: each entry is the value at the middle of its cell.

        The file does not distinguish view and light, so an entry is the mean of f(wi, wo) and f(wo, wi). The result is
        therefore reciprocal, even if the source is not. Raises `SourceError` for anisotropic sources.
        """
        if not values.isotropic:
            raise SourceError(
                f"{values.name}: MERL files hold isotropic materials, but this source is anisotropic"
            )
        middles = [(np.arange(n) + 0.5) / n for n in SHAPE]
        grid = np.meshgrid(*middles, indexing="ij")
        h, d, p = (dr.auto.Float(x.ravel().astype(np.float32)) for x in grid)
        light, view = directions(h * h * (0.5 * math.pi), d * (0.5 * math.pi), p * math.pi)
        seen = (light.z > _MIN_COS) & (view.z > _MIN_COS)
        dr.eval(*light, *view)
        # The two orders of the directions are evaluated by separate calls, because the second call reuses the kernel
        # that Dr.Jit compiles for the first call.
        f = 0.5 * (_brdf(values, view, light) + _brdf(values, light, view))
        planes = f.reshape(3, *SHAPE) / SCALE[:, None, None, None]
        return Merl(np.where(seen.numpy().reshape(SHAPE), planes, _NO_DATA), values.name)


def read(path: str | Path) -> NDArray[np.float64]:
    """The planes (3, 90, 90, 180) of a file, unscaled. Raises `SourceError` with the fault if the file is damaged."""
    path = Path(path)
    content = files.content(path, "MERL")
    _check_size(path, content)
    planes = np.frombuffer(content, "<f8", offset=12).reshape(3, *SHAPE).astype(np.float64)
    if not np.isfinite(planes).all():
        channel, *entry = np.argwhere(~np.isfinite(planes))[0].tolist()
        colour = ("red", "green", "blue")[channel]
        raise SourceError(f"{path}: entry {entry} of {colour} is not finite; copy the file again")
    if not (planes >= 0).all(axis=0).any():
        raise SourceError(f"{path}: every entry is negative, which means that nothing was measured")
    return planes


def _brdf(values: Values, wi: Vec3, wo: Vec3) -> NDArray[np.float32]:
    """f (3, n) [1/sr]. Negative values become 0, because a negative number in a file means "not measured"."""
    f = Color(*(ops.maximum(c, 0.0) for c in values.eval(wi, wo))) * (1.0 / ops.maximum(wo.z, _MIN_COS))
    dr.eval(*f)
    return np.stack([c.numpy() for c in f])


def _check_size(path: Path, content: bytes) -> None:
    """Raises `SourceError` if the file is too short or too long, or has other dimensions."""
    if len(content) < 12:
        raise SourceError(f"{path}: {len(content)} bytes are too short for a MERL file; copy the file again")
    shape = tuple(np.frombuffer(content, "<i4", 3).tolist())
    if shape != SHAPE:
        raise SourceError(f"{path}: its dimensions are {shape}, but those of a MERL file are {SHAPE}")
    if len(content) != BYTES:
        what = "truncated" if len(content) < BYTES else "too long"
        raise SourceError(f"{path}: {what}, {len(content):,} bytes instead of {BYTES:,}; copy the file again")


def _identify(path: Path) -> str:
    read(path)
    return "MERL"


MERL = Measurements(
    "MERL",
    "measurement: 100 isotropic materials",
    "https://www.merl.com/research/downloads/BRDF",
    "Matusik et al. 2003, A Data-Driven Reflectance Model",
    "CC-BY-SA-4.0",
    f"100 files NAME.binary of {BYTES:,} bytes each",
    {},
)
FORMAT = Format("MERL", Merl.load, measurements=(MERL,), identify=_identify)
