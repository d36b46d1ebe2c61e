"""The frame of the plane of incidence: `enter` rotates a direction about the normal, and `leave` rotates it back."""

import numpy as np

from nma.ops import Vec3, dot
from nma.target import Plane


def directions(n, seed):
    v = np.random.default_rng(seed).normal(size=(3, n))
    v[2] = np.abs(v[2])
    return Vec3(*(v / np.linalg.norm(v, axis=0)))


def test_enter_turns_wi_to_azimuth_zero():
    wi = directions(1000, 0)
    entered = Plane.of(wi).enter(wi)
    np.testing.assert_allclose(entered.y, 0.0, atol=1e-15)
    np.testing.assert_allclose(entered.x, np.sqrt(1 - wi.z**2), rtol=1e-9)
    np.testing.assert_array_equal(entered.z, wi.z)


def test_enter_keeps_angles_and_leave_is_its_inverse():
    wi, wo = directions(1000, 1), directions(1000, 2)
    plane = Plane.of(wi)
    np.testing.assert_allclose(dot(plane.enter(wi), plane.enter(wo)), dot(wi, wo), atol=1e-14)
    np.testing.assert_allclose(np.stack(plane.leave(plane.enter(wo))), np.stack(wo), atol=1e-15)


def test_normal_incidence_has_the_plane_of_the_x_axis():
    one = np.ones(2, np.float32)
    plane = Plane.of(Vec3(0.0 * one, 0.0 * one, one))
    np.testing.assert_array_equal(np.stack([plane.cos_phi, plane.sin_phi]), [one, 0.0 * one])
