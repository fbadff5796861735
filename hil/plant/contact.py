"""Forces between modules of different bodies: faces on faces, magnets, funnels. At every stage of the integration.

Every force has its counter-force at the same point, so that nothing here changes the momentum of all bodies together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from hil.plant.bodies import BODIES, MODULES, add_force, add_walls, touches
from hil.plant.overlap import overlap, turning
from hil.plant.vectors import (
    F2,
    F3,
    F8,
    I1,
    M3,
    V3,
    callee,
    compiled,
    cross,
    dot,
    matrix,
    matrix_of,
    minus,
    plus,
    times,
    triple,
    turn,
    turn_back,
)
from hil.plant.water import WATER

I8 = types.int64
NEAR_M = 0.14
"""Modules whose hulls' circumscribed spheres are further apart do not act on each other."""
FRICTION = 0.3
"""Largest friction of a corner, share of the normal force (synthetic)."""


class Faces(NamedTuple):
    """Docking faces of m modules."""

    kind: np.ndarray
    """(m, 6) 1 probe, -1 drogue, 0 none."""
    coil: np.ndarray
    """(m, 6) share of full current, -1 to 1."""
    inside: np.ndarray
    """(m, m) 1 where the probe of the pair is in the funnel; i < j."""
    stop: np.ndarray
    """(m, m) gap at which a jam holds the pair apart, m; 0: none."""
    outline: np.ndarray
    """(2, CORNERS, 2) working memory of `overlap`."""
    pull: float
    magnet_gap: float
    guide: float
    guide_damping: float
    turning: float
    turning_damping: float
    stiffness: float
    damping: float


FACES = types.NamedTuple((F2, F2, F2, F2, F3, *(F8,) * 8), Faces)


@compiled(M3(M3, M3))
def product(a, b):
    """a b."""
    x, y, z = (b[0][0], b[1][0], b[2][0]), (b[0][1], b[1][1], b[2][1]), (b[0][2], b[1][2], b[2][2])
    return (
        (dot(a[0], x), dot(a[0], y), dot(a[0], z)),
        (dot(a[1], x), dot(a[1], y), dot(a[1], z)),
        (dot(a[2], x), dot(a[2], y), dot(a[2], z)),
    )


@compiled(V3(M3, I8))
def column(r, k):
    """Column k of r: axis k of its frame."""
    return (r[0][k], r[1][k], r[2][k])


@callee
def pose_of(modules, x, m):
    """Hull centre in the world, and module frame to world."""
    b = modules.body[m]
    r = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    return plus(triple(x, b, 0), turn(r, triple(modules.position, m, 0))), product(r, matrix(modules.turn, m))


@callee
def velocity_at(x, b, p):
    """Velocity of body b's point that is at p, world."""
    r = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    at = turn_back(r, minus(p, triple(x, b, 0)))
    return turn(r, plus(triple(x, b, 7), cross(triple(x, b, 10), at)))


@callee
def push_apart(wrench, x, i, j, p, f):
    """Force f (world) on body j at the world point p, and its counter-force on body i."""
    ri = matrix_of(x[i, 3], x[i, 4], x[i, 5], x[i, 6])
    rj = matrix_of(x[j, 3], x[j, 4], x[j, 5], x[j, 6])
    add_force(wrench, j, turn_back(rj, minus(p, triple(x, j, 0))), turn_back(rj, f))
    add_force(wrench, i, turn_back(ri, minus(p, triple(x, i, 0))), turn_back(ri, times(-1.0, f)))


@callee
def turn_apart(wrench, x, i, j, n):
    """Moment n (world) on body j, and its counter-moment on body i."""
    ni = turn_back(matrix_of(x[i, 3], x[i, 4], x[i, 5], x[i, 6]), n)
    nj = turn_back(matrix_of(x[j, 3], x[j, 4], x[j, 5], x[j, 6]), n)
    for k in range(3):
        wrench[j, 3 + k] += nj[k]
        wrench[i, 3 + k] -= ni[k]


@callee
def face_to(r, d):
    """Face (0..5: +x, -x, +y, ...) of a module with axes r that looks most along d (world)."""
    inside = turn_back(r, d)
    axis = 0
    for k in range(1, 3):
        if abs(inside[k]) > abs(inside[axis]):
            axis = k
    return 2 * axis + (1 if inside[axis] < 0.0 else 0)


@callee
def _face_between(modules, r_i, r_j, at, i, j):
    """Face of module j that looks at module i, whose centre is `at` in j's frame; -1 where one of j's axes parts the hulls."""
    axis, widest = 0, -math.inf
    x, y, z = turn_back(r_j, column(r_i, 0)), turn_back(r_j, column(r_i, 1)), turn_back(r_j, column(r_i, 2))
    size = triple(modules.size, i, 0)
    for k in range(3):
        reach = 0.5 * (size[0] * abs(x[k]) + size[1] * abs(y[k]) + size[2] * abs(z[k]) + modules.size[j, k])
        if abs(at[k]) - reach > widest:
            axis, widest = k, abs(at[k]) - reach
    if widest > 0.0:
        return -1
    return 2 * axis + (1 if at[axis] < 0.0 else 0)


