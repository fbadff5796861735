"""Exposure of docked modules to the flow: modules shelter each other. Computed once when bodies merge or split.

For a direction of flow, every ray that starts on the surface of a module either leaves the body or hits another module. The share of
rays that leave, weighted by the part of the module's projected area that each represents, times that area is the module's share of the
projected area of the whole body; the shares add up to it exactly. Flow from either end counts half: front and rear carry the pressure
together, so the force is the same from ahead and astern.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from hil.plant.vectors import F1, F2, F8, I8, V3, callee, compiled, matrix_of, minus, triple, turn_back

F4, F5 = F8[:, :, :, ::1], F8[:, :, :, :, ::1]
GRAZING = 1e-9
"""Shortest path inside a hull, m, that blocks a ray; docked faces lie in one plane, so grazing rays must pass."""
FINE, COARSE = (13, 8), (7, 4)
"""(nodes along a side of the map, rays along an edge of a face), for up to MANY_MODULES modules and for more."""
MANY_MODULES = 12


@callee
def _blocked(start, d, boxes, own, centre, inside):
    """Whether the ray from `start` along d (both in the frame of module `own`) hits a box of another owner.

    boxes: (k, 11) owner, centre (3), quaternion (4), half edges (3), all in the body frame.
    """
    origin = (
        inside[0][0] * start[0] + inside[0][1] * start[1] + inside[0][2] * start[2] + centre[0],
        inside[1][0] * start[0] + inside[1][1] * start[1] + inside[1][2] * start[2] + centre[1],
        inside[2][0] * start[0] + inside[2][1] * start[1] + inside[2][2] * start[2] + centre[2],
    )
    way = (
        inside[0][0] * d[0] + inside[0][1] * d[1] + inside[0][2] * d[2],
        inside[1][0] * d[0] + inside[1][1] * d[1] + inside[1][2] * d[2],
        inside[2][0] * d[0] + inside[2][1] * d[1] + inside[2][2] * d[2],
    )
    for k in range(boxes.shape[0]):
        if int(boxes[k, 0]) == own:
            continue
        r = matrix_of(boxes[k, 4], boxes[k, 5], boxes[k, 6], boxes[k, 7])
        a = turn_back(r, minus(origin, triple(boxes, k, 1)))
        step = turn_back(r, way)
        enter, leave = 0.0, 1e9
        for i in range(3):
            if abs(step[i]) < 1e-12:
                if abs(a[i]) > boxes[k, 8 + i] - GRAZING:
                    leave = -1.0
                continue
            one, two = (-boxes[k, 8 + i] - a[i]) / step[i], (boxes[k, 8 + i] - a[i]) / step[i]
            enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
        if leave - enter > GRAZING:
            return True
    return False


@compiled(types.void(V3, F8, F2, I8, I8, F1), makes_arrays=True)
def _look(d, weight, boxes, own, rays, out):
    """Adds to out (4,) the part of box `own` exposed to direction d: share of its projected area, and that times its centre."""
    half = triple(boxes, own, 8)
    inside = matrix_of(boxes[own, 4], boxes[own, 5], boxes[own, 6], boxes[own, 7])
    centre = triple(boxes, own, 1)
    outline = 4.0 * (half[1] * half[2] * abs(d[0]) + half[0] * half[2] * abs(d[1]) + half[0] * half[1] * abs(d[2]))
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        if abs(d[axis]) < 1e-12:
            continue
        carried = weight * 4.0 * half[u] * half[v] * abs(d[axis]) / outline / (rays * rays)
        for i in range(rays):
            for j in range(rays):
                p = np.empty(3)
                p[axis] = math.copysign(half[axis], d[axis])
                p[u] = half[u] * ((2 * i + 1) / rays - 1.0)
                p[v] = half[v] * ((2 * j + 1) / rays - 1.0)
                start = (p[0], p[1], p[2])
                if not _blocked(start, d, boxes, own, centre, inside):
                    out[0] += carried
                    for k in range(3):
                        out[1 + k] += carried * p[k]


@compiled(types.void(F2, I8, I8, F4), makes_arrays=True)
def _fill(boxes, own, rays, out):
    """Writes the map (3, n, n, 4) of module `own`, whose hull is row `own` of boxes."""
    n = out.shape[1]
    for axis in range(3):
        for i in range(n):
            for j in range(n):
                d = np.empty(3)
                d[axis] = 1.0
                d[(axis + 1) % 3], d[(axis + 2) % 3] = 2.0 * i / (n - 1) - 1.0, 2.0 * j / (n - 1) - 1.0
                d /= math.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
                ahead, astern = (d[0], d[1], d[2]), (-d[0], -d[1], -d[2])
                _look(ahead, 0.5, boxes, own, rays, out[axis, i, j])
                _look(astern, 0.5, boxes, own, rays, out[axis, i, j])


@callee
def seen_share(tables, k, d):
    """(share, share times centre (3)) of map k for flow along d (of any non-zero length), module frame; bilinear.

    The maps cover three sides of a cube, since opposite directions have the same share.
    """
    axis = 0 if abs(d[0]) >= abs(d[1]) and abs(d[0]) >= abs(d[2]) else (1 if abs(d[1]) >= abs(d[2]) else 2)
    n = tables.shape[2]
    x = 0.5 * (n - 1) * (1.0 + d[(axis + 1) % 3] / d[axis])
    y = 0.5 * (n - 1) * (1.0 + d[(axis + 2) % 3] / d[axis])
    i, j = min(int(x), n - 2), min(int(y), n - 2)
    x, y = x - i, y - j
    a, b, c, e = (1.0 - x) * (1.0 - y), (1.0 - x) * y, x * (1.0 - y), x * y
    t = tables
    return (
        a * t[k, axis, i, j, 0] + b * t[k, axis, i, j + 1, 0] + c * t[k, axis, i + 1, j, 0] + e * t[k, axis, i + 1, j + 1, 0],
        a * t[k, axis, i, j, 1] + b * t[k, axis, i, j + 1, 1] + c * t[k, axis, i + 1, j, 1] + e * t[k, axis, i + 1, j + 1, 1],
        a * t[k, axis, i, j, 2] + b * t[k, axis, i, j + 1, 2] + c * t[k, axis, i + 1, j, 2] + e * t[k, axis, i + 1, j + 1, 2],
        a * t[k, axis, i, j, 3] + b * t[k, axis, i, j + 1, 3] + c * t[k, axis, i + 1, j, 3] + e * t[k, axis, i + 1, j + 1, 3],
    )  # fmt: skip


def shelter_maps(positions: np.ndarray, quaternions: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(m, 3, n, n, 4) shelter maps of the modules of one body, for `seen_share`.

    Args:
        positions, quaternions: (m, 3) and (m, 4) of the hulls in the body frame; sizes: (m, 3) their edges, m.
    """
    m = len(positions)
    nodes, rays = FINE if m <= MANY_MODULES else COARSE
    boxes = np.hstack([np.arange(m)[:, None], positions, quaternions, 0.5 * np.asarray(sizes)]).astype(np.float64)
    maps = np.zeros((m, 3, nodes, nodes, 4))
    for own in range(m):
        _fill(np.ascontiguousarray(boxes), own, rays, maps[own])
    return maps


def refined(maps: np.ndarray, nodes: int) -> np.ndarray:
    """Interpolates the maps to a grid of `nodes` along a side; exact at nodes that both grids share."""
    old = np.linspace(0.0, 1.0, maps.shape[2])
    new = np.linspace(0.0, 1.0, nodes)
    weight = np.array([np.interp(new, old, row) for row in np.eye(len(old))])
    return np.ascontiguousarray(np.einsum("ia,jb,msijc->msabc", weight, weight, maps))


def side_shares(maps: np.ndarray) -> np.ndarray:
    """(m, 3) share of each module's sides across x, y and z that is exposed to flow along that axis."""
    middle = (maps.shape[2] - 1) // 2
    return maps[:, :, middle, middle, 0].copy()


def no_maps() -> np.ndarray:
    """Empty maps for a world in which every module is alone."""
    return np.zeros((0, 3, 2, 2, 4))
