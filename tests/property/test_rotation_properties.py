"""Properties of every rotation, tested with hypothesis."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from firmware_py.core import rotations

always = settings(derandomize=True, deadline=None, database=None, max_examples=60)

vectors = arrays(np.float64, 3, elements=st.floats(-20.0, 20.0))
turns = arrays(np.float64, 3, elements=st.floats(-1.8, 1.8))  # shorter than pi
attitudes = vectors.map(rotations.exp)


@always
@given(attitudes, vectors)
def test_turning_there_and_back_leaves_a_vector(q: np.ndarray, v: np.ndarray) -> None:
    np.testing.assert_allclose(rotations.rotate_back(q, rotations.rotate(q, v)), v, atol=1e-12)


@always
@given(attitudes, vectors)
def test_turning_keeps_length(q: np.ndarray, v: np.ndarray) -> None:
    np.testing.assert_allclose(np.linalg.norm(rotations.rotate(q, v)), np.linalg.norm(v), atol=1e-12)


@always
@given(attitudes)
def test_matrix_of_an_attitude_is_orthogonal_and_right_handed(q: np.ndarray) -> None:
    r = rotations.to_matrix(q)
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(r) > 0.0


@always
@given(attitudes)
def test_matrix_and_quaternion_are_the_same_attitude(q: np.ndarray) -> None:
    back = rotations.from_matrix(rotations.to_matrix(q))
    np.testing.assert_allclose(abs(float(back @ q)), 1.0, atol=1e-12)


@always
@given(turns)
def test_rotation_vector_survives_the_quaternion(v: np.ndarray) -> None:
    np.testing.assert_allclose(rotations.log(rotations.exp(v)), v, atol=1e-9)


@always
@given(attitudes, turns)
def test_error_that_is_added_is_the_error_that_is_found(q: np.ndarray, turn: np.ndarray) -> None:
    np.testing.assert_allclose(rotations.difference(rotations.multiply(q, rotations.exp(turn)), q), turn, atol=1e-9)


@always
@given(attitudes, attitudes, attitudes)
def test_product_is_associative(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    left = rotations.multiply(rotations.multiply(a, b), c)
    np.testing.assert_allclose(left, rotations.multiply(a, rotations.multiply(b, c)), atol=1e-12)
