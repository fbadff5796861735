"""Contact surface of two overlapping boxes: the surface of equal depth. The caller provides working memory; nothing is allocated here.

The depth of a point in a box is its distance from the nearest face. Each pair of faces, one of either box, contributes a flat patch to
the surface on which the depths in both boxes are equal. All quantities are in the frame of the first box, origin at its centre.
"""

from __future__ import annotations

import math

from hil.plant.vectors import callee, column, cross, dot, minus, plus, times, triple, turn, turn_back

CORNERS = 24
"""Capacity for the outline of a patch: a square cut by eleven faces has fifteen corners; the margin covers rounding."""
FACES_OF_TWO = 12
SAME = 1e-12
"""Tolerance below which normals (and places, m) of two faces count as equal."""
LEAST = 1e-5
"""Smallest patch considered, share of the largest face of the overlap's bounding box."""
PARALLEL = 1e-6
"""Smallest angle, rad, at which two faces have an intersection line; below it the line would be lost in rounding."""


@callee
def _put(array, row, a):
    """Writes three numbers."""
    array[row, 0], array[row, 1], array[row, 2] = a


@callee
def _absolute(a):
    """Absolute value of each component."""
    return (abs(a[0]), abs(a[1]), abs(a[2]))


@callee
def shared_box(half, other, r, at):
    """Centre and half edges of a box, aligned with the first one, that contains the overlap; arguments as in `faces_that_meet`."""
    reach = (dot(other, _absolute(r[0])), dot(other, _absolute(r[1])), dot(other, _absolute(r[2])))
    low = (max(-half[0], at[0] - reach[0]), max(-half[1], at[1] - reach[1]), max(-half[2], at[2] - reach[2]))
    high = (min(half[0], at[0] + reach[0]), min(half[1], at[1] + reach[1]), min(half[2], at[2] + reach[2]))
    return times(0.5, plus(low, high)), times(0.5, minus(high, low))


@callee
def _least_overlap(half, other, r, at):
    """Smallest overlap along an axis of the first box, m, and that axis; arguments as in `faces_that_meet`."""
    axis, least = 0, math.inf
    for k in range(3):
        overlap = half[k] + dot(other, _absolute(r[k])) - abs(at[k])
        if overlap < least:
            axis, least = k, overlap
    return least, axis


@callee
def _list_faces(planes, n, half, middle, room, deepest, normal, place):
    """Lists the faces of a box, in its own frame, that may be the nearest face of a point in the overlap; returns the new count.

    Args:
        middle, room: of `shared_box`. deepest: largest depth of such a point, m.
        normal, place: of the face of the other box that looks at this one; all points of the overlap are behind it.
    """
    before = place - dot(normal, middle) + dot(_absolute(normal), room)  # how far the deepest corner of the overlap is behind that face
    for k in range(3):
        for sign in (1.0, -1.0):
            top, bottom = sign * middle[k] + room[k], max(sign * middle[k] - room[k], half[k] - deepest)
            slope = -sign * normal[k]
            best = before - (slope * sign * middle[k] + abs(slope) * room[k]) + max(slope * top, slope * bottom)
            if top > bottom and best > 0.0:
                planes[n, 0], planes[n, 1], planes[n, 2], planes[n, 3] = 0.0, 0.0, 0.0, half[k]
                planes[n, k] = sign
                n += 1
    return n


