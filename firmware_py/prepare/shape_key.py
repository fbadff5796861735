"""A key for the geometry of an assembly that is invariant to rotation and translation.

Drag outlines are cached under it: they are computed in the canonical pose of the shape (the first of 24 in order) and
rotated back.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.core.drag_lookup import node_directions
from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare.hulls import hull_of
from firmware_py.prepare.lattice import INVERSE, MATRICES, PRODUCT
from firmware_py.prepare.projected_area import Solid


@dataclass(frozen=True, eq=False)
class Part:
    """One module's hull in the lattice.

    Attributes:
        cell: lattice cell.
        rotation: index of one of the 24 rotations.
        hull: closed solids in the module frame.
        name: the same for equal hulls.
        size: (3,) edges of a hull that is one box, which half-turns leave unchanged; None for any other hull.
    """

    cell: tuple[int, int, int]
    rotation: int
    hull: tuple[Solid, ...]
    name: str
    size: np.ndarray | None

    def token(self, turn: int) -> tuple[int, int, int, str]:
        """Cell and appearance after the whole shape is rotated by rotation `turn`."""
        x, y, z = (round(float(c)) for c in MATRICES[turn] @ np.array(self.cell))
        rotation = int(PRODUCT[turn, self.rotation])
        if self.size is None:
            return x, y, z, f"{self.name}@{rotation}"
        return x, y, z, f"box{_text(np.abs(MATRICES[rotation]) @ self.size)}"


@dataclass(frozen=True, eq=False)
class CanonicalShape:
    """A shape in its canonical pose.

    Attributes:
        key: text that identifies the geometry.
        parts: the modules in the canonical pose.
        rotation: index of the rotation from the canonical frame to the lattice frame.
        origin: (3,) origin of the canonical frame in the lattice frame, in cells.
    """

    key: str
    parts: tuple[Part, ...]
    rotation: int
    origin: np.ndarray


def _text(values: np.ndarray) -> str:
    return "x".join(f"{v:.9g}" for v in np.asarray(values).ravel())


def part(vehicle: Vehicle, cell: tuple[int, int, int], rotation: int) -> Part:
    """The part for a module of `vehicle`."""
    hull = hull_of(vehicle)
    size = None if vehicle.hull.mesh or vehicle.payload else vehicle.hull.size_m
    return Part(cell, rotation, hull, _digest(hull), size)


def _digest(hull: Sequence[Solid]) -> str:
    digest = hashlib.sha256()
    for solid in hull:
        digest.update(np.round(solid.vertices, 9).tobytes() + solid.triangles.astype(np.int64).tobytes())
    return "solids" + digest.hexdigest()[:24]


def solids(parts: Sequence[Part], pitch_m: float) -> list[Solid]:
    """The hulls of the parts, placed in the frame of their cells."""
    return [s.placed(MATRICES[p.rotation], pitch_m * np.array(p.cell)) for p in parts for s in p.hull]


def canonical(parts: Sequence[Part], pitch_m: float) -> CanonicalShape:
    """The shape in the pose, out of 24, whose sorted list of cells and appearances comes first, with its lowest corner at the origin."""
    best: tuple[list[tuple[int, int, int, str]], int, tuple[int, int, int]] | None = None
    for turn in range(24):
        tokens = [p.token(turn) for p in parts]
        low = (min(t[0] for t in tokens), min(t[1] for t in tokens), min(t[2] for t in tokens))
        listed = sorted((x - low[0], y - low[1], z - low[2], looks) for x, y, z, looks in tokens)
        if best is None or listed < best[0]:
            best = (listed, turn, low)
    assert best is not None
    listed, turn, low = best
    moved = []
    for p in parts:
        x, y, z, _ = p.token(turn)
        cell = (x - low[0], y - low[1], z - low[2])
        moved.append(Part(cell, int(PRODUCT[turn, p.rotation]), p.hull, p.name, p.size))
    moved.sort(key=lambda p: p.token(0))
    back = int(INVERSE[turn])
    origin = MATRICES[back] @ np.array(low, dtype=float)
    return CanonicalShape(f"pitch{pitch_m:.9g} {listed}", tuple(moved), back, origin)


def turned_nodes(rotation: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices (side, i, j), each (6, n, n), of a cube-map in frame c for the nodes of one in frame b.

    `rotation` maps vectors of c to b, and so nodes of one to nodes of the other.
    """
    directions = node_directions(n) @ MATRICES[rotation]
    signed = np.stack([s * directions[..., a] for a in range(3) for s in (1.0, -1.0)], axis=-1)
    side = np.argmax(signed.round(9), axis=-1)
    axis = side // 2
    major = np.abs(np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0])
    across = [np.take_along_axis(directions, ((axis + k) % 3)[..., None], axis=-1)[..., 0] for k in (1, 2)]
    i, j = (np.rint((c / major + 1.0) * (n - 1) / 2).astype(int) for c in across)
    return side, i, j
