"""Checks whether placed modules can be docked as they are placed: cells, faces, probes and drogues, payloads. Errors name the modules."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.description.fleet import overlaps
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import FACE_NAMES, Vehicle
from firmware_py.prepare.lattice import MATRICES, face_towards

Cell = tuple[int, int, int]

PAYLOAD_CLEARANCE_M = 1e-3
"""How far a payload may reach into a neighbour's cell: manufacturing tolerance."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Placement of one module: its vehicle, lattice cell and rotation index."""

    vehicle: Vehicle
    cell: Cell
    rotation: int


def check_joints(placements: Sequence[Placement], names: Sequence[object], pitch_m: float) -> None:
    """Refuses placements that cannot be docked.

    Args:
        placements: the modules.
        names: their numbers or other names, for error messages.
        pitch_m: lattice pitch.

    Raises:
        DescriptionError: two modules in one cell, an unknown rotation, a payload in another module's cell, a probe that meets
            no drogue, or a module without a joint to the rest.
    """
    for _, what in overlaps([placement.cell for placement in placements], names):
        raise DescriptionError(what)
    at: dict[Cell, int] = {}
    for i, placement in enumerate(placements):
        if not 0 <= placement.rotation < 24:
            raise DescriptionError(f"module {names[i]}: rotation {placement.rotation} is none of 0 to 23")
        at[placement.cell] = i
    _check_payloads(placements, names, at, pitch_m)
    joints: list[frozenset[int]] = []
    for i, placement in enumerate(placements):
        for axis in range(3):
            j = at.get(_neighbour(placement.cell, axis))
            if j is not None and _joined(placements, names, i, j, axis):
                joints.append(frozenset((i, j)))
    reached = connected_to(0, joints)
    if lost := [str(names[i]) for i in range(len(placements)) if i not in reached]:
        raise DescriptionError(f"no docked face joins module {', '.join(lost)} to module {names[0]}")


def _neighbour(cell: Cell, axis: int) -> Cell:
    x, y, z = (c + (k == axis) for k, c in enumerate(cell))
    return x, y, z


def _joined(placements: Sequence[Placement], names: Sequence[object], i: int, j: int, axis: int) -> bool:
    """Whether the faces between neighbours i and j (i below j along `axis`) dock. Raises DescriptionError for a probe without a drogue."""
    step = np.eye(3)[axis]
    upper, lower = face_towards(placements[i].rotation, step), face_towards(placements[j].rotation, -step)
    kinds = placements[i].vehicle.faces[upper] + placements[j].vehicle.faces[lower]
    if kinds in ("PP", "P-", "-P"):
        what = "probe" if kinds == "PP" else "a face without drogue"
        first, second = ((i, upper), (j, lower)) if kinds[0] == "P" else ((j, lower), (i, upper))
        raise DescriptionError(
            f"module {names[first[0]]}'s probe on face {FACE_NAMES[first[1]]} meets {what} on face "
            f"{FACE_NAMES[second[1]]} of module {names[second[0]]}"
        )
    return set(kinds) == {"P", "D"}


def connected_to(start: int, joints: Sequence[frozenset[int]]) -> set[int]:
    """Modules connected to `start` through these joints, each a pair of modules; `start` included."""
    reached, before = {start}, set[int]()
    while reached != before:
        before = reached
        reached = reached.union(*(joint for joint in joints if joint & reached))
    return reached


def _check_payloads(
    placements: Sequence[Placement], names: Sequence[object], at: Mapping[Cell, int], pitch_m: float
) -> None:
    for i, placement in enumerate(placements):
        turn = MATRICES[placement.rotation]
        for payload in placement.vehicle.payload:
            centre = np.array(placement.cell) + turn @ payload.position_m / pitch_m
            half = np.maximum(np.abs(turn) @ payload.size_m / 2.0 - PAYLOAD_CLEARANCE_M, 0.0) / pitch_m
            low, high = (centre - half + 0.5, centre + half + 0.5)
            spans = [range(math.floor(a), math.ceil(b)) for a, b in zip(low, high, strict=True)]
            for cell in ((x, y, z) for x in spans[0] for y in spans[1] for z in spans[2]):
                if at.get(cell, i) != i:
                    other = names[at[cell]]
                    what = f"payload {payload.name!r} of module {names[i]}"
                    raise DescriptionError(f"{what} is in the way of module {other}")