@callee
def faces_that_meet(planes, half, other, r, at):
    """Writes the faces that can be the nearest face of a point in both boxes.

    Returns the number of faces of the first box, the number in all, and the largest depth of a point in both boxes, m.

    Args:
        planes: (FACES_OF_TWO, 4) written: outward normal n and place h of each; a point x is h - n.x behind it.
        half, other: half edges of the two boxes. r, at: attitude and centre of the second one.
    """
    inverse, back = (column(r, 0), column(r, 1), column(r, 2)), times(-1.0, turn_back(r, at))
    least, axis = _least_overlap(half, other, r, at)
    least_other, axis_other = _least_overlap(other, half, inverse, back)
    deepest = 0.5 * min(least, least_other)
    if deepest <= 0.0:
        return 0, 0, deepest
    sign, sign_other = math.copysign(1.0, at[axis]), math.copysign(1.0, back[axis_other])
    look = times(sign_other, column(r, axis_other))
    middle, room = shared_box(half, other, r, at)
    first = _list_faces(planes, 0, half, middle, room, deepest, look, other[axis_other] + dot(look, at))
    look = times(sign, r[axis])
    middle, room = shared_box(other, half, inverse, back)
    last, n = _list_faces(planes, first, other, middle, room, deepest, look, half[axis] + dot(look, back)), first
    for k in range(first, last):
        normal = turn(r, triple(planes, k, 0))
        place = planes[k, 3] + dot(normal, at)
        if not _is_listed(planes, first, normal, place):
            _put(planes, n, normal)
            planes[n, 3] = place
            n += 1
    return first, n, deepest


@callee
def _is_listed(planes, n, normal, place):
    """Whether a face equals one of the first n listed faces, within SAME."""
    for k in range(n):
        off = minus(triple(planes, k, 0), normal)
        if dot(off, off) < SAME * SAME and abs(planes[k, 3] - place) < SAME:
            return True
    return False


@callee
def _cut(outlines, now, n, y, z, most):
    """Clips the outline of n corners in outlines[now] to (y, z).x <= `most`; returns the index of the result and its corner count."""
    least, largest = math.inf, -math.inf
    for k in range(n):
        room = most - (y * outlines[now, k, 0] + z * outlines[now, k, 1])
        least, largest, outlines[now, k, 2] = min(least, room), max(largest, room), room
    if least >= 0.0:
        return now, n
    if largest <= 0.0:
        return now, 0
    kept, out = 0, 1 - now
    u, w, room = outlines[now, n - 1, 0], outlines[now, n - 1, 1], outlines[now, n - 1, 2]
    for k in range(n):
        next_u, next_w, next_room = outlines[now, k, 0], outlines[now, k, 1], outlines[now, k, 2]
        if (next_room >= 0.0) != (room >= 0.0) and kept < CORNERS:
            share = room / (room - next_room)
            outlines[out, kept, 0], outlines[out, kept, 1] = u + share * (next_u - u), w + share * (next_w - w)
            kept += 1
        if next_room >= 0.0 and kept < CORNERS:
            outlines[out, kept, 0], outlines[out, kept, 1] = next_u, next_w
            kept += 1
        u, w, room = next_u, next_w, next_room
    return out, kept


@callee
def _three_points(outlines, now, n):
    """Quadrature of a convex outline of n corners: a third of its area, and three points in it, exact for second-degree polynomials.

    Three evenly spaced points on an ellipse with twice the area of the outline's standard-deviation ellipse reproduce centroid and
    second moments of the outline. That ellipse fits into any convex outline (into a triangle it just fits).
    """
    y0, z0 = outlines[now, 0, 0], outlines[now, 0, 1]
    area = y = z = yy = yz = zz = 0.0
    a, b = outlines[now, 1, 0] - y0, outlines[now, 1, 1] - z0
    for k in range(2, n):
        c, d = outlines[now, k, 0] - y0, outlines[now, k, 1] - z0
        part, u, w = 0.5 * (a * d - b * c), a + c, b + d
        area, y, z = area + part, y + part * u, z + part * w
        yy, yz, zz = yy + part * (a * a + c * c + u * u), yz + part * (a * b + c * d + u * w), zz + part * (b * b + d * d + w * w)
        a, b = c, d
    scale = 1.0 / (3.0 * area) if area > 0.0 else 0.0
    y, z = scale * y, scale * z
    yy, yz, zz = 0.25 * scale * yy - y * y, 0.25 * scale * yz - y * z, 0.25 * scale * zz - z * z
    along = math.sqrt(2.0 * max(0.0, yy))
    skew = 2.0 * yz / along if along > 0.0 else 0.0
    side = math.sqrt(1.5 * max(0.0, zz - 0.5 * skew * skew))
    y, z, u, w = y0 + y, z0 + z, 0.5 * along, 0.5 * skew
    return area / 3.0, (y + along, z + skew), (y - u, z - w + side), (y - u, z - w - side)


