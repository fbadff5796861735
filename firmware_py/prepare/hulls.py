"""The outside of a module as closed solids: its box or mesh, and the boxes of what it carries."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare.projected_area import Solid, box

_CONVEX_SHARE = 1e-9
"""A mesh counts as convex when its convex hull has its volume to this share."""


def hull_of(vehicle: Vehicle) -> tuple[Solid, ...]:
    """Closed solids in the module frame: hull first, then payloads.

    Raises:
        DescriptionError: the mesh cannot be read or is not closed.
    """
    hull = load_mesh(vehicle.hull.mesh) if vehicle.hull.mesh else box(vehicle.hull.size_m)
    carried = (box(p.size_m).placed(np.eye(3), p.position_m) for p in vehicle.payload)
    return (hull, *carried)


def load_mesh(path: str) -> Solid:
    """The closed mesh in `path` (STL, OBJ, PLY, OFF), metres, outward normals. Raises DescriptionError, one line."""
    import trimesh  # half a second, and only for vehicles that have a mesh

    if not Path(path).is_file():
        raise DescriptionError(f"{path}: there is no such mesh")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:
        raise DescriptionError(f"{path}: cannot be read as a mesh: {error}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not mesh.is_watertight:
        raise DescriptionError(f"{path}: the mesh is not closed; every edge needs two triangles")
    mesh.fix_normals()
    convex = bool(abs(mesh.convex_hull.volume - mesh.volume) <= _CONVEX_SHARE * abs(mesh.volume))
    return Solid(np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64), convex)
