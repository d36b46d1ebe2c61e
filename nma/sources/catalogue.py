"""The public data sets that sources read: their origins, their licences, and a check of a user's copy.

Nothing is downloaded. A data set's licence decides what a user may do with its files and with everything made from
them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nma.errors import SourceError
from nma.files import arrays
from nma.sources import merl, nbrdf, rgl


@dataclass(frozen=True)
class DataSet:
    """A data set.

    `kind` says whether it is a measurement or a neural reconstruction of a measurement. `files` describes the files of
    a complete copy. `known` gives the size in bytes and the SHA-256 of a file by its name; files that we had no copy of
    are not in it.
    """

    name: str
    kind: str
    origin: str
    paper: str
    licence: str
    files: str
    known: dict[str, tuple[int, str]]


DATASETS = (
    DataSet(
        "MERL",
        "measurement: 100 isotropic materials",
        "https://www.merl.com/research/downloads/BRDF",
        "Matusik et al. 2003, A Data-Driven Reflectance Model",
        "CC-BY-SA-4.0",
        f"100 files NAME.binary of {merl.BYTES:,} bytes each",
        {},
    ),
    DataSet(
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
    ),
    DataSet(
        "NBRDF-MERL",
        "neural reconstruction: a network for each of MERL's 100 materials",
        "https://github.com/asztr/Neural-BRDF (data/merl_nbrdf.zip), gathered in one file",
        "Sztrajman et al. 2021, Neural BRDF Representation and Importance Sampling",
        "MIT",
        "merl_nbrdf_weights.npz with names (100,) and weights (100, 675)",
        {
            "merl_nbrdf_weights.npz": (
                256_573,
                "b6441e3c3168f62fd0d331da3cf66a692602dda4159119c2775ed8e904a00f6a",
            )
        },
    ),
    DataSet(
        "NBRDF-RGL",
        "neural reconstruction: a network for each of 51 isotropic RGL materials",
        "https://github.com/asztr/Neural-BRDF (data/rgl-isotropic_nbrdf.zip), gathered in one file",
        "Sztrajman et al. 2021, Neural BRDF Representation and Importance Sampling",
        "MIT",
        "rgl-isotropic_nbrdf_weights.npz with names (51,) and weights (51, 675)",
        {
            "rgl-isotropic_nbrdf_weights.npz": (
                131_114,
                "7cf51ffc6893b180bb28253d548df847eda0b968d7a90568928bfb71c324cae4",
            )
        },
    ),
)


@dataclass(frozen=True)
class Finding:
    """What `check` found out about one file: its data set, whether the file is sound (`ok`), and the reason."""

    path: Path
    dataset: str
    ok: bool
    note: str


def check(path: str | Path) -> Iterator[Finding]:
    """Checks a file, or every file in a folder and its subfolders that belongs to a data set.

    The check compares the file's size and checksum with the known ones. It also reads the file, to see whether its
    structure and its values make sense. Raises `SourceError` if there is no file to check.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise SourceError(f"{path}: no such file or folder")
    if path.is_file():
        yield _check_file(path)
        return
    files = sorted(p for p in path.rglob("*") if p.is_file() and _belongs(p))
    if not files:
        raise SourceError(f"{path}: holds no file of a known data set ({', '.join(sorted(_READERS))})")
    for file in files:
        yield _check_file(file)


def _check_file(path: Path) -> Finding:
    """Checks one file."""
    reader = _READERS.get(path.suffix)
    if reader is None:
        return Finding(path, "", False, f"no file of a known data set ({', '.join(sorted(_READERS))})")
    size, checksum = _known(path.name)
    label = _LABELS[path.suffix]
    found = path.stat().st_size
    if size and found != size:
        return Finding(path, label, False, f"{found:,} bytes instead of {size:,}; copy it again")
    try:
        label = reader(path)
    except SourceError as e:
        return Finding(path, label, False, str(e).removeprefix(f"{path}: "))
    if not checksum:
        return Finding(path, label, True, "sound; its checksum is not known here")
    if hashlib.sha256(path.read_bytes()).hexdigest() != checksum:
        return Finding(path, label, False, "sound, but not the original file: its SHA-256 differs")
    return Finding(path, label, True, "sound; its SHA-256 is that of the original")


def _read_merl(path: Path) -> str:
    merl.read(path)
    return "MERL"


def _read_rgl(path: Path) -> str:
    rgl.read(path)
    return "RGL"


def _read_nbrdf(path: Path) -> str:
    return nbrdf.kind(nbrdf.read(path)[0])


# The function that reads a file, by the file's extension. It returns the name of the file's data set.
_READERS = {".binary": _read_merl, ".bsdf": _read_rgl, ".npz": _read_nbrdf}
# The data set's name for a file that cannot be read, by extension.
_LABELS = {".binary": "MERL", ".bsdf": "RGL", ".npz": "NBRDF"}


def _belongs(path: Path) -> bool:
    """Whether a file in a folder looks like part of a data set. An `.npz` file may hold something else."""
    if path.suffix != ".npz":
        return path.suffix in _READERS
    try:
        with arrays(path) as f:
            return "weights" in f or path.name in _NAMES
    except Exception:  # zipfile raises its own exceptions for damaged archives
        return path.name in _NAMES


def _known(name: str) -> tuple[int, str]:
    """Size and checksum of the file `name`, or 0 and "" if they are not known."""
    return next((d.known[name] for d in DATASETS if name in d.known), (0, ""))


_NAMES = {name for dataset in DATASETS for name in dataset.known}