@callee
def _press(modules, faces, x, i, j, wrench):
    """The face of module i that looks at module j is pushed out of the face of j that looks at i, at the corners of their overlap.

    The stiffness is that of four corners where all of the smaller face overlaps, less by its area elsewhere. The corners of the
    overlap share it by the angles at which its outline turns there, so that none comes or goes with a jolt.
    """
    p_i, r_i = pose_of(modules, x, i)
    p_j, r_j = pose_of(modules, x, j)
    at = turn_back(r_j, minus(p_i, p_j))
    face = _face_between(modules, r_i, r_j, at, i, j)
    if face < 0:
        return
    axis, sign = face // 2, 1.0 if face % 2 == 0 else -1.0
    outward, u, w = times(sign, column(r_j, axis)), column(r_j, (axis + 1) % 3), column(r_j, (axis + 2) % 3)
    own = face_to(r_i, times(-1.0, outward)) // 2
    look = times(1.0 if dot(column(r_i, own), outward) < 0.0 else -1.0, column(r_i, own))
    frame = (u, w, outward)  # turns the world into along the face, along the face, out of it
    top = plus(p_j, times(0.5 * modules.size[j, axis], outward))
    middle = turn(frame, minus(plus(p_i, times(0.5 * modules.size[i, own], look)), top))
    size_u, size_w = modules.size[i, (own + 1) % 3], modules.size[i, (own + 2) % 3]
    wide, high = modules.size[j, (axis + 1) % 3], modules.size[j, (axis + 2) % 3]
    first = turn(frame, times(0.5 * size_u, column(r_i, (own + 1) % 3)))
    second = turn(frame, times(0.5 * size_w, column(r_i, (own + 2) % 3)))
    n, area = overlap(faces.outline, middle, first, second, 0.5 * wide, 0.5 * high)
    slope = turn(frame, look)
    whole, a, b = 4.0 * area / min(size_u * size_w, wide * high), modules.body[i], modules.body[j]
    for k in range(n if n > 2 else 0):
        s, t = faces.outline[0, k, 0], faces.outline[0, k, 1]
        height = middle[2] - (slope[0] * (s - middle[0]) + slope[1] * (t - middle[1])) / slope[2]
        if height >= 0.0:
            continue
        p = plus(top, plus(plus(times(s, u), times(t, w)), times(height, outward)))
        v = minus(velocity_at(x, a, p), velocity_at(x, b, p))
        share, out = whole * turning(faces.outline[0], n, k), dot(v, outward)
        normal = share * max(0.0, -faces.stiffness * height - faces.damping * out)
        along = minus(v, times(out, outward))
        speed = math.sqrt(dot(along, along))
        rub = min(share * faces.damping, FRICTION * normal / speed) if speed > 1e-9 else 0.0
        push_apart(wrench, x, b, a, p, minus(times(normal, outward), times(rub, along)))


@compiled(types.UniTuple(F8, 8)(MODULES, FACES, F2, I8, I8))
def mating(modules, faces, x, i, j):
    """(face of i, face of j, gap, lateral error, tilt, turn from the nearest of four, closing speed, whether probe and drogue)."""
    p_i, r_i = pose_of(modules, x, i)
    p_j, r_j = pose_of(modules, x, j)
    d = minus(p_j, p_i)
    f_i, f_j = face_to(r_i, d), face_to(r_j, times(-1.0, d))
    k_i, k_j = f_i // 2, f_j // 2
    n_i = times(1.0 if f_i % 2 == 0 else -1.0, column(r_i, k_i))
    n_j = times(1.0 if f_j % 2 == 0 else -1.0, column(r_j, k_j))
    a = plus(p_i, times(0.5 * modules.size[i, k_i], n_i))
    b = plus(p_j, times(0.5 * modules.size[j, k_j], n_j))
    way = minus(b, a)
    gap = dot(way, n_i)
    side = minus(way, times(gap, n_i))
    tilt = math.acos(max(-1.0, min(1.0, -dot(n_i, n_j))))
    u, w = column(r_i, (k_i + 1) % 3), column(r_j, (k_j + 1) % 3)
    angle = math.atan2(dot(w, cross(n_i, u)), dot(w, u))
    quarter = 0.5 * math.pi
    roll = angle - quarter * round(angle / quarter)
    middle = times(0.5, plus(a, b))
    closing = -dot(minus(velocity_at(x, modules.body[j], middle), velocity_at(x, modules.body[i], middle)), n_i)
    fits = 1.0 if faces.kind[i, f_i] * faces.kind[j, f_j] < 0.0 else 0.0
    return float(f_i), float(f_j), gap, math.sqrt(dot(side, side)), tilt, roll, closing, fits


