"""All shapes that n docked cubes can form, and all poses of a shape in the lattice."""

from __future__ import annotations

import numpy as np

from firmware_py.description.schema import DescriptionError
from firmware_py.prepare.lattice import MATRICES

MOST_CUBES = 5
"""Largest number of cubes with a list of shapes. Five cubes have 534 poses, six have 3481."""

Cell = tuple[int, int, int]
Cells = tuple[Cell, ...]

_STEPS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def polycubes(count: int) -> list[Cells]:
    """Every distinct shape of `count` cubes, mirror images counted separately: 1, 1, 2, 8, 29 (OEIS A000162). Sorted.

    Two shapes are the same if one of the 24 rotations and a shift map one to the other; a robot cannot be mirrored.

    Raises:
        DescriptionError: more than MOST_CUBES cubes, or none.
    """
    if not 1 <= count <= MOST_CUBES:
        raise DescriptionError(f"shapes are listed for 1 to {MOST_CUBES} modules, not {count}")
    shapes: set[Cells] = {((0, 0, 0),)}
    for _ in range(count - 1):
        shapes = {canonical((*shape, cell)) for shape in shapes for cell in _neighbours(shape)}
    return sorted(shapes)


def poses(cells: Cells) -> list[Cells]:
    """Every distinct pose of a shape in the lattice, at most 24; sorted."""
    table = np.array(cells, dtype=float)
    return sorted({_settled(table @ turn.T) for turn in MATRICES})


def canonical(cells: Cells) -> Cells:
    """The first of a shape's poses: the same for all of them."""
    return poses(cells)[0]


def _settled(table: np.ndarray) -> Cells:
    """Cells shifted so that the lowest corner is at the origin, and sorted."""
    whole = np.rint(table - table.min(axis=0)).astype(int)
    return tuple(sorted((int(x), int(y), int(z)) for x, y, z in whole))


def _neighbours(cells: Cells) -> set[Cell]:
    around = {(x + dx, y + dy, z + dz) for x, y, z in cells for dx, dy, dz in _STEPS}
    return around - set(cells)
