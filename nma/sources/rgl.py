"""The `.bsdf` files of RGL's material database.

This module reads and checks the files, and Mitsuba's BSDF `measured` evaluates them. The database is that of Dupuy and
Jakob 2018, "An Adaptive Parameterization for Efficient Material Acquisition and Rendering". A file has a header and a
set of named arrays, called fields. The header has a magic string, the version and the number of fields. For each field
the header has the name, rank, type, offset and shape. Mitsuba maps the file into memory without comparing the offsets
with the file's size, so Mitsuba would read past the end of a truncated file. To prevent a read past the end of a file,
this module checks the file before Mitsuba reads it.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nma.errors import SourceError
from nma.sources import files
from nma.sources.files import Measurements

_MAGIC = b"tensor_file\0"
# NumPy types by their code in the file, for all codes that occur in files of materials.
_TYPES = {
    1: "<u1",
    2: "<i1",
    3: "<u2",
    4: "<i2",
    5: "<u4",
    6: "<i4",
    7: "<u8",
    8: "<i8",
    10: "<f4",
    11: "<f8",
}

# The fields of an RGB material, and the rank (number of dimensions) of each field. `rgb` has the shape (phi_i, theta_i,
# 3, y, x).
_FIELDS = {
    "description": 1,
    "phi_i": 1,
    "theta_i": 1,
    "sigma": 2,
    "ndf": 2,
    "vndf": 4,
    "luminance": 4,
    "rgb": 5,
    "jacobian": 1,
}


def read(path: str | Path) -> dict[str, NDArray]:
    """Reads the arrays of an RGB material, by name. Raises `SourceError` with the fault if the file is damaged."""
    path = Path(path)
    fields = read_tensors(path)
    if "rgb" not in fields and "spectra" in fields:
        raise SourceError(f"{path}: holds spectra; choose the material's file whose name ends in _rgb.bsdf")
    for name, rank in _FIELDS.items():
        if name not in fields:
            raise SourceError(f"{path}: field '{name}' is missing; copy the file again")
        if fields[name].ndim != rank:
            raise SourceError(
                f"{path}: field '{name}' has shape {fields[name].shape}, but must have {rank} dimensions"
            )
        if fields[name].dtype.kind == "f" and not np.isfinite(fields[name]).all():
            raise SourceError(f"{path}: field '{name}' has values that are not finite; copy the file again")
    _check_shapes(path, fields)
    for name, low, high in (("phi_i", -2 * math.pi, 2 * math.pi), ("theta_i", 0.0, math.pi / 2)):
        _check_grid(path, name, fields[name], low, high)
    return fields


def read_tensors(path: str | Path) -> dict[str, NDArray]:
    """Reads all arrays of a tensor file, by name."""
    path = Path(path)
    content = files.content(path, "RGL")
    if content[:12] != _MAGIC:
        what = "not a tensor file" if content else "empty"
        raise SourceError(f"{path}: {what}; RGL's materials are files that end in _rgb.bsdf")
    try:
        return _parse(content)
    except (struct.error, ValueError) as e:
        raise SourceError(f"{path}: truncated or damaged ({e}); copy the file again") from None


def _parse(content: bytes) -> dict[str, NDArray]:
    """The arrays in the `content` of a tensor file, by name."""
    major, minor, count = struct.unpack_from("<BBI", content, 12)
    if (major, minor) != (1, 0):
        raise ValueError(f"unknown version {major}.{minor}")
    at, fields = 18, {}
    for _ in range(count):
        (length,) = struct.unpack_from("<H", content, at)
        name = content[at + 2 : at + 2 + length].decode()
        rank, kind, offset = struct.unpack_from("<HBQ", content, at + 2 + length)
        if kind not in _TYPES:
            raise ValueError(f"field '{name}' has the unknown type {kind}")
        shape = struct.unpack_from(f"<{rank}Q", content, at + 13 + length)
        at += 13 + length + 8 * rank
        fields[name] = np.frombuffer(content, _TYPES[kind], math.prod(shape), offset).reshape(shape)
    return fields


def _check_shapes(path: Path, fields: dict[str, NDArray]) -> None:
    """Raises `SourceError` if the sizes of the fields do not match."""
    incident = (len(fields["phi_i"]), len(fields["theta_i"]))
    expected = {
        "vndf": (*incident, *fields["vndf"].shape[2:]),
        "luminance": (*incident, *fields["rgb"].shape[3:]),
        "rgb": (*incident, 3, *fields["rgb"].shape[3:]),
        "jacobian": (1,),
    }
    for name, shape in expected.items():
        if fields[name].shape != shape:
            raise SourceError(
                f"{path}: field '{name}' has shape {fields[name].shape}, but must have {shape}; copy the file again"
            )


def _check_grid(path: Path, name: str, angles: NDArray, low: float, high: float) -> None:
    """Raises `SourceError` if the angles of incidence do not ascend, or are not in `low` .. `high`.

    Mitsuba finds an angle by bisection, which needs ascending angles.
    """
    slack = 1e-4
    if not (
        len(angles)
        and (np.diff(angles) > 0).all()
        and low - slack <= angles[0]
        and angles[-1] <= high + slack
    ):
        raise SourceError(
            f"{path}: field '{name}' does not ascend within {low:.4g} .. {high:.4g}; copy the file again"
        )


RGL = Measurements(
    "RGL",
    "measurement: isotropic and anisotropic materials",
    "https://rgl.epfl.ch/materials",
    "Dupuy and Jakob 2018, An Adaptive Parameterization for Efficient Material Acquisition and Rendering",
    "not stated in the files; read the terms on that page before you pass a file on",
    "one file NAME_rgb.bsdf per material; the file of an isotropic material has about 0.5 to 1 MB",
    {
        "cc_ibiza_sunset_rgb.bsdf": (
            658_952,
            "ce356ec33ac086aa19eb534dbfc21e08c793790c299e2cab660705d40c665f0a",
        ),
        "cg_sunflower_rgb.bsdf": (
            1_055_240,
            "ce817d04568c39284908ce89b12989e68d6407ee48fb44f6cc644e7bfdf7c840",
        ),
        "colodur_napoli_4f_rgb.bsdf": (
            658_960,
            "8a8d491956c36ab75c1676ee2acc34c550215a3e771ef5b7e3046654359000c1",
        ),
        "paper_white_rgb.bsdf": (
            658_928,
            "9d641fbb56358275509b2b1053d1002313e2dabc7b3ec202eb5c5a6943f7b70e",
        ),
    },
)
