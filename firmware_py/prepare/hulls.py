"""The hull of a module as closed solids: its box or mesh, and the boxes of its payloads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare.projected_area import Solid, box

_CONVEX_SHARE = 1e-9
"""Relative tolerance of the volume within which a mesh that matches its convex hull counts as convex."""
_BOX_SHARE = 0.25
"""Largest distance of a side of the mesh from that of the hull's box, as a share of the box's edge. Fins stay within; a mesh in
millimetres, with other axes or with its origin at a corner does not."""


def hull_of(vehicle: Vehicle) -> tuple[Solid, ...]:
    """Closed solids in the module frame: hull first, then payloads.

    Raises:
        DescriptionError: the mesh cannot be read, is not closed or wound inconsistently, or does not match the hull's box.
    """
    hull = box(vehicle.hull.size_m)
    if vehicle.hull.mesh:
        hull = load_mesh(vehicle.hull.mesh)
        _check_box(hull, vehicle.hull.size_m, vehicle.hull.mesh)
    carried = (box(p.size_m).placed(np.eye(3), p.position_m) for p in vehicle.payload)
    return (hull, *carried)


def load_mesh(path: str) -> Solid:
    """The closed mesh in `path` (STL, OBJ, PLY, OFF), metres, outward normals. Raises DescriptionError, one line."""
    import trimesh  # takes half a second, and only vehicles with a mesh need it

    if not Path(path).is_file():
        raise DescriptionError(f"{path}: there is no such mesh")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:
        raise DescriptionError(f"{path}: cannot be read as a mesh: {error}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not mesh.is_watertight:
        raise DescriptionError(f"{path}: the mesh is not closed; every edge needs two triangles")
    if not mesh.is_winding_consistent:
        raise DescriptionError(f"{path}: some triangles face outwards and others inwards; export it with all normals outwards")
    mesh.fix_normals()
    convex = bool(abs(mesh.convex_hull.volume - mesh.volume) <= _CONVEX_SHARE * abs(mesh.volume))
    return Solid(np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64), convex)


def _check_box(mesh: Solid, size_m: np.ndarray, path: str) -> None:
    """Raises DescriptionError where a mesh does not roughly match the hull's box; `size_m` (3,) are the box's edges."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    off = np.maximum(np.abs(low + 0.5 * size_m), np.abs(high - 0.5 * size_m))
    if np.any(off > _BOX_SHARE * size_m):
        reach = ", ".join(f"{name} {a:.4g} to {b:.4g}" for name, a, b in zip("xyz", low, high, strict=True))
        edges = " x ".join(f"{edge:g}" for edge in size_m)
        what = f"the mesh reaches along {reach} m, and hull.size_m is a box of {edges} m about the origin"
        raise DescriptionError(f"{path}: {what}; both are in metres, forward, right, down from the middle of the hull")