@callee
def _mate(modules, faces, x, i, j, wrench):
    """Magnets, funnel and jam of the two faces that look at each other."""
    p_i, r_i = pose_of(modules, x, i)
    p_j, r_j = pose_of(modules, x, j)
    d = minus(p_j, p_i)
    f_i, f_j = face_to(r_i, d), face_to(r_j, times(-1.0, d))
    if faces.kind[i, f_i] * faces.kind[j, f_j] >= 0.0:
        return
    k_i, k_j = f_i // 2, f_j // 2
    n_i = times(1.0 if f_i % 2 == 0 else -1.0, column(r_i, k_i))
    n_j = times(1.0 if f_j % 2 == 0 else -1.0, column(r_j, k_j))
    a = plus(p_i, times(0.5 * modules.size[i, k_i], n_i))
    b = plus(p_j, times(0.5 * modules.size[j, k_j], n_j))
    way, middle, g0 = minus(b, a), times(0.5, plus(a, b)), faces.magnet_gap
    gap = dot(way, n_i)
    side = minus(way, times(gap, n_i))
    first, second = modules.body[i], modules.body[j]
    coil = 0.5 * (faces.coil[i, f_i] + faces.coil[j, f_j])
    if coil != 0.0:
        far = math.sqrt((max(0.0, gap) + g0) ** 2 + dot(side, side))  # the gradient of -1/far: a loop takes no work
        pull = coil * faces.pull * g0 * g0 / far**3
        push_apart(wrench, x, first, second, middle, times(-pull, plus(side, times(max(0.0, gap) + g0, n_i))))
    if faces.inside[i, j] == 0.0:
        return
    v = minus(velocity_at(x, second, middle), velocity_at(x, first, middle))
    sideways = minus(v, times(dot(v, n_i), n_i))
    spin = minus(turn(matrix_of(x[second, 3], x[second, 4], x[second, 5], x[second, 6]), triple(x, second, 10)),
                 turn(matrix_of(x[first, 3], x[first, 4], x[first, 5], x[first, 6]), triple(x, first, 10)))  # fmt: skip
    if faces.stop[i, j] > 0.0:  # jammed: neither sideways nor further in
        force = times(-faces.guide_damping, sideways)
        deep = faces.stop[i, j] - gap
        if deep > 0.0:
            normal = max(0.0, 4.0 * (faces.stiffness * deep - faces.damping * dot(v, n_i)))
            force = plus(force, times(normal, n_i))
        push_apart(wrench, x, first, second, middle, force)
        turn_apart(wrench, x, first, second, times(-faces.turning_damping, spin))
        return
    push_apart(wrench, x, first, second, middle, plus(times(-faces.guide, side), times(-faces.guide_damping, sideways)))
    u, w = column(r_i, (k_i + 1) % 3), column(r_j, (k_j + 1) % 3)
    angle = math.atan2(dot(w, cross(n_i, u)), dot(w, u))
    roll = angle - 0.5 * math.pi * round(angle / (0.5 * math.pi))
    moment = minus(times(faces.turning, cross(n_j, times(-1.0, n_i))), times(faces.turning * roll, n_i))
    turn_apart(wrench, x, first, second, minus(moment, times(faces.turning_damping, spin)))


@compiled(types.boolean(MODULES, F2, I8, I8))
def near(modules, x, i, j):
    """Whether modules i and j belong to different bodies and are close."""
    if modules.body[i] == modules.body[j]:
        return False
    p_i, _ = pose_of(modules, x, i)
    p_j, _ = pose_of(modules, x, j)
    d, a, b = minus(p_i, p_j), triple(modules.size, i, 0), triple(modules.size, j, 0)
    reach = 0.5 * (math.sqrt(dot(a, a)) + math.sqrt(dot(b, b))) + NEAR_M
    return dot(d, d) < reach * reach


@callee
def interact(bodies, modules, faces, x):
    """Adds what modules of different bodies do to each other to `bodies.wrench`."""
    count = modules.body.shape[0]
    for i in range(count):
        for j in range(i + 1, count):
            if near(modules, x, i, j):
                _press(modules, faces, x, i, j, bodies.wrench)
                _press(modules, faces, x, j, i, bodies.wrench)
                _mate(modules, faces, x, i, j, bodies.wrench)


@compiled(types.void(BODIES, MODULES, FACES, WATER, I1))
def touch(bodies, modules, faces, water, chosen):
    """Adds what walls and modules of other bodies do to the modules where `chosen` (m,) is 1 to `bodies.wrench`."""
    x, count = bodies.state, modules.body.shape[0]
    for m in range(count):
        if chosen[m] and touches(modules, m, water, x):
            add_walls(bodies, modules, m, water, x)
    for i in range(count):
        for j in range(i + 1, count):
            if chosen[i] + chosen[j] > 0 and near(modules, x, i, j):
                _press(modules, faces, x, i, j, bodies.wrench)
                _press(modules, faces, x, j, i, bodies.wrench)
                _mate(modules, faces, x, i, j, bodies.wrench)
