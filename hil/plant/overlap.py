"""Where two faces overlap, and how its corners share what presses the faces apart. Working memory is given: nothing is made here."""

from __future__ import annotations

import math

from hil.plant.vectors import callee, plus, times

CORNERS = 12
"""Room for the outline of an overlap: a square cut by a square has eight corners, and rounding must not overrun it."""
SAME_M = 1e-9
"""Corners of an outline that are nearer to each other are one."""


@callee
def _add_corner(outline, n, u, w):
    """Adds a corner to an outline of n unless it is there; how many it has then."""
    if n == CORNERS or (n > 0 and abs(outline[n - 1, 0] - u) + abs(outline[n - 1, 1] - w) < SAME_M):
        return n
    outline[n, 0], outline[n, 1] = u, w
    return n + 1


@callee
def _cut(outline, n, axis, sign, most, out):
    """Writes the part of an outline of n corners whose coordinate `axis` times sign is at most `most`; how many corners it has."""
    kept = 0
    for k in range(n):
        m = (k + 1) % n
        room, next_room = most - sign * outline[k, axis], most - sign * outline[m, axis]
        if room >= 0.0:
            kept = _add_corner(out, kept, outline[k, 0], outline[k, 1])
        if (room >= 0.0) != (next_room >= 0.0):
            share = room / (room - next_room)
            u = outline[k, 0] + share * (outline[m, 0] - outline[k, 0])
            w = outline[k, 1] + share * (outline[m, 1] - outline[k, 1])
            kept = _add_corner(out, kept, sign * most if axis == 0 else u, sign * most if axis == 1 else w)
    if kept > 1 and abs(out[kept - 1, 0] - out[0, 0]) + abs(out[kept - 1, 1] - out[0, 1]) < SAME_M:
        kept -= 1
    return kept


@callee
def overlap(outlines, middle, first, second, half_u, half_w):
    """Leaves the overlap of two faces, seen along the normal of one, in outlines[0]; how many corners it has, and its area.

    Args:
        middle, first, second: (3,) centre and half edges of the one face; of its coordinates the first two count.
        half_u, half_w: half edges of the other, whose centre is the origin.
    """
    wind = 1.0 if first[0] * second[1] > first[1] * second[0] else -1.0
    for k in range(4):
        a, b = 1.0 if k == 0 or k == 3 else -1.0, wind * (1.0 if k < 2 else -1.0)
        p = plus(middle, plus(times(a, first), times(b, second)))
        outlines[0, k, 0], outlines[0, k, 1] = p[0], p[1]
    n, area = 4, 0.0
    for k in range(4):
        sign = 1.0 if k % 2 == 0 else -1.0
        n = _cut(outlines[k % 2], n, k // 2, sign, half_u if k < 2 else half_w, outlines[1 - k % 2])
    for k in range(n):
        m = (k + 1) % n
        area += 0.5 * (outlines[0, k, 0] * outlines[0, m, 1] - outlines[0, m, 0] * outlines[0, k, 1])
    return n, area


@callee
def turning(outline, n, k):
    """Angle by which an outline of n corners turns at its corner k, share of the whole turn."""
    before, after = (k + n - 1) % n, (k + 1) % n
    a = (outline[k, 0] - outline[before, 0], outline[k, 1] - outline[before, 1])
    b = (outline[after, 0] - outline[k, 0], outline[after, 1] - outline[k, 1])
    return math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]) / (2.0 * math.pi)
