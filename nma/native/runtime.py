"""The C++ runtime from Python, for many queries at once: a compiled library, made when it is first wanted.

    runtime = nma.native.runtime.Runtime("layered3-5x64")
    brdfs = runtime.prepare(params, wi)                        # (n, 13) in the training range, (n, 3)
    value, pdf = runtime.eval_pdf(brdfs, wi, wo)               # (n, 3) [1/sr], (n,) [1/sr]
    wo, value, pdf = runtime.sample(brdfs, wi, u)

Directions are unit vectors (n, 3) in the local frame, z up, `wi` towards the viewer, of the cosine that the BRDF was
prepared for; of anisotropic adapters, of the same direction. All arrays become float32.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nma.adapter import weights_file
from nma.adapter.adapter import SAME
from nma.errors import ParamError, WeightsError
from nma.native import build
from nma.params import Bounds

Array = NDArray[np.float32]
# As nma_c.h numbers them.
INSTRUCTION_SETS = ("fastest", "portable", "neon", "avx2", "avx512", "avx512_bf16")
_COMPACT = 0x100
# Bytes: the boundary that a BRDF lies on.
_ALIGNMENT = 16
_MESSAGE = 500


def available() -> tuple[str, ...]:
    """The instruction sets of this CPU."""
    return tuple(name for k, name in enumerate(INSTRUCTION_SETS[1:], 1) if _library().nma_supported(k))


class Runtime:
    """A loaded adapter.

    Args:
        adapter: a shipped adapter's name, or a weights file.
        instruction_set: one of `INSTRUCTION_SETS`; one that the CPU lacks becomes "portable". All but "avx512_bf16"
            compute in float32.
        compact: round weights to bfloat16, which is faster; `runtime/README.md` says what it costs.

    Attributes:
        parameters: numbers of a material that it takes, the columns of `params`.
        names: the parameter that each column belongs to.
        low, high: the training range of each column.
        material: the parameters of the only material that it knows, whatever their ranges; None of a class.
        size: numbers that the network returns.
        instruction_set: the one in use.
        anisotropic: whether the view's azimuth matters.

    Raises:
        WeightsError: a file that is missing or damaged.
        ParamError: an unknown instruction set.
        MissingDependencyError, BuildError: the library cannot be compiled here.
    """

    def __init__(self, adapter: str | Path, instruction_set: str = "fastest", *, compact: bool = False):
        if instruction_set not in INSTRUCTION_SETS:
            raise ParamError(
                f"no instruction set {instruction_set!r}; there are {', '.join(INSTRUCTION_SETS)}"
            )
        self._library = _library()
        number = INSTRUCTION_SETS.index(instruction_set) + (_COMPACT if compact else 0)
        message = ctypes.create_string_buffer(_MESSAGE)
        handle = self._library.nma_load(str(weights_file(adapter)).encode(), number, message, _MESSAGE)
        if not handle:
            raise WeightsError(message.value.decode())
        self._handle = ctypes.c_void_p(handle)
        # Floats of an opaque row.
        self._brdf = self._library.nma_brdf_size() // np.dtype(np.float32).itemsize
        self.parameters = self._library.nma_parameter_count(self._handle)
        self.names = [self._name(k) for k in range(self.parameters)]
        self.low, self.high = self._ranges()
        self.material = self._single_material()
        self.size = self._library.nma_output_count(self._handle)
        self.anisotropic = bool(self._library.nma_anisotropic(self._handle))
        self.instruction_set = INSTRUCTION_SETS[self._library.nma_instruction_set(self._handle)]

    def __del__(self) -> None:
        if handle := getattr(self, "_handle", None):
            self._library.nma_free(handle)

    def outputs(self, params: ArrayLike, wi: ArrayLike, *, clamp: bool = False) -> Array:
        """What the network returns, before decoding: (n, size). Arguments and errors are those of `prepare`."""
        return self._many("nma_outputs", self._checked(params, clamp), wi, self.size)

    def prepare(self, params: ArrayLike, wi: ArrayLike, *, clamp: bool = False) -> Array:
        """BRDFs for `eval_pdf` and `sample`, opaque rows.

        Args:
            params: (n, parameters), within the training range.
            wi: directions (n, 3), unit vectors above the horizon; or, for isotropic adapters, which look at nothing
                else, their cosines (n,) in 0..1.
            clamp: move parameters beyond the training range to it.

        Raises:
            ParamError: parameters beyond the training range, or not finite; other shapes, different lengths, or cosines
                for an anisotropic adapter.
        """
        return self._many("nma_prepare", self._checked(params, clamp), wi, self._brdf)

    def eval(self, brdfs: Array, wi: ArrayLike, wo: ArrayLike) -> Array:
        """f cos(theta_o) [1/sr] (n, 3), 0 below the horizon."""
        return self.eval_pdf(brdfs, wi, wo)[0]

    def pdf(self, brdfs: Array, wi: ArrayLike, wo: ArrayLike) -> Array:
        """The density of `sample` [1/sr] (n,), 0 below the horizon."""
        return self.eval_pdf(brdfs, wi, wo)[1]

    def eval_pdf(self, brdfs: Array, wi: ArrayLike, wo: ArrayLike) -> tuple[Array, Array]:
        """`eval` (n, 3) and `pdf` (n,) at the price of one."""
        found = self._each("nma_eval_pdf", brdfs, wi, 4, wo)
        return found[:, :3], found[:, 3]

    def sample(self, brdfs: Array, wi: ArrayLike, u: ArrayLike) -> tuple[Array, Array, Array]:
        """Directions (n, 3) drawn with uniform numbers (n, 3) in [0, 1), and `eval_pdf` of them; a density of 0 marks
        an invalid one."""
        found = self._each("nma_sample", brdfs, wi, 7, u)
        return found[:, :3], found[:, 3:6], found[:, 6]

    def albedo(self, brdfs: Array, wi: ArrayLike) -> Array:
        """Directional albedos (n, 3) at `wi`, at most 1: the means over 128 fixed samples each, so without noise."""
        return self._each("nma_albedo", brdfs, wi, 3)

    def _name(self, column: int) -> str:
        return self._library.nma_parameter_name(self._handle, column).decode()

    def _ranges(self) -> tuple[Array, Array]:
        """Lower and upper ends of all columns."""
        ends = np.empty((self.parameters, 2), np.float32)
        for column, pair in enumerate(ends):
            self._library.nma_parameter_range(self._handle, column, _pointer(pair))
        return ends[:, 0], ends[:, 1]

    def _single_material(self) -> Array | None:
        numbers = np.empty(self.parameters, np.float32)
        return numbers if self._library.nma_single_material(self._handle, _pointer(numbers)) else None

    def _checked(self, params: ArrayLike, clamp: bool) -> Array:
        """Rows of parameters within the training range, or of the only material known."""
        rows = _rows("params", params, self.parameters)
        if self.material is not None:
            other = ~np.isclose(rows, self.material, rtol=SAME)
            if other.any():
                row, column = np.argwhere(other)[0]
                raise ParamError(
                    f"{self.names[column]} of row {row} is {rows[row, column]:g}, but the adapter knows a single "
                    f"material, whose own is {self.material[column]:g}; fit one to that material"
                )
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
            raise ParamError(f"{len(rows)} rows of params for {len(views)} {kind}")
        found = np.empty((len(rows), width), np.float32)
        call = getattr(self._library, name + suffix)
        call(self._handle, len(rows), *(_pointer(a) for a in (rows, views, found)))
        return found

    def _views(self, wi: ArrayLike) -> Array:
        """Directions (n, 3), or cosines (n,) where they are enough."""
        shape = np.shape(wi)
        if len(shape) > 1:
            return _rows("wi", wi, 3)
        if self.anisotropic:
            raise ParamError(
                f"an anisotropic adapter wants whole directions: give wi of shape (n, 3), not cosines {shape}"
            )
        return _rows("wi", wi)

    def _each(self, name: str, brdfs: Array, wi: ArrayLike, width: int, *more: ArrayLike) -> Array:
        arrays = [_rows("brdfs", brdfs, self._brdf), _rows("wi", wi, 3)]
        arrays += [_rows("wo or u", rows, 3) for rows in more]
        if len({len(array) for array in arrays}) > 1:
            raise ParamError(f"arrays of different lengths: {', '.join(str(len(a)) for a in arrays)}")
        found = np.empty((len(arrays[0]), width), np.float32)
        getattr(self._library, name)(len(found), *(_pointer(a) for a in (*arrays, found)))
        return found


def _rows(name: str, values: ArrayLike, *row: int) -> Array:
    """Contiguous float32: rows of this shape."""
    array = np.ascontiguousarray(values, np.float32)
    if array.shape[1:] != row:
        wanted = "(n,)" if not row else f"(n, {row[0]})"
        raise ParamError(f"{name} wants shape {wanted}, got {array.shape}")
    return array if array.ctypes.data % _ALIGNMENT == 0 else array.copy()


def _pointer(array: Array) -> Any:
    return array.ctypes.data_as(ctypes.c_void_p)


@cache
def _library() -> ctypes.CDLL:
    loaded = ctypes.CDLL(str(build.library()))
    loaded.nma_load.restype = ctypes.c_void_p
    loaded.nma_load.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t]
    loaded.nma_parameter_name.restype = ctypes.c_char_p
    loaded.nma_brdf_size.restype = ctypes.c_size_t
    return loaded
