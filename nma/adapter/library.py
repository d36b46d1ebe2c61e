"""A library: many materials in one small network, where each material is a point in a latent space (paper Fig. 12).

A library is an adapter of the class `library`, whose only parameter is the `code` of a material. The library also
stores the names and codes of the materials on which it was trained. Codes can be mixed, and a code for a new material
can be found by training.

    library = Library.load("library.safetensors")
    code = library.mix(["gold-metallic-paint", "blue-rubber"], [0.7, 0.3])
    library.material(code).save("bluish-gold.safetensors")       # an ordinary adapter of that one material
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import safe_open

from nma import network
from nma.adapter.adapter import Adapter, weights_file
from nma.errors import ParamError, WeightsError, hint
from nma.params import LIBRARY, MEASURED

CODES = "codes"


@dataclass(frozen=True)
class Library:
    """An adapter of the class `library`, with the `names` of its materials and their `codes` (n, 32), in the same
    order."""

    adapter: Adapter
    names: tuple[str, ...]
    codes: NDArray[np.float32]

    def __post_init__(self) -> None:
        shape = (len(self.names), LIBRARY.size)
        if self.adapter.space != LIBRARY or self.adapter.encoding != "raw":
            raise WeightsError(
                f"a library needs an adapter of class {LIBRARY.name} with encoding 'raw'; the given adapter has class "
                f"{self.adapter.space.name} and encoding {self.adapter.encoding}"
            )
        if not self.names or len(set(self.names)) < len(self.names) or self.codes.shape != shape:
            raise WeightsError(
                f"{len(self.names)} names do not match codes of shape {self.codes.shape}, or a name occurs twice"
            )

    @staticmethod
    def load(path: str | Path) -> Library:
        """Reads the weights file of a library. Raises `WeightsError`, which says what is wrong with the file."""
        path = weights_file(path)
        if not path.is_file():
            raise WeightsError(f"{path}: no such library; `nma train-library` makes one")
        adapter = Adapter.load(path)
        names = adapter.training.get("names")
        with safe_open(path, framework="numpy") as f:
            codes = f.get_tensor(CODES) if CODES in f.keys() else None  # noqa: SIM118
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            names = None
        if adapter.space != LIBRARY or codes is None or names is None:
            raise WeightsError(
                f"{path}: an adapter of class {adapter.space.name}, not a library; `nma train-library` makes libraries"
            )
        try:
            library = Library(adapter, tuple(names), codes)
            LIBRARY.check(codes)
        except (WeightsError, ParamError) as e:
            raise WeightsError(f"{path}: {e}; copy the file again, or train again") from None
        return library

    def save(self, path: str | Path) -> None:
        """Writes a weights file, atomically. `Adapter.load` and the C++ runtime also read the files of libraries."""
        training = {**self.adapter.training, "names": list(self.names)}
        replace(self.adapter, training=training).save(path, {CODES: self.codes})

    @property
    def parameters(self) -> int:
        """The number of trained values, which are the codes and the network's weights and biases."""
        return self.codes.size + network.parameters(self.adapter.layers)

    def code(self, name: str) -> NDArray[np.float32]:
        """The code (32,) of a material. Raises `ParamError` if the library has no material of that name."""
        if name not in self.names:
            raise ParamError(
                f"no material '{name}' among the library's {len(self.names)} materials; {hint(name, self.names)}"
            )
        return self.codes[self.names.index(name)]

    def mix(self, names: Sequence[str], weights: ArrayLike) -> NDArray[np.float32]:
        """The mean (32,) of the codes of the materials `names`, weighted by `weights`, which must be at least 0."""
        shares = np.asarray(weights, np.float64)
        if shares.shape != (len(names),) or not (np.isfinite(shares).all() and (shares >= 0).all()):
            raise ParamError(
                f"{len(names)} materials need {len(names)} weights of at least 0, got {shares.tolist()}"
            )
        if not shares.sum() > 0:
            raise ParamError("the weights of a mixture are all 0; make at least one weight positive")
        codes = np.stack([self.code(name) for name in names])
        return (shares / shares.sum() @ codes).astype(np.float32)

    def material(self, code: ArrayLike, name: str | None = None) -> Adapter:
        """An adapter of a single material: the material that the code describes. The adapter's network reads only
        cos(theta_i), because the contribution of the code to the first layer is added to the biases of that layer."""
        code = LIBRARY.check(code)
        if len(code) != 1:
            raise ParamError(f"`material` takes one code; got {len(code)} codes")
        (matrix, bias), *rest = self.adapter.layers
        bias = bias + matrix[:, : LIBRARY.size] @ code[0]
        if self.adapter.directional:
            # The encoding "direction" is 2 cos(theta_i) - 1.
            column = 0.5 * matrix[:, LIBRARY.size :]
            bias = bias + column[:, 0]
        else:
            column = np.zeros((len(bias), 1))
        first = column.astype(np.float32), bias.astype(np.float32)
        training = {"library": self.adapter.training.get("data"), "code": code[0].tolist()}
        training |= {"material": name} if name else {}
        return replace(
            self.adapter, space=MEASURED, encoding="direction", layers=[first, *rest], training=training
        )

    def add(self, name: str, code: ArrayLike) -> Library:
        """A copy of the library with one more material. Raises `ParamError` if the name is taken."""
        if name in self.names:
            raise ParamError(f"the library already has a material '{name}'; choose another name")
        codes = np.concatenate([self.codes, LIBRARY.check(code).astype(np.float32)])
        return replace(self, names=(*self.names, name), codes=codes)
