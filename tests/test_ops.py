"""The operations of `nma.ops` give the same numbers in every array package."""

import math

import drjit as dr
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nma import ops
from nma.llvm import ensure_llvm
from nma.ops import Vec3

ensure_llvm()

UNARY = (
    "sqrt",
    "safe_sqrt",
    "exp",
    "log",
    "log1p",
    "sin",
    "cos",
    "tan",
    "atan",
    "tanh",
    "sigmoid",
    "absolute",
    "floor",
)
BINARY = ("atan2", "minimum", "maximum", "copysign")


@pytest.mark.parametrize("name", UNARY)
def test_unary_operations_agree(name):
    x = np.linspace(0.01, 3.0, 50, dtype=np.float32)
    f = getattr(ops, name)
    expected = f(x.astype(np.float64))
    np.testing.assert_allclose(f(dr.llvm.Float(x)).numpy(), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.asarray(f(jnp.asarray(x))), expected, rtol=1e-5, atol=1e-6)
    plain = f(float(x[3]))
    assert type(plain) is float
    assert plain == pytest.approx(expected[3])


@pytest.mark.parametrize("name", BINARY)
def test_binary_operations_agree(name):
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 50)).astype(np.float32)
    f = getattr(ops, name)
    expected = f(a.astype(np.float64), b.astype(np.float64))
    np.testing.assert_allclose(f(dr.llvm.Float(a), dr.llvm.Float(b)).numpy(), expected, rtol=1e-5)
    np.testing.assert_allclose(np.asarray(f(jnp.asarray(a), jnp.asarray(b))), expected, rtol=1e-5)
    assert f(float(a[0]), float(b[0])) == pytest.approx(expected[0])


def test_plain_numbers_do_not_capture_arrays():
    # `nma.ops` must return Python floats for plain numbers, not NumPy scalars. The product of a NumPy scalar and a
    # Dr.Jit array is a NumPy array.
    x = dr.llvm.Float([1.0, 2.0])
    assert type(ops.sqrt(4.0) * x) is dr.llvm.Float
    assert type(ops.select(2.0 > 1.0, 3.0, 4.0) * x) is dr.llvm.Float
    assert ops.select(True, 3.0, 4.0) == 3.0


def test_select_takes_triples():
    v = ops.select(np.array([True, False]), Vec3(1.0, 2.0, 3.0), 0.0)
    np.testing.assert_array_equal(np.stack(v), [[1, 0], [2, 0], [3, 0]])


def test_safe_sqrt_has_a_finite_derivative_at_zero():
    assert jax.grad(ops.safe_sqrt)(0.0) == 0.0
    assert jax.grad(ops.safe_sqrt)(-1.0) == 0.0
    x = dr.llvm.ad.Float([0.0, 4.0])
    dr.enable_grad(x)
    dr.backward(ops.safe_sqrt(x))
    assert list(dr.grad(x)) == [0.0, 0.25]


def test_sigmoid_neither_overflows_nor_loses_its_derivative():
    for x in (-1e4, -100.0, 0.0, 100.0, 1e4):
        value, slope = jax.value_and_grad(ops.sigmoid)(x)
        assert 0.0 <= value <= 1.0
        assert math.isfinite(slope)
    assert ops.sigmoid(2.0) == pytest.approx(1 / (1 + math.exp(-2.0)))


def test_detach_stops_derivatives():
    assert jax.grad(lambda x: ops.detach(x) * x)(3.0) == 3.0
    assert ops.detach(3.0) == 3.0


def test_vectors():
    a, b = Vec3(1.0, 2.0, 3.0), Vec3(-2.0, 0.5, 4.0)
    assert ops.dot(a, b) == 11.0
    assert tuple(ops.cross(a, b)) == tuple(np.cross(a, b))
    assert ops.dot(ops.cross(a, b), a) == pytest.approx(0.0)
    assert ops.dot(ops.normalize(a), ops.normalize(a)) == pytest.approx(1.0)
    assert tuple(2.0 * a - 1.0) == (1.0, 3.0, 5.0)
    assert tuple(1.0 - a) == (0.0, -1.0, -2.0)
    assert tuple(1.0 + a / 2.0) == (1.5, 2.0, 2.5)
    assert tuple(-a) == (-1.0, -2.0, -3.0)
    assert ops.mean(a) == pytest.approx(2.0)
    assert ops.max_component(b) == 4.0
    assert ops.luminance(Vec3(1.0, 1.0, 1.0)) == pytest.approx(1.0)
