"""Quaternions against scipy's Rotation, which is scalar-last and independent of this code."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core import rotations


def to_scipy(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q[[1, 2, 3, 0]])


def from_scipy(rotation: Rotation) -> np.ndarray:
    return np.ascontiguousarray(rotation.as_quat()[..., [3, 0, 1, 2]])


def attitudes() -> list[np.ndarray]:
    """Random attitudes and edge cases: identity, half-turns, pitch 90 degrees, a negative scalar part."""
    random = list(from_scipy(Rotation.random(12, rng=np.random.default_rng(1))))
    half_turns = [np.roll(np.array([1.0, 0.0, 0.0, 0.0]), k) for k in range(4)]
    upright = [rotations.from_euler(0.3, 0.5 * math.pi, -0.2), rotations.from_euler(0.0, -0.5 * math.pi, 1.0)]
    return random + half_turns + upright + [-q for q in random[:5]]


def same_attitude(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-12) -> bool:
    return bool(abs(abs(float(a @ b)) - 1.0) < tolerance)


@pytest.fixture(params=attitudes(), ids=lambda q: np.array2string(q, precision=2))
def q(request: pytest.FixtureRequest) -> np.ndarray:
    return np.ascontiguousarray(request.param)


def test_matrix_of_an_attitude_is_scipys(q: np.ndarray) -> None:
    np.testing.assert_allclose(rotations.to_matrix(q), to_scipy(q).as_matrix(), atol=1e-14)


def test_attitude_comes_back_from_its_matrix(q: np.ndarray) -> None:
    back = rotations.from_matrix(np.ascontiguousarray(to_scipy(q).as_matrix()))
    assert same_attitude(back, q)
    assert back[0] >= 0.0


def test_vector_turns_as_scipy_turns_it(q: np.ndarray) -> None:
    v = np.array([0.3, -1.2, 2.0])
    np.testing.assert_allclose(rotations.rotate(q, v), to_scipy(q).apply(v), atol=1e-14)
    np.testing.assert_allclose(rotations.rotate_back(q, v), to_scipy(q).inv().apply(v), atol=1e-14)


def test_turning_twice_is_scipys_product(q: np.ndarray) -> None:
    other = rotations.from_euler(0.4, -0.7, 2.1)
    assert same_attitude(rotations.multiply(q, other), from_scipy(to_scipy(q) * to_scipy(other)))
    np.testing.assert_allclose(rotations.multiply(q, rotations.conjugate(q)), [1.0, 0.0, 0.0, 0.0], atol=1e-14)


def test_rotation_vector_of_an_attitude_is_scipys(q: np.ndarray) -> None:
    vector = rotations.log(q)
    assert np.linalg.norm(vector) <= math.pi + 1e-12
    assert same_attitude(from_scipy(Rotation.from_rotvec(vector)), q)
    assert same_attitude(rotations.exp(vector), q)


def test_euler_angles_are_the_aerospace_sequence() -> None:
    roll, pitch, yaw = 0.3, -1.1, 2.4
    q = rotations.from_euler(roll, pitch, yaw)
    assert same_attitude(q, from_scipy(Rotation.from_euler("ZYX", [yaw, pitch, roll])))
    assert rotations.to_euler(q) == pytest.approx((roll, pitch, yaw))


def test_euler_angles_survive_pitch_90(q: np.ndarray) -> None:
    roll, pitch, yaw = rotations.to_euler(q)
    assert all(math.isfinite(angle) for angle in (roll, pitch, yaw))


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-9, 9.9e-5, 1.1e-4, 1e-3, 3.0, math.pi - 1e-7, math.pi])
def test_rotation_vector_comes_back_at_every_size(angle: float) -> None:
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    vector = angle * axis
    q = rotations.exp(vector)
    np.testing.assert_allclose(q, from_scipy(Rotation.from_rotvec(vector)), atol=1e-15)
    assert float(q @ q) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(rotations.log(q), vector, atol=1e-12 * max(angle, 1e-3), rtol=1e-7)


@pytest.mark.parametrize("turn", [4.0, 7.0, -20.0])
def test_more_than_half_a_turn_comes_back_the_short_way(turn: float) -> None:
    vector = rotations.log(rotations.exp(np.array([turn, 0.0, 0.0])))
    assert vector[0] == pytest.approx(math.remainder(turn, 2.0 * math.pi))


def test_difference_is_what_the_second_attitude_lacks_in_its_own_frame() -> None:
    turn = np.array([0.1, -0.4, 0.2])
    b = rotations.from_euler(0.5, 1.4, -2.0)
    a = rotations.multiply(b, rotations.exp(turn))
    np.testing.assert_allclose(rotations.difference(a, b), turn, atol=1e-14)


def test_difference_does_not_care_for_the_sign_of_a_quaternion() -> None:
    a, b = rotations.from_euler(0.1, 0.2, 0.3), rotations.from_euler(-0.4, 0.0, 2.9)
    np.testing.assert_allclose(rotations.difference(-a, b), rotations.difference(a, b), atol=1e-14)


def test_normalising_gives_length_one_and_a_scalar_part_above_zero() -> None:
    turned = rotations.normalise(np.array([-2.0, 0.0, 0.0, 2.0]))
    np.testing.assert_allclose(turned, np.array([1.0, 0.0, 0.0, -1.0]) / math.sqrt(2.0))


def test_cross_product_and_its_matrix_agree_with_numpy() -> None:
    a, b = np.array([1.0, -2.0, 0.5]), np.array([0.3, 4.0, -1.0])
    np.testing.assert_allclose(rotations.cross(a, b), np.cross(a, b), atol=1e-15)
    np.testing.assert_allclose(rotations.skew(a) @ b, np.cross(a, b), atol=1e-15)


def test_half_turn_has_a_finite_rotation_vector() -> None:
    for axis in np.eye(3):
        vector = rotations.log(np.r_[0.0, axis])
        np.testing.assert_allclose(np.abs(vector), math.pi * axis, atol=1e-15)
