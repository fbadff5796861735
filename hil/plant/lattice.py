"""The plant's own implementation of the docking lattice: the 24 rotations of a cube as quaternions, and seats of modules.

Rotation k is the same as in a fleet file. The code is independent of the controller's; a test compares both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from firmware_py.core import rotations

HALF = 0.5**0.5
GENERATORS = (np.array([HALF, HALF, 0.0, 0.0]), np.array([HALF, 0.0, 0.0, HALF]))
"""Quarter turns about x and z; their products generate all rotations of the cube."""
WHOLE_TURNS = 4
COUNT = 24


class Place(NamedTuple):
    """Seat of a module in its body."""

    position: np.ndarray
    """(3,) hull centre, body frame, m."""
    quaternion: np.ndarray
    """(4,) module frame to body frame."""


def _order(quaternion: np.ndarray) -> tuple[int, ...]:
    """Sort key for the fleet file's order: columns of the three non-zero elements, then signs, plus first."""
    matrix = rotations.to_matrix(quaternion)
    columns = [int(c) for c in np.argmax(np.abs(matrix), axis=1)]
    return (*columns, *(int(matrix[i, c] < 0.0) for i, c in enumerate(columns)))


def _group() -> np.ndarray:
    found: dict[tuple[int, ...], np.ndarray] = {}
    fresh = [np.array([1.0, 0.0, 0.0, 0.0])]
    while fresh:
        quaternion = fresh.pop()
        key = _order(quaternion)
        if key not in found:
            found[key] = quaternion
            fresh += [rotations.normalise(rotations.multiply(quaternion, g)) for g in GENERATORS]
    assert len(found) == COUNT
    ordered = np.array([found[key] for key in sorted(found)])
    exact = np.sign(ordered) * np.sqrt(np.round(WHOLE_TURNS * ordered**2) / WHOLE_TURNS)
    exact.flags.writeable = False
    return exact


QUATERNIONS = _group()
"""(24, 4) module frame to body frame, scalar first, scalar part not negative."""


def place(cell: np.ndarray, rotation: int, pitch_m: float, origin: np.ndarray) -> Place:
    """Seat of a module in lattice cell `cell`, in a body whose frame has its origin at the cell `origin`."""
    return Place(pitch_m * (np.asarray(cell, dtype=float) - origin), QUATERNIONS[rotation].copy())


def nearest(quaternion: np.ndarray) -> int:
    """Index of the rotation of the cube nearest to an attitude."""
    return int(np.argmax(np.abs(QUATERNIONS @ quaternion)))


def is_connected(cells: np.ndarray) -> bool:
    """Whether the cells (n, 3) are distinct and connected through their faces."""
    left = {tuple(int(x) for x in c) for c in cells}
    if len(left) != len(cells):
        return False
    front = [left.pop()]
    while front:
        x, y, z = front.pop()
        near = {(x + 1, y, z), (x - 1, y, z), (x, y + 1, z), (x, y - 1, z), (x, y, z + 1), (x, y, z - 1)} & left
        left -= near
        front += near
    return not left
