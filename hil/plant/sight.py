"""Visibility of tags to a camera: which face it, are in view and not occluded by a hull. Once per picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import types

from firmware_py.description.vehicle import Vehicle
from hil.plant.vectors import (
    F1,
    F2,
    F8,
    V3,
    callee,
    compiled,
    dot,
    matrix_of,
    minus,
    plus,
    times,
    triple,
    turn,
    turn_back,
)  # fmt: skip

OUT_OF_SIGHT = -1.0


@callee
def crosses(a, b, boxes, k, poses):
    """Whether the segment from a to b (world) crosses box k (slab test)."""
    m = int(boxes[k, 0])
    hull = matrix_of(poses[m, 3], poses[m, 4], poses[m, 5], poses[m, 6])
    inside = turn_back(hull, minus(a, triple(poses, m, 0)))
    start = minus(inside, triple(boxes, k, 1))
    step = turn_back(hull, minus(b, a))
    enter, leave = 0.0, 1.0
    for i in range(3):
        half = boxes[k, 4 + i]
        if abs(step[i]) < 1e-12:
            if abs(start[i]) > half:
                return False
            continue
        one, two = (-half - start[i]) / step[i], (half - start[i]) / step[i]
        enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
    return enter < leave


@compiled(types.void(V3, V3, F8, F2, F2, F2, F1))
def look(eye, axis, cos_view, poses, tags, boxes, out):
    """Writes the cosine between each tag's outward normal and the line of sight; OUT_OF_SIGHT where the tag is not visible.

    Args:
        eye, axis: lens and optical axis, world; cos_view: cosine of the half angle of the cone of view.
        poses: (m, 7) hull centre and quaternion of every module, world.
        tags: (t, 7) module, centre (3) and outward normal (3) in the module frame.
        boxes: (k, 7) module, centre (3) in the module frame, half edges (3): for each module its hull, which does not hide its own
            tags, followed by its payloads.
    """
    for t in range(tags.shape[0]):
        m = int(tags[t, 0])
        r = matrix_of(poses[m, 3], poses[m, 4], poses[m, 5], poses[m, 6])
        p = plus(triple(poses, m, 0), turn(r, triple(tags, t, 1)))
        line = minus(eye, p)
        sight = times(1.0 / np.sqrt(dot(line, line)), line)
        out[t] = dot(turn(r, triple(tags, t, 4)), sight)
        if -dot(sight, axis) < cos_view:
            out[t] = OUT_OF_SIGHT
        if out[t] <= 0.0:
            continue
        for k in range(boxes.shape[0]):
            is_own_hull = int(boxes[k, 0]) == m and (k == 0 or int(boxes[k - 1, 0]) != m)
            if not is_own_hull and crosses(p, eye, boxes, k, poses):
                out[t] = OUT_OF_SIGHT
                break


def solid_boxes(vehicles: Sequence[Vehicle]) -> np.ndarray:
    """(k, 7) argument `boxes` of `look`: the hull and the payloads of every module."""
    rows = []
    for m, vehicle in enumerate(vehicles):
        rows.append([m, 0.0, 0.0, 0.0, *(0.5 * vehicle.hull.size_m)])
        rows += [[m, *p.position_m, *(0.5 * p.size_m)] for p in vehicle.payload]
    return np.array(rows, dtype=np.float64)