@callee
def _axes_along(n_a, n_b, apart):
    """Two directions in the surface of equal depth, not normalised: across the intersection line of two faces, and along it.

    For faces that are parallel within PARALLEL, two arbitrary directions in the surface.
    """
    line = cross(n_a, n_b)
    if dot(line, line) < PARALLEL * PARALLEL:
        x, y, z = apart
        line = (0.0, z, -y) if abs(x) < abs(y) + abs(z) else (-z, 0.0, x)
    return cross(line, apart), line


@callee
def patch(outlines, planes, count, a, b, middle, room, deepest):
    """Computes the patch of the surface of equal depth whose nearest faces are a of the first box and b of the second.

    Args:
        outlines: (2, CORNERS, 3) working memory: two coordinates along the surface, and the distance from a cut.
        planes, count, deepest: of `faces_that_meet`. middle, room: of `shared_box`.

    Returns a third of the area (0: there is no such patch), the normal, from the first box to the second, and three points
    (see `_three_points`).
    """
    n_a, n_b = triple(planes, a, 0), triple(planes, b, 0)
    apart = minus(n_a, n_b)
    shift, square = planes[a, 3] - planes[b, 3] - dot(apart, middle), dot(apart, apart)
    if square < SAME * SAME or abs(shift) > dot(room, _absolute(apart)):
        return 0.0, apart, apart, apart, apart
    start, (across, line) = plus(middle, times(shift / square, apart)), _axes_along(n_a, n_b, apart)
    # The depth is zero on the line where the two faces meet and rises from there; the patch ends where it exceeds `deepest`.
    rise, depth, scale = -dot(n_a, across), planes[a, 3] - dot(n_a, start), 1.0 / dot(across, across)
    high, side = scale * dot(room, _absolute(across)), dot(room, _absolute(line)) / dot(line, line)
    low = -high
    if rise * rise * scale > PARALLEL * PARALLEL:
        ends = (-depth / rise, (deepest - depth) / rise)
        low, high = max(low, min(ends[0], ends[1])), min(high, max(ends[0], ends[1]))
    unit, all_of_it = cross(across, line), max(room[0] * room[1], room[1] * room[2], room[2] * room[0])
    if low >= high or 0.25 * (high - low) ** 2 * side * side * dot(unit, unit) < (LEAST * all_of_it) ** 2:
        return 0.0, apart, apart, apart, apart
    for k in range(4):
        outlines[0, k, 0], outlines[0, k, 1] = low if k == 0 or k == 3 else high, -side if k < 2 else side
    n, now, centre, half = 4, 0, 0.5 * (low + high), 0.5 * (high - low)
    for k in range(count):
        if k == b:
            continue
        off = n_a if k == a else minus(triple(planes, k, 0), n_a)
        y, z, most = dot(off, across), dot(off, line), (depth if k == a else planes[k, 3] - planes[a, 3] - dot(off, start))
        if y * centre - abs(y) * half - abs(z) * side >= most:
            return 0.0, apart, apart, apart, apart
        if y * centre + abs(y) * half + abs(z) * side > most:
            now, n = _cut(outlines, now, n, y, z, most)
            if n < 3:
                return 0.0, apart, apart, apart, apart
    share, p, q, r = _three_points(outlines, now, n)
    normal = times(1.0 / math.sqrt(square), apart)
    p, q, r = _lift(start, across, line, p), _lift(start, across, line, q), _lift(start, across, line, r)
    return share * abs(dot(unit, normal)), normal, p, q, r


@callee
def _lift(start, across, line, p):
    """Transforms a point of the surface from its two surface coordinates to three dimensions."""
    return plus(start, plus(times(p[0], across), times(p[1], line)))
