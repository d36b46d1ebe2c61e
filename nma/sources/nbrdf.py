"""Neural BRDFs: one small network per material that maps a pair of directions to the BRDF's value.

The networks are those of Sztrajman et al. 2021, "Neural BRDF Representation and Importance Sampling". The networks are
reconstructions, not measurements. We call the networks fitted to MERL's materials NBRDF-MERL, and the networks fitted
to RGL's materials NBRDF-RGL.

A weights file (`.npz`) has `names` (n,) and `weights` (n, 675). A row of weights has the matrices and biases of the
network 6 -> 21 -> 21 -> 3 with ReLU, in the order k1 (6, 21), b1, k2 (21, 21), b2, k3 (21, 3), b3. A layer maps x to x
@ k + b, where k is the matrix and b the bias.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nma import network
from nma.errors import SourceError, hint
from nma.files import arrays
from nma.jit import dr
from nma.ops import Color, Vec3
from nma.sources.files import Format, Measurements
from nma.sources.half_difference import half_difference

SIZES = (6, 21, 21, 3)
WEIGHTS = sum((fan_in + 1) * fan_out for fan_in, fan_out in zip(SIZES[:-1], SIZES[1:], strict=True))

# There are two published sets of networks. Each key is a material that only one of the sets contains, and its value is
# the name of that set. If a weights file contains the material, its networks are of that set.
_FITTED_TO = {"alum-bronze": "NBRDF-MERL", "cc_ibiza_sunset_rgb": "NBRDF-RGL"}


class Nbrdf:
    """One material's network (`Values`).

    The network learned reciprocity and symmetry from data, so it has these properties only approximately.
    """

    isotropic = True

    def __init__(self, weights: NDArray, name: str = "NBRDF"):
        """`weights` (675,) are in the order of the file. Raises `SourceError` for weights of another shape."""
        if weights.shape != (WEIGHTS,):
            raise SourceError(f"{name}: an NBRDF network has {WEIGHTS} weights, got {weights.shape}")
        self.name = name
        self._layers: network.Layers = []
        start = 0
        for fan_in, fan_out in zip(SIZES[:-1], SIZES[1:], strict=True):
            matrix = weights[start : start + fan_in * fan_out].reshape(fan_in, fan_out)
            start += fan_in * fan_out
            self._layers.append((matrix.T, weights[start : start + fan_out]))
            start += fan_out

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f cos(theta_o) [1/sr]. The network maps the half vector and the difference vector to log(1 + f)."""
        h, d = half_difference(wo, wi)
        logs = network.forward_lanes(self._layers, [*h, *d])
        cosine = dr.select((wi.z > 0) & (wo.z > 0), wo.z, 0.0)
        return Color(*(dr.maximum(dr.exp(y) - 1.0, 0.0) * cosine for y in logs))

    @staticmethod
    def load(path: str | Path, material: str) -> Nbrdf:
        """Reads the network of one material. Raises `SourceError` if the file is damaged or has no such material."""
        names, weights = read(path)
        if material not in names:
            raise SourceError(
                f"{path}: no material '{material}' among its {len(names)} materials; {hint(material, names)}"
            )
        return Nbrdf(weights[names.index(material)], f"{kind(names)} {material}")


def kind(names: list[str]) -> str:
    """NBRDF-MERL or NBRDF-RGL, recognised by the materials' names, or NBRDF for networks of other materials."""
    return next((label for known, label in _FITTED_TO.items() if known in names), "NBRDF")


def read(path: str | Path) -> tuple[list[str], NDArray[np.float32]]:
    """Reads names (n,) and weights (n, 675) from a weights file.

    Raises `SourceError` if the file is missing or damaged.
    """
    path = Path(path)
    try:
        with arrays(path) as f:
            names, weights = f["names"], f["weights"]
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; `nma data` says where to get NBRDF networks") from None
    except Exception as e:  # zipfile and zlib have their own error types, so all are caught
        raise SourceError(
            f"{path}: not a weights file of NBRDF networks (.npz with names and weights): {e}"
        ) from None
    if names.dtype.kind != "U" or names.ndim != 1 or weights.shape != (len(names), WEIGHTS):
        raise SourceError(
            f"{path}: names {names.shape} and weights {weights.shape} are not (n,) and (n, {WEIGHTS}); "
            "copy the file again"
        )
    if weights.dtype.kind != "f" or not np.isfinite(weights).all():
        raise SourceError(f"{path}: some weights are not finite numbers; copy the file again")
    return names.tolist(), weights.astype(np.float32)


def _names(path: Path) -> list[str]:
    return read(path)[0]


def _identify(path: Path) -> str:
    return kind(_names(path))


def _claims(path: Path) -> bool:
    """Whether an `.npz` file is a weights file. Other `.npz` files, such as tables, have no array `weights`."""
    try:
        with arrays(path) as f:
            return "weights" in f
    except Exception:  # zipfile has its own error types, so all are caught
        return False


MERL = Measurements(
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
)
RGL = Measurements(
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
)
FORMAT = Format("NBRDF", Nbrdf.load, _names, (MERL, RGL), _identify, _claims)
