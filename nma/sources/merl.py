"""The `.binary` files of the MERL BRDF database, read, looked up, and written from any other source.

Matusik et al. 2003, "A Data-Driven Reflectance Model". Three little-endian int32 (90, 90, 180), then three planes of
float64 for red, green and blue, phi_d fastest, then theta_d, then theta_h. theta_h is spaced by its square root, the
other angles uniformly. Each channel has its own scale; what is negative was not measured.

Azimuths phi_d and phi_d + pi share an entry: the format takes reciprocity for granted, swapping view and light.
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
from nma.sources.half_difference import angles, directions
from nma.sources.lookup import Lookup

SHAPE = (90, 90, 180)
# f in 1/sr is the number in the file times these, for red, green and blue.
SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
# Size of every file in bytes.
BYTES = 12 + 3 * 8 * math.prod(SHAPE)

# Entries that see either direction under a smaller cosine get no value: f cos / cos would lose its digits.
_MIN_COS = 1e-4
_NO_DATA = -1.0


class Merl:
    """A measured isotropic BRDF (`Values`).

    `planes` (3, 90, 90, 180) float64 are the numbers as the file has them: channel, theta_h, theta_d, phi_d.

    The database's own reader truncates angles to an entry's number, so that an entry stands for a cell. We take it
    for the value in the middle of its cell, and interpolate linearly between those of the neighbours that were
    measured.
    """

    isotropic = True

    def __init__(self, planes: NDArray[np.float64], name: str = "MERL file"):
        if planes.shape != (3, *SHAPE):
            raise SourceError(f"{name}: MERL planes have shape {(3, *SHAPE)}, got {planes.shape}")
        self.planes, self.name = planes, name
        measured = (planes >= 0).all(axis=0)
        # The fourth channel counts what was measured.
        cells = np.concatenate([planes * SCALE[:, None, None, None], np.ones((1, *SHAPE))]) * measured
        self._lookup = Lookup(np.moveaxis(cells, 0, -1), (False, False, True))

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr]; 0 where nothing around was measured."""
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
        """Reads a file; `SourceError` says what is wrong with it."""
        return Merl(read(path), Path(path).stem)

    def save(self, path: str | Path) -> None:
        """Writes a file, atomically."""
        write_bytes(path, np.array(SHAPE, "<i4").tobytes() + self.planes.astype("<f8").tobytes())

    @staticmethod
    def of(values: Values) -> Merl:
        """Any isotropic source in MERL's resolution, each entry the value at the middle of its cell.

        An entry is the mean of f over both orders of view and light, since the file cannot tell them apart: what is not
        reciprocal becomes so. Raises `SourceError` for anisotropic sources.
        """
        if not values.isotropic:
            raise SourceError(f"{values.name}: MERL files hold isotropic materials, this one is anisotropic")
        middles = [(np.arange(n) + 0.5) / n for n in SHAPE]
        grid = np.meshgrid(*middles, indexing="ij")
        h, d, p = (dr.auto.Float(x.ravel().astype(np.float32)) for x in grid)
        light, view = directions(h * h * (0.5 * math.pi), d * (0.5 * math.pi), p * math.pi)
        seen = (light.z > _MIN_COS) & (view.z > _MIN_COS)
        dr.eval(*light, *view)
        # One after the other: the same kernel, compiled once, with half the work.
        f = 0.5 * (_brdf(values, view, light) + _brdf(values, light, view))
        planes = f.reshape(3, *SHAPE) / SCALE[:, None, None, None]
        return Merl(np.where(seen.numpy().reshape(SHAPE), planes, _NO_DATA), values.name)


def read(path: str | Path) -> NDArray[np.float64]:
    """The planes (3, 90, 90, 180) of a file as it has them; `SourceError` says what is wrong with it."""
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
    """f (3, n) [1/sr], at least 0, since negative numbers mean something else in the file."""
    f = Color(*(ops.maximum(c, 0.0) for c in values.eval(wi, wo))) * (1.0 / ops.maximum(wo.z, _MIN_COS))
    dr.eval(*f)
    return np.stack([c.numpy() for c in f])


def _check_size(path: Path, content: bytes) -> None:
    """Refuses what is too short, too long, or of other dimensions."""
    if len(content) < 12:
        raise SourceError(f"{path}: {len(content)} bytes are no MERL file; copy it again")
    shape = tuple(np.frombuffer(content, "<i4", 3).tolist())
    if shape != SHAPE:
        raise SourceError(f"{path}: its dimensions are {shape}, those of a MERL file {SHAPE}")
    if len(content) != BYTES:
        what = "truncated" if len(content) < BYTES else "too long"
        raise SourceError(f"{path}: {what}, {len(content):,} bytes instead of {BYTES:,}; copy it again")
