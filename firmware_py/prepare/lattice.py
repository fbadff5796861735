"""The 24 rotations of a cube as a group: the orientations of a module in the lattice, and the rotations of an assembly.

Rotation k of a fleet file is row k of `MATRICES`: module frame to body (lattice) frame. Row 0 is the identity.
"""

from __future__ import annotations

import itertools

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.schema import frozen_array
from firmware_py.description.vehicle import FACE_NORMALS


def _proper_signed_permutations() -> np.ndarray:
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0.0:
                found.append(matrix)
    return np.array(found)


def _rounded_quaternion(matrix: np.ndarray) -> np.ndarray:
    """Quaternion of a cube rotation, rounded: its components are 0, 1/2, sqrt(1/2) or 1, so four times their squares are integers."""
    q = rotations.from_matrix(np.array(matrix))
    return np.asarray(np.sign(q) * np.sqrt(np.round(4.0 * q * q) / 4.0))


MATRICES = frozen_array(_proper_signed_permutations())
"""(24, 3, 3) signed permutation matrices with determinant 1; integers."""

QUATERNIONS = frozen_array([_rounded_quaternion(m) for m in MATRICES])
"""(24, 4) the same rotations as quaternions, scalar first."""

PRODUCT = np.array([[int(np.argmax((a @ b == MATRICES).all(axis=(1, 2)))) for b in MATRICES] for a in MATRICES])
"""(24, 24) index of MATRICES[i] @ MATRICES[j]."""
PRODUCT.flags.writeable = False

INVERSE = np.argmax(PRODUCT == 0, axis=1)
"""(24,) index of the inverse."""
INVERSE.flags.writeable = False


def face_towards(rotation: int, direction: np.ndarray) -> int:
    """Face (0..5, description.vehicle.FACE_NAMES) of a rotated module that points along a lattice direction (3,), a unit vector."""
    return int(np.argmax(FACE_NORMALS @ (MATRICES[rotation].T @ direction)))


def nearest(matrix: np.ndarray) -> int:
    """Index of the cube rotation nearest to a (3, 3) rotation matrix."""
    return int(np.argmax(np.einsum("kij,ij->k", MATRICES, matrix)))
