"""Calls the C++ runtime from Python for many queries at once. The first call compiles the runtime as a shared library.

    runtime = nma.native.runtime.Runtime("layered3-3x32")
    brdfs = runtime.prepare(params, wi)                        # (n, columns of the class), (n, 3)
    value, pdf = runtime.eval_pdf(brdfs, wi, wo)               # (n, 3) [1/sr], (n,) [1/sr]
    wo, value, pdf = runtime.sample(brdfs, wi, u)

Directions are unit vectors (n, 3) in the local frame, with z up. `wi` points towards the viewer. Call `eval_pdf` and
`sample` with the same `wi` as `prepare`. If the adapter is isotropic, the azimuth of `wi` may differ from that in
`prepare`, but the cosine with the normal must be the same. All arrays are converted to float32.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nma.adapter import weights_file
from nma.adapter.adapter import check_same
from nma.errors import ParamError, WeightsError
from nma.native import build
from nma.params import Bounds

Array = NDArray[np.float32]
# The order is that of the enum of instruction sets in nma_c.h, so an index in this tuple is a value of the enum.
INSTRUCTION_SETS = ("fastest", "portable", "neon", "avx2", "avx512", "avx512_bf16")
_COMPACT = 0x100
# The alignment of a BRDF in memory [bytes].
_ALIGNMENT = 16
_MESSAGE = 500


def available() -> tuple[str, ...]:
    """The names of the instruction sets that this CPU has."""
    return tuple(name for k, name in enumerate(INSTRUCTION_SETS[1:], 1) if _interface().nma_supported(k))


class Runtime:
    """An adapter, loaded into the C++ runtime.

    Args:
        adapter: the name of a shipped adapter, or a weights file.
        instruction_set: one of `INSTRUCTION_SETS`. If the CPU does not have the instruction set, "portable" replaces
            it. All instruction sets except "avx512_bf16" compute in float32.
        compact: round the weights to bfloat16. Rounded weights save time, and `runtime/README.md` tells how much
            accuracy they cost.

    Attributes:
        parameters: the number of columns of `params`.
        names: for each column, the name of its parameter.
        low, high: the training range of each column.
        material: the parameters of the single material that the adapter was fitted to, or None if it was trained on a
            class.
        size: the number of the network's outputs.
        instruction_set: the instruction set in use.
        anisotropic: whether the BRDF depends on the azimuth of `wi`.

    Raises:
        WeightsError: the file is missing or damaged.
        ParamError: the instruction set is unknown.
        MissingDependencyError, BuildError: the shared library cannot be compiled on this machine.
    """

    def __init__(self, adapter: str | Path, instruction_set: str = "fastest", *, compact: bool = False):
        if instruction_set not in INSTRUCTION_SETS:
            raise ParamError(
                f"unknown instruction set {instruction_set!r}; known are {', '.join(INSTRUCTION_SETS)}"
            )
        self._c = _interface()
        number = INSTRUCTION_SETS.index(instruction_set) + (_COMPACT if compact else 0)
        message = ctypes.create_string_buffer(_MESSAGE)
        handle = self._c.nma_load(str(weights_file(adapter)).encode(), number, message, _MESSAGE)
        if not handle:
            raise WeightsError(message.value.decode())
        self._handle = ctypes.c_void_p(handle)
        # The number of floats in each row of the array that `prepare` returns.
        self._brdf = self._c.nma_brdf_size() // np.dtype(np.float32).itemsize
        self.parameters = self._c.nma_parameter_count(self._handle)
        self.names = [self._name(k) for k in range(self.parameters)]
        self.low, self.high = self._ranges()
        self.material = self._single_material()
        self.size = self._c.nma_output_count(self._handle)
        self.anisotropic = bool(self._c.nma_anisotropic(self._handle))
        self.instruction_set = INSTRUCTION_SETS[self._c.nma_instruction_set(self._handle)]

    def __del__(self) -> None:
        if handle := getattr(self, "_handle", None):
            self._c.nma_free(handle)

    def outputs(self, params: ArrayLike, wi: ArrayLike, *, clamp: bool = False) -> Array:
        """The raw outputs (n, size) of the network. This method has the arguments and the errors of `prepare`."""
        return self._many("nma_outputs", self._checked(params, clamp), wi, self.size)

    def prepare(self, params: ArrayLike, wi: ArrayLike, *, clamp: bool = False) -> Array:
        """Runs the network and returns n BRDFs for `eval_pdf` and `sample`, as an array of opaque rows.

        Args:
            params: the parameters (n, parameters) of n materials, within the training range.
            wi: view directions (n, 3), unit vectors above the horizon. For isotropic adapters, `wi` may instead be the
                cosines (n,) of the view directions with the normal, in 0..1.
            clamp: clamp parameters to the training range instead of raising an error.

        Raises:
            ParamError: a parameter is outside the training range or not finite, an array has the wrong shape or length,
                or `wi` contains cosines although the adapter is anisotropic.
        """
        return self._many("nma_prepare", self._checked(params, clamp), wi, self._brdf)

    def eval(self, brdfs: Array, wi: ArrayLike, wo: ArrayLike) -> Array:
        """The values f cos(theta_o) [1/sr], (n, 3). A value is 0 if `wo` is below the horizon."""
        return self.eval_pdf(brdfs, wi, wo)[0]

    def pdf(self, brdfs: Array, wi: ArrayLike, wo: ArrayLike) -> Array:
        """The densities [1/sr] with which `sample` draws `wo`, (n,). A density is 0 if `wo` is below the horizon."""
        return self.eval_pdf(brdfs, wi, wo)[1]

    def eval_pdf(self, brdfs: Array, wi: ArrayLike, wo: ArrayLike) -> tuple[Array, Array]:
        """The results of `eval` (n, 3) and `pdf` (n,). The call takes no longer than `eval` alone or `pdf` alone."""
        found = self._each("nma_eval_pdf", brdfs, wi, 4, wo)
        return found[:, :3], found[:, 3]

    def sample(self, brdfs: Array, wi: ArrayLike, u: ArrayLike) -> tuple[Array, Array, Array]:
        """Draws directions `wo` from uniform numbers `u` (n, 3) in [0, 1).

        Returns (wo (n, 3), value (n, 3), pdf (n,)). The values and the densities equal those of `eval_pdf`. A density
        of 0 marks an invalid sample.
        """
        found = self._each("nma_sample", brdfs, wi, 7, u)
        return found[:, :3], found[:, 3:6], found[:, 6]

    def albedo(self, brdfs: Array, wi: ArrayLike) -> Array:
        """Directional albedos (n, 3) at `wi`, at most 1.

        Each albedo is a mean over 128 fixed samples, so equal arguments give equal albedos.
        """
        return self._each("nma_albedo", brdfs, wi, 3)

    def _name(self, column: int) -> str:
        return self._c.nma_parameter_name(self._handle, column).decode()

    def _ranges(self) -> tuple[Array, Array]:
        """Two arrays (parameters,): the lower ends and the upper ends of the columns' training ranges."""
        ends = np.empty((self.parameters, 2), np.float32)
        for column, pair in enumerate(ends):
            self._c.nma_parameter_range(self._handle, column, _pointer(pair))
        return ends[:, 0], ends[:, 1]

    def _single_material(self) -> Array | None:
        numbers = np.empty(self.parameters, np.float32)
        return numbers if self._c.nma_single_material(self._handle, _pointer(numbers)) else None

    def _checked(self, params: ArrayLike, clamp: bool) -> Array:
        """`params` as float32 rows. Raises `ParamError` if a parameter is outside the training range. If the adapter
        was fitted to a single material, raises `ParamError` if a parameter differs from that material."""
        rows = _rows("params", params, self.parameters)
        if self.material is not None:
            check_same(rows, self.material, self.names)
            return rows
        allowed = Bounds(self.low, self.high)
        bad = allowed.bad(rows, clamp)
        if bad.any():
            row, column = np.argwhere(bad)[0]
            one = Bounds(self.low[column], self.high[column])
            raise ParamError(f"row {row}: {one.refusal(self.names[column], rows[row, column], 'training')}")
        return allowed.moved(rows) if clamp else rows

    def _many(self, name: str, rows: Array, wi: ArrayLike, width: int) -> Array:
        views = self._views(wi)
        kind, suffix = ("cosines", "_many") if views.ndim == 1 else ("directions", "_direction_many")
        if len(rows) != len(views):
            raise ParamError(f"params has {len(rows)} rows, but wi has {len(views)} {kind}")
        found = np.empty((len(rows), width), np.float32)
        call = getattr(self._c, name + suffix)
        call(self._handle, len(rows), *(_pointer(a) for a in (rows, views, found)))
        return found

    def _views(self, wi: ArrayLike) -> Array:
        """`wi` as float32: directions (n, 3), or cosines (n,) with the normal if the adapter is isotropic."""
        shape = np.shape(wi)
        if len(shape) > 1:
            return _rows("wi", wi, 3)
        if self.anisotropic:
            raise ParamError(
                f"an anisotropic adapter needs directions: give wi of shape (n, 3), not cosines {shape}"
            )
        return _rows("wi", wi)

    def _each(self, name: str, brdfs: Array, wi: ArrayLike, width: int, *more: ArrayLike) -> Array:
        arrays = [_rows("brdfs", brdfs, self._brdf), _rows("wi", wi, 3)]
        arrays += [_rows("wo or u", rows, 3) for rows in more]
        if len({len(array) for array in arrays}) > 1:
            raise ParamError(f"arrays of different lengths: {', '.join(str(len(a)) for a in arrays)}")
        found = np.empty((len(arrays[0]), width), np.float32)
        getattr(self._c, name)(len(found), *(_pointer(a) for a in (*arrays, found)))
        return found


def _rows(name: str, values: ArrayLike, *row: int) -> Array:
    """`values` as a contiguous, aligned float32 array (n, *row). Raises `ParamError` if `values` has another shape."""
    array = np.ascontiguousarray(values, np.float32)
    if array.shape[1:] != row:
        wanted = "(n,)" if not row else f"(n, {row[0]})"
        raise ParamError(f"{name} must have shape {wanted}, got {array.shape}")
    return array if array.ctypes.data % _ALIGNMENT == 0 else array.copy()


def _pointer(array: Array) -> Any:
    return array.ctypes.data_as(ctypes.c_void_p)


@cache
def _interface() -> ctypes.CDLL:
    loaded = ctypes.CDLL(str(build.shared_library()))
    loaded.nma_load.restype = ctypes.c_void_p
    loaded.nma_load.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t]
    loaded.nma_parameter_name.restype = ctypes.c_char_p
    loaded.nma_brdf_size.restype = ctypes.c_size_t
    return loaded
