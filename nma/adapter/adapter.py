"""The adapter maps a material's parameters and the view direction wi to the parameters of the target (paper eq. 4)."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nma import network, ops, sources
from nma.adapter import encoding, weights
from nma.errors import ParamError, WeightsError, shown
from nma.network import Layers
from nma.ops import Float, Vec3
from nma.params import ParamSpace
from nma.target.blend import Blend, bounded
from nma.target.brdf import Brdf
from nma.target.decode import (
    TargetParam,
    decode,
    from_numbers,
    needs_interface,
    numbers,
    output_size,
    params_from_json,
    params_to_json,
)
from nma.target.interface import Interface
from nma.target.plane import Plane
from nma.target.principled import DIALECT

# The name of the shipped adapter that is used if none is given.
DEFAULT_ADAPTER = "layered3-3x32"
_SHIPPED = files("nma.adapter").joinpath("trained")
# Two parameter values count as equal if their relative difference is less than SAME, because single precision rounds
# values.
SAME = 1e-5


def shipped() -> tuple[str, ...]:
    """The names of the adapters that come with the package."""
    return tuple(
        sorted(
            p.name.removesuffix(".safetensors")
            for p in _SHIPPED.iterdir()
            if p.name.endswith(".safetensors") and not p.name.startswith(".")
        )
    )


def weights_file(name_or_path: str | Path) -> Path:
    """The path of the weights file of a shipped adapter. A name that is not a shipped adapter's is returned as a
    path."""
    if str(name_or_path) in shipped():
        return Path(str(_SHIPPED.joinpath(f"{name_or_path}.safetensors")))
    return Path(name_or_path)


@dataclass(frozen=True)
class Adapter:
    """A trained network with its encoding and its target. `Adapter.load` reads a file, and `prepare` runs the network.

    With `bounded`, the blend is dimmed where it might reflect more light than it receives (`nma.target.bounded`).
    `interface` names the parameters of the interface under which the target lies (`ParamSpace.interface`), if the
    target does.
    """

    space: ParamSpace
    encoding: str
    layers: Layers
    instances: int
    directional: bool
    target: tuple[TargetParam, ...]
    training: dict[str, Any] = field(default_factory=dict)
    bounded: bool = False
    interface: tuple[str, str] | None = None

    @staticmethod
    def load(name_or_path: str | Path) -> Adapter:
        """Loads a shipped adapter by its name, or an adapter from a weights file. Raises `WeightsError`."""
        path = weights_file(name_or_path)
        if path.suffix != ".safetensors" and not os.path.exists(path):
            raise WeightsError(
                f"'{name_or_path}' is neither a file nor a shipped adapter ({', '.join(shipped())})"
            )
        header, layers = weights.read(path)
        try:
            target = params_from_json(header.target)
            encoding.get(header.encoding)
        except (WeightsError, TypeError) as e:
            raise WeightsError(f"{path}: {e}") from None
        adapter = Adapter(
            sources.space(header.class_name),
            header.encoding,
            layers,
            header.instances,
            header.directional,
            target,
            header.training,
            header.bounded,
            tuple(header.interface) or None,  # type: ignore[arg-type]  # `_check` requires two names
        )
        adapter._check(path, header.dialect)
        return adapter

    def save(self, path: str | Path, more: Mapping[str, NDArray] | None = None) -> None:
        """Writes a weights file, atomically. `more` contains further tensors to store in the same file."""
        header = weights.Header(
            class_name=self.space.name,
            parameters=weights.describe(self.space),
            encoding=self.encoding,
            hidden=[m.shape[0] for m, _ in self.layers[:-1]],
            instances=self.instances,
            directional=self.directional,
            reciprocal=self.reciprocal,
            bounded=self.bounded,
            dialect=DIALECT,
            target=params_to_json(self.target),
            interface=list(self.interface or ()),
            skip=network.skip_width(self.layers) > 0,
            training=self.training,
        )
        weights.write(path, header, self.layers, more)

    @property
    def variant(self) -> str:
        """The paper's name for this kind of adapter: single, omega_i, blended, or blended + omega_i."""
        names = ["blended"] if self.instances > 1 else []
        names += ["omega_i"] if self.directional else []
        return " + ".join(names) or "single"

    @property
    def reciprocal(self) -> bool:
        """Whether f(wi, wo) = f(wo, wi). The BRDF is reciprocal only if neither the target's parameters nor the factor
        `scale` depend on wi."""
        return not (self.directional or self.bounded)

    @property
    def size(self) -> int:
        """The count of numbers that describe the target (`numbers`): 23 for the paper's blend of two instances."""
        return self.outputs + len(self.interface or ())

    @property
    def outputs(self) -> int:
        """The count of the network's raw outputs. Of the numbers that describe the target, the network does not set
        those of the interface."""
        return output_size(self.instances, self.target)

    @property
    def anisotropic(self) -> bool:
        """Whether the adapter depends on the azimuth of the view direction."""
        return self.encoding in encoding.ANISOTROPIC

    @property
    def in_plane(self) -> bool:
        """Whether the lobes of the target are stretched along the plane of incidence (`nma.target.Plane`)."""
        return any(p.in_plane for p in self.target)

    @property
    def material(self) -> NDArray[np.float64] | None:
        """The parameters of the only material for which the adapter was trained, in the order of the material's class.
        The result is None if the adapter was trained for a whole class, or if its class has no parameters.
        """
        fitted = self.training.get("params")
        if not self.space.size or self.encoding not in encoding.SINGLE or fitted is None:
            return None
        return np.asarray(fitted, np.float64)

    def check_class(self, class_name: str, material: str, name: str) -> None:
        """Raises `ParamError` if a material has another class than this adapter. The error message contains `material`
        and `name`, the names of the material and of the adapter."""
        if class_name != self.space.name:
            raise ParamError(
                f"{material} is of class {class_name}, but the adapter {name} is for class {self.space.name}; choose "
                f"an adapter of class {class_name}: `nma train` makes one, and `nma fit` one for {material} alone"
            )

    def check(self, params: ArrayLike, clamp: bool = False) -> NDArray[np.float64]:
        """Checks the parameters `params` of n materials and returns them as float64 (n, columns).

        An adapter of a class accepts parameters within the training range; with `clamp`, other parameters are clamped
        to that range. An adapter of a single material accepts only the parameters of this material. Raises `ParamError`
        for parameters that are not accepted.
        """
        known = self.material
        if known is None:
            return self.space.check(
                params, "valid" if self.encoding in encoding.SINGLE else "training", clamp
            )
        given = self.space.check(params)
        names = [param.name for param in self.space.params for _ in range(param.size)]
        check_same(given, known, names, self.training.get("material", ""))
        return given

    def prepare(self, columns: Sequence[Float], wi: Vec3, active: Any = True) -> Brdf:
        """The material's BRDF seen from `wi`. `columns` has one Dr.Jit or NumPy array (n,) for each column of the
        class's parameter vector.

        `wi` is a unit vector of the local frame. Dr.Jit lanes that are not `active` get a meaningless BRDF.
        Raises `ParamError` for a cosine in place of `wi`, for a wrong number of columns, and for NumPy arrays of other
        shapes.
        """
        try:
            wi.z  # noqa: B018
        except (AttributeError, RuntimeError):  # Dr.Jit's arrays raise RuntimeError
            raise ParamError(
                "prepare takes the view direction wi as an nma.ops.Vec3, not a cosine; "
                "nma.ops.at_azimuth_0(cos_theta_i) converts a cosine"
            ) from None
        kind = ops.backend(*columns, wi.z)
        self._check_columns(columns, wi, kind)
        inputs = encoding.get(self.encoding)(columns, wi if self.directional else None)
        if kind == "drjit":
            raw = network.forward_lanes(self.layers, inputs, active)
        else:
            arrays = np.broadcast_arrays(wi.z, *inputs)[1:]
            raw = list(network.forward(self.layers, np.stack(arrays, axis=-1).astype(np.float32)).T)
        return self.decode(raw, wi, columns)

    def _check_columns(self, columns: Sequence[Float], wi: Vec3, kind: str) -> None:
        """Raises `ParamError` for arguments of `prepare` that do not fit together. `kind` is the array package.

        The network of a single material reads no columns, so the columns may be left out."""
        if len(columns) != self.space.size and (columns or self.encoding not in encoding.SINGLE):
            raise ParamError(
                f"the class {self.space.name} has {self.space.size} columns of parameters, got {len(columns)}; give "
                "one array (n,) for each column"
            )
        if kind != "numpy":
            return
        shapes = {np.shape(x) for x in (*columns, *wi)} - {(), (1,)}
        if len(shapes) > 1 or any(len(shape) > 1 for shape in shapes):
            raise ParamError(
                f"the columns and the components of wi have the shapes {', '.join(map(str, sorted(shapes)))}; give "
                "arrays (n,) of one length n"
            )

    def decode(self, raw: Sequence[Float], wi: Vec3, columns: Sequence[Float] = ()) -> Brdf:
        """The BRDF for the view direction `wi` from the raw outputs of the network, and from the `columns` of the
        material's parameters.

        `prepare` calls this method, and so does `nma.render.curves`, which runs the network itself. The method calls
        the function `nma.target.decode`, and then sets `Blend.scale` if the adapter is `bounded`.
        """
        return self._framed(decode(raw, self.instances, self.target, wi.z, self._interface_of(columns)), wi)

    def from_numbers(self, flat: Sequence[Float], wi: Vec3) -> Brdf:
        """The BRDF for the view direction `wi` from the flat list of numbers that describe the target. `flat` has one
        array for each number.

        `Curves.at` calls this method with interpolated numbers. The method calls the function
        `nma.target.from_numbers`, which returns a blend without `scale`, and then computes `Blend.scale` again if the
        adapter is `bounded`.
        """
        return self._framed(from_numbers(flat, self.target, self.interface is not None), wi)

    def _interface_of(self, columns: Sequence[Float]) -> Interface | None:
        """The interface above the target. A single material's interface is known without its `columns`."""
        if self.interface is None:
            return None
        known = self.material
        values = columns if len(columns) or known is None else known.tolist()
        return Interface(*(values[self.space.slices[name].start] for name in self.interface))

    def _framed(self, blend: Blend, wi: Vec3) -> Brdf:
        blend = bounded(blend, wi.z) if self.bounded else blend
        return Brdf(blend, Plane.of(wi) if self.in_plane else None)

    def numbers(self, params: ArrayLike, cos_theta_i: ArrayLike) -> NDArray[np.float32]:
        """The target's parameters (m, n, size) for m materials (m, columns) and n values of cos(theta_i) (n,).

        The method calls `prepare`, and then the function `nma.target.numbers`. Raises `ParamError` for anisotropic
        adapters, and for arrays of other shapes.
        """
        self.check_isotropic()
        p = np.atleast_2d(np.asarray(params, np.float64))
        mu = np.asarray(cos_theta_i, np.float64)
        if p.ndim != 2 or mu.ndim != 1:
            raise ParamError(
                f"`numbers` needs parameters (m, {self.space.size}) and cosines (n,), got arrays of the shapes "
                f"{p.shape} and {mu.shape}"
            )
        columns = [np.repeat(c, len(mu)) for c in p.T]
        flat = numbers(self.prepare(columns, ops.at_azimuth_0(np.tile(mu, len(p)))).blend, self.target)
        arrays = np.broadcast_arrays(*flat)
        return np.stack(arrays, axis=-1).reshape(len(p), len(mu), self.size).astype(np.float32)

    def check_isotropic(self) -> None:
        """Raises `ParamError` if the adapter needs the whole view direction, not only cos(theta_i)."""
        if self.anisotropic:
            raise ParamError(
                "an anisotropic adapter has no curves over cos(theta_i), because its BRDF also depends on the azimuth "
                "of the view direction; call `prepare` instead"
            )

    def _check(self, path: Path, dialect: str) -> None:
        """Raises `WeightsError` for a network that does not fit the file's metadata or this version's target."""
        self._check_material(path)
        if dialect != DIALECT:
            raise WeightsError(
                f"{path}: the adapter uses the Principled dialect {shown(dialect)}, but this version has '{DIALECT}'"
            )
        if self.instances < 1:
            raise WeightsError(
                f"{path}: the blend has {self.instances} instances, but needs at least 1; train again"
            )
        if self.anisotropic and (self.in_plane or not self.directional):
            raise WeightsError(
                f"{path}: the adapter is anisotropic, but its lobes stretch along the plane of incidence, or "
                "its network does not read the view direction; train again"
            )
        if self.in_plane and not self.directional:
            raise WeightsError(
                f"{path}: the lobes stretch along the plane of incidence, but the network does not read the view "
                "direction; train again"
            )
        self._check_interface(path)
        try:
            inputs = encoding.size(self.encoding, self.space, self.directional)
        except ValueError as e:
            raise WeightsError(f"{path}: {e}; train again") from None
        found = self.layers[0][0].shape[1], self.layers[-1][0].shape[0]
        if found != (inputs, self.outputs):
            raise WeightsError(
                f"{path}: the network maps {found[0]} inputs to {found[1]} outputs, "
                f"but the metadata says {inputs} to {self.outputs}; train again"
            )

    def _check_interface(self, path: Path) -> None:
        """Raises `WeightsError` if the parameters of the interface are not a width and an index of the class, or if the
        target has parameters that need an interface, but the file names none."""
        if self.interface is None:
            if needs_interface(self.target):
                raise WeightsError(
                    f"{path}: the target lies under an interface, which the file does not name; train again"
                )
            return
        lows = {param.name: param.low for param in self.space.params if param.size == 1}
        if self.material is not None:
            lows = {name: self.material[self.space.slices[name].start] for name in lows}
        least = [lows.get(name, 0.0) for name in self.interface]
        if not (len(least) == 2 and least[0] > 0.0 and least[1] >= 1.0):
            raise WeightsError(
                f"{path}: the interface needs two parameters of the class {self.space.name}, a width above 0 and an "
                f"index of at least 1, got {shown(', '.join(self.interface))}; train again"
            )

    def _check_material(self, path: Path) -> None:
        """Raises `WeightsError` if the file records a single material whose parameters are not valid for the class."""
        try:
            known = self.material
            recorded = self.training.get("params") or ()
            if known is not None and any(type(x) not in (int, float) for x in recorded):
                raise ParamError("the parameters are not a list of numbers")
            if known is not None and self.space.check(known).shape[1:] != known.shape:
                raise ParamError(f"the parameters have the shape {known.shape}")
        except (ValueError, TypeError) as e:
            raise WeightsError(
                f"{path}: the recorded material does not fit the class {self.space.name} ({e}); fit the adapter again"
            ) from None


def check_same(given: NDArray, known: NDArray, names: Sequence[str], material: str = "") -> None:
    """Raises `ParamError` if a row of `given` (n, columns) differs from the parameters `known` of a single material.

    `names` has the name of each column's parameter, and `material` is the name of the single material.
    """
    other = ~np.isclose(given, known, rtol=SAME)
    if not other.any():
        return
    row, column = np.argwhere(other)[0]
    columns = [k for k, name in enumerate(names) if name == names[column]]
    where = f"row {row}: " if len(given) > 1 else ""
    raise ParamError(
        f"{where}the adapter was trained for a single material, {material}{', ' if material else ''}whose "
        f"{names[column]} is {_plain(known[columns])}, not {_plain(given[row, columns])}; fit another adapter "
        "to your material, or use an adapter of its class"
    )


def _plain(numbers: NDArray) -> str:
    return ", ".join(f"{x:.6g}" for x in numbers)
