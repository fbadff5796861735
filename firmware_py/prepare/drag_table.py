"""Drag table of an assembly: outlines on the nodes of a cube-map, coefficients, rotational damping.

The outlines depend only on geometry and are cached on disk (prepare.drag_cache) under a key that is invariant to rotation
and translation of the shape; coefficients, density and centre of mass are applied afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from firmware_py.core.body import DragTable
from firmware_py.core.drag_lookup import node_directions
from firmware_py.description.water import WATER_DENSITY
from firmware_py.prepare import shape_key
from firmware_py.prepare.drag_cache import DragCache
from firmware_py.prepare.joints import Placement
from firmware_py.prepare.lattice import MATRICES
from firmware_py.prepare.projected_area import Solid, areas_and_centroids
from firmware_py.prepare.shape_key import Part

NODES_PER_RIM = 13
"""6 x 13 x 13 = 1014 nodes; odd, so that the kinks of a cube's outline at zero components fall on nodes."""

_SUBDIVISIONS = 2
"""Each triangle of a hull becomes 4^2 for the damping integral: within 0.2 % for a cube."""

Outlines = Callable[[Sequence[Solid], np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Maps solids and (n, 3) directions to (n,) areas and (n, 3) centroids, as projected_area.areas_and_centroids does."""


def build(
    placements: Sequence[Placement],
    centre: np.ndarray,
    pitch_m: float,
    cache: DragCache | None = None,
    mode: str = "exact",
    method: Outlines = areas_and_centroids,
    nodes_per_rim: int = NODES_PER_RIM,
) -> DragTable:
    """The drag table of docked modules.

    Args:
        placements: the modules.
        centre: (3,) centre of mass in the lattice frame, m, about which moments are taken.
        pitch_m: lattice pitch.
        cache: cache of outlines; None computes them every time.
        mode: name of `method` in the key.
        method: computes the outlines.
        nodes_per_rim: grid size of each side of the cube-map.

    Returns:
        Arrays for core.drag_lookup; body axes are those of the lattice.
    """
    directions = node_directions(nodes_per_rim)
    nodes = np.zeros((6, nodes_per_rim, nodes_per_rim, 4))
    rotational, linear = np.zeros(3), np.zeros(6)
    by_area = [p for p in placements if not p.vehicle.drag.quadratic.size]
    if by_area:
        outline = _outlines(by_area, pitch_m, cache, mode, method, nodes_per_rim)
        nodes[..., 0] = 0.5 * WATER_DENSITY * coefficient(by_area, directions) * outline[..., 0]
        nodes[..., 1:] = outline[..., 1:] - centre
        rotational += rotational_damping(placements, centre, pitch_m)
    for placement in placements:
        turn = MATRICES[placement.rotation]
        linear += (np.abs(turn) @ placement.vehicle.drag.linear.reshape(2, 3).T).T.ravel()
        if placement.vehicle.drag.quadratic.size:
            _add_published(placement, turn, directions, pitch_m * np.array(placement.cell) - centre, nodes)
            rotational += np.abs(turn) @ placement.vehicle.drag.quadratic[3:]
    nodes[..., 1:] -= np.sum(nodes[..., 1:] * directions, axis=-1, keepdims=True) * directions
    return DragTable(nodes, rotational, linear)


def coefficient(placements: Sequence[Placement], directions: np.ndarray) -> np.ndarray:
    """(...,) drag coefficient for flow along (..., 3) unit directions: the modules' coefficients weighted by their surface.

    Linear in the quartic cubic harmonic s = sum d_i^4, which is 1 on a face, 1/2 on an edge and 1/3 at a corner, through the
    values on face and edge. s is the same under all 24 rotations, so a module's rotation does not enter.
    """
    s = np.sum(directions**4, axis=-1)
    total, weights = np.zeros(s.shape), 0.0
    for placement in placements:
        size = placement.vehicle.hull.size_m
        weight = float(size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
        corner = placement.vehicle.cd_corner
        total += weight * (corner + (placement.vehicle.drag.cd_face - corner) * (3.0 * s - 1.0) / 2.0)
        weights += weight
    return np.asarray(total / weights)


def _add_published(
    placement: Placement, turn: np.ndarray, directions: np.ndarray, position: np.ndarray, nodes: np.ndarray
) -> None:
    """Adds the component of a vehicle's published quadratic damping along the flow: F . d = -sum q_i |d_i|^3."""
    c = np.abs(directions @ turn) ** 3 @ placement.vehicle.drag.quadratic[:3]
    total = nodes[..., 0] + c
    share = np.divide(c, total, out=np.zeros_like(c), where=total > 0.0)[..., None]
    nodes[..., 1:] += share * (position - nodes[..., 1:])
    nodes[..., 0] = total


def rotational_damping(placements: Sequence[Placement], centre: np.ndarray, pitch_m: float) -> np.ndarray:
    """(3,) quadratic damping about the body axes through `centre`, N m s^2.

    Integrates the law of the drag table over the hull's surface, dF = -1/2 rho Cd max(n . v, 0) v dS with v = w x r: for unit
    w along axis k the moment is 1/2 rho Cd times the integral of max(n . (e_k x r), 0) times the squared distance from the
    axis. Triangles on a docked face are left out.
    """
    total = np.zeros(3)
    occupied = {p.cell for p in placements}
    for placement in placements:
        if placement.vehicle.drag.quadratic.size:
            continue
        for solid in shape_key.solids([_part(placement)], pitch_m):
            points, normals = _surface(solid, _open_triangles(solid, placement.cell, occupied, pitch_m))
            r = points - centre
            speed = np.maximum(np.einsum("ti,kti->kt", normals, np.cross(np.eye(3)[:, None], r[None])), 0.0)
            off_axis = np.sum(r * r, axis=1) - r.T**2
            total += 0.5 * WATER_DENSITY * placement.vehicle.drag.rotational_cd * np.sum(speed * off_axis, axis=1)
    return total


def _open_triangles(
    solid: Solid, cell: tuple[int, int, int], occupied: set[tuple[int, int, int]], pitch_m: float
) -> np.ndarray:
    keep = np.ones(len(solid.triangles), dtype=bool)
    corners = solid.vertices[solid.triangles] / pitch_m - np.array(cell)
    for axis in range(3):
        for sign in (1, -1):
            neighbour = tuple(c + sign * (k == axis) for k, c in enumerate(cell))
            if neighbour in occupied:
                keep &= ~np.all(sign * corners[:, :, axis] > 0.5 - 1e-6, axis=1)
    return keep


def _surface(solid: Solid, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature points (k, 3) and normals times area (k, 3): the second-order mid-edge rule on subdivided triangles."""
    corners = solid.vertices[solid.triangles[keep]]
    for _ in range(_SUBDIVISIONS):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        corners = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 6.0
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    return middles.reshape(-1, 3), np.repeat(normals, 3, axis=0)


def _part(placement: Placement) -> Part:
    return shape_key.part(placement.vehicle, placement.cell, placement.rotation)


def _outlines(
    placements: Sequence[Placement], pitch_m: float, cache: DragCache | None, mode: str, method: Outlines, n: int
) -> np.ndarray:
    """(6, n, n, 4) area and centroid in the lattice frame, converted from those of the canonical shape."""
    shape = shape_key.canonical([_part(p) for p in placements], pitch_m)
    key = f"{mode} {n} {shape.key}"
    values = cache.load(key, (6, n, n, 4)) if cache else None
    if values is None:
        values = _measure(shape_key.solids(shape.parts, pitch_m), node_directions(n), method)
        if cache:
            cache.store(key, values)
    turned = values[shape_key.turned_nodes(shape.rotation, n)]
    back = MATRICES[shape.rotation]
    return np.concatenate([turned[..., :1], turned[..., 1:] @ back.T + pitch_m * shape.origin], axis=-1)


def _measure(solids: Sequence[Solid], directions: np.ndarray, method: Outlines) -> np.ndarray:
    """(..., 4) area and centroid on each node. Opposite nodes have the same outline and rims are shared: each is computed once."""
    flat = directions.reshape(-1, 3)
    leading = flat[np.arange(len(flat)), np.argmax(np.round(np.abs(flat), 9) > 0.0, axis=1)]
    half = np.round(flat * np.sign(leading)[:, None], 9)
    _, where, inverse = np.unique(half, axis=0, return_index=True, return_inverse=True)
    areas, centroids = method(solids, flat[where])
    values = np.concatenate([areas[:, None], centroids], axis=1)
    return np.asarray(values[inverse.ravel()].reshape(*directions.shape[:-1], 4))
