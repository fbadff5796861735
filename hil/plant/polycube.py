"""Random connected shapes of docked modules; every joint is a probe in a drogue."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.vehicle import FACE_NORMALS
from hil.plant.lattice import COUNT, QUATERNIONS

Cell = tuple[int, int, int]
STEPS: tuple[Cell, ...] = tuple((int(x), int(y), int(z)) for x, y, z in FACE_NORMALS)
"""Steps from a cell to its six neighbours."""
MATES = ({"P", "D"}, {"D"})
"""Kinds of two faces that may be adjacent: a probe and a drogue dock, two drogues do not interact."""


class Seat(NamedTuple):
    """One module of a shape."""

    cell: Cell
    rotation: int


def grow(rng: np.random.Generator, count: int, faces: str) -> list[Seat]:
    """Returns a shape of `count` identical modules, each added at a random open face with a random rotation.

    Args:
        faces: kinds of a module's six faces, as in a vehicle file.
    """
    looks = [_kinds(rotation, faces) for rotation in range(COUNT)]
    seats = [Seat((0, 0, 0), 0)]
    while len(seats) < count:
        taken = {seat.cell: looks[seat.rotation] for seat in seats}
        open_cells = sorted({_beside(seat.cell, step) for seat in seats for step in STEPS} - set(taken))
        choices = [
            Seat(cell, rotation)
            for cell, rotation in itertools.product(open_cells, range(COUNT))
            if _fits(cell, looks[rotation], taken)
        ]
        seats.append(choices[int(rng.integers(len(choices)))])
    return seats


def _kinds(rotation: int, faces: str) -> dict[Cell, str]:
    """Kind of the face in each lattice direction, for a module in this rotation."""
    turn = rotations.to_matrix(QUATERNIONS[rotation].copy())
    ways = [turn @ normal for normal in FACE_NORMALS]
    return {(round(float(x)), round(float(y)), round(float(z))): kind for (x, y, z), kind in zip(ways, faces, strict=True)}


def _beside(cell: Cell, step: Cell) -> Cell:
    return cell[0] + step[0], cell[1] + step[1], cell[2] + step[2]


def _fits(cell: Cell, kinds: dict[Cell, str], taken: dict[Cell, dict[Cell, str]]) -> bool:
    """Whether every pair of adjacent faces is allowed (`MATES`) and at least one pair docks."""
    docked = False
    for step in STEPS:
        other = taken.get(_beside(cell, step))
        if other is not None:
            pair = {kinds[step], other[-step[0], -step[1], -step[2]]}
            if pair not in MATES:
                return False
            docked |= pair == {"P", "D"}
    return docked
