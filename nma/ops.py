"""Calculates with Dr.Jit, JAX and NumPy arrays, so that physics is written only once (CONVENTIONS.md).

Each function chooses the array package by the types of its arguments. For plain Python numbers, the result is a plain
Python number. Code that uses this module must call `select` instead of branching on values. A `Vec3` is a triple of
arrays: a direction or an RGB colour.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

Float = Any  # one number per lane: a Dr.Jit, JAX or NumPy array, or a Python float
Mask = Any  # one truth value per lane

PI = math.pi
INV_PI = 1.0 / math.pi


class _Python:
    """NumPy's operations on plain Python numbers, with plain Python numbers as results.

    The results must not be NumPy scalars, whose operators would convert arrays of Dr.Jit and JAX, as in `scalar *
    array`.
    """

    __name__ = "python"

    def __getattr__(self, name: str) -> Any:
        function = getattr(np, name)
        return lambda *args: function(*args).item()


_PYTHON = _Python()


def backend(*args: Any) -> str:
    """The array package that the arguments belong to: "drjit", "jax", "numpy", or "python" for plain numbers."""
    for a in args:
        module = type(a).__module__
        if module.startswith(("drjit", "mitsuba")):
            return "drjit"
        if module.startswith("jax"):
            return "jax"
    plain = all(type(a) in (float, int, bool) for a in args)
    return "python" if plain else "numpy"


def _module(*args: Any) -> Any:
    """The module with the operations for the arguments. Dr.Jit and JAX are imported only if an argument needs them."""
    owner = backend(*args)
    if owner == "drjit":
        import drjit

        return drjit
    if owner == "jax":
        import jax.numpy

        return jax.numpy
    return _PYTHON if owner == "python" else np


def sqrt(x: Float) -> Float:
    return _module(x).sqrt(x)


def safe_sqrt(x: Float) -> Float:
    """sqrt(max(x, 0)), with the derivative 0 for x <= 0. The derivative of a plain square root would be infinite at
    0."""
    positive = x > 0
    return select(positive, sqrt(select(positive, x, 1.0)), 0.0)


def exp(x: Float) -> Float:
    return _module(x).exp(x)


def log(x: Float) -> Float:
    return _module(x).log(x)


def log1p(x: Float) -> Float:
    m = _module(x)
    return m.log(1.0 + x) if m.__name__ == "drjit" else m.log1p(x)


def sigmoid(x: Float) -> Float:
    """1 / (1 + exp(-x)), written with tanh so that neither the value nor the derivative overflows."""
    return 0.5 + 0.5 * tanh(0.5 * x)


def tanh(x: Float) -> Float:
    return _module(x).tanh(x)


def sin(x: Float) -> Float:
    return _module(x).sin(x)


def cos(x: Float) -> Float:
    return _module(x).cos(x)


def tan(x: Float) -> Float:
    return _module(x).tan(x)


def atan(x: Float) -> Float:
    m = _module(x)
    return m.atan(x) if m.__name__ == "drjit" else m.arctan(x)


def atan2(y: Float, x: Float) -> Float:
    m = _module(y, x)
    return m.atan2(y, x) if m.__name__ == "drjit" else m.arctan2(y, x)


def absolute(x: Float) -> Float:
    return _module(x).abs(x)


def minimum(a: Float, b: Float) -> Float:
    return _module(a, b).minimum(a, b)


def maximum(a: Float, b: Float) -> Float:
    return _module(a, b).maximum(a, b)


def clip(x: Float, low: float, high: float) -> Float:
    """`x`, limited to the range from `low` to `high`."""
    return minimum(maximum(x, low), high)


def floor(x: Float) -> Float:
    return _module(x).floor(x)


def select(condition: Mask, a: Float, b: Float) -> Float:
    """`a` where the condition holds, else `b`. `a` and `b` may be numbers or `Vec3`."""
    if isinstance(a, Vec3) or isinstance(b, Vec3):
        a, b = Vec3.of(a), Vec3.of(b)
        return Vec3(*(select(condition, p, q) for p, q in zip(a, b, strict=True)))
    m = _module(condition, a, b)
    return m.select(condition, a, b) if m.__name__ == "drjit" else m.where(condition, a, b)


def copysign(magnitude: Float, sign: Float) -> Float:
    """The absolute value of `magnitude`, multiplied by -1 where `sign` < 0."""
    return select(sign < 0, -absolute(magnitude), absolute(magnitude))


def detach(x: Float) -> Float:
    """The value of `x` as a constant, through which no derivative is propagated."""
    owner = backend(x)
    if owner == "drjit":
        import drjit

        return drjit.detach(x)
    if owner == "jax":
        import jax

        return jax.lax.stop_gradient(x)
    return x


def lerp(a: Float, b: Float, t: Float) -> Float:
    """Linear interpolation: `a` for t = 0, `b` for t = 1."""
    return a + (b - a) * t


class Vec3(NamedTuple):
    """A direction or an RGB colour: three arrays of equal shape, with elementwise arithmetic.

    Dr.Jit does not look into named tuples: `dr.eval(*v)` evaluates the three arrays, but `dr.eval(v)` evaluates none.
    """

    x: Float
    y: Float
    z: Float

    @staticmethod
    def of(value: Float | Vec3) -> Vec3:
        """Returns `value` if it is a `Vec3`, else the triple (value, value, value)."""
        return value if isinstance(value, Vec3) else Vec3(value, value, value)

    def __add__(self, other):
        o = Vec3.of(other)
        return Vec3(self.x + o.x, self.y + o.y, self.z + o.z)

    def __sub__(self, other):
        o = Vec3.of(other)
        return Vec3(self.x - o.x, self.y - o.y, self.z - o.z)

    def __mul__(self, other):
        o = Vec3.of(other)
        return Vec3(self.x * o.x, self.y * o.y, self.z * o.z)

    def __truediv__(self, other):
        o = Vec3.of(other)
        return Vec3(self.x / o.x, self.y / o.y, self.z / o.z)

    def __neg__(self):
        return Vec3(-self.x, -self.y, -self.z)

    def __radd__(self, other):
        return self + other

    def __rmul__(self, other):
        return self * other

    def __rsub__(self, other):
        return Vec3.of(other) - self


Color = Vec3


def at_azimuth_0(cos_theta: Float) -> Vec3:
    """The unit direction at azimuth 0 (y = 0, x >= 0) whose z, the cosine to the normal, is `cos_theta`."""
    return Vec3(safe_sqrt(1.0 - cos_theta * cos_theta), 0.0 * cos_theta, cos_theta)


def dot(a: Vec3, b: Vec3) -> Float:
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vec3, b: Vec3) -> Vec3:
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def normalize(v: Vec3) -> Vec3:
    """The unit vector along `v`, which must not be 0."""
    return v * (1.0 / sqrt(dot(v, v)))


def max_component(c: Vec3) -> Float:
    """The largest of the three components."""
    return maximum(maximum(c.x, c.y), c.z)


def mean(c: Vec3) -> Float:
    """The mean of the three components."""
    return (c.x + c.y + c.z) * (1.0 / 3.0)


def luminance(c: Vec3) -> Float:
    """The luminance of a linear sRGB colour (ITU-R BT.709 primaries)."""
    return 0.212671 * c.x + 0.715160 * c.y + 0.072169 * c.z
