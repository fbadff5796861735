"""Forces between modules of different bodies: hull contact, magnets, funnels. Evaluated at every stage of the integration.

Every force has its counter-force at the same point, so the total momentum of all bodies is conserved.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from hil.plant.bodies import BODIES, MODULES, add_walls, touches
from hil.plant.overlap import faces_that_meet, patch, shared_box
from hil.plant.pairs import centre_of, pose_of, push_apart, rate_of, turn_apart, turn_into, velocity_at
from hil.plant.vectors import (
    F2,
    F3,
    F8,
    I1,
    I8,
    callee,
    column,
    compiled,
    cross,
    dot,
    inlined,
    minus,
    plus,
    times,
    triple,
    turn,
    turn_back,
)
from hil.plant.water import WATER

NEAR_M = 0.14
"""Range of interaction: modules do not act on each other when the circumscribed spheres of their hulls are further apart."""
FRICTION = 0.3
"""Largest friction between hulls, share of the normal force (synthetic)."""


class Faces(NamedTuple):
    """Docking faces of m modules."""

    kind: np.ndarray
    """(m, 6) 1 probe, -1 drogue, 0 none."""
    coil: np.ndarray
    """(m, 6) share of full current, -1 to 1."""
    inside: np.ndarray
    """(m, m) 1 where the probe of the pair i < j is in the funnel."""
    stop: np.ndarray
    """(m, m) gap at which a jam holds the pair apart, m; 0: no jam."""
    outline: np.ndarray
    """(2, CORNERS, 3) working memory of `overlap.patch`."""
    planes: np.ndarray
    """(FACES_OF_TWO, 4) working memory of `overlap.faces_that_meet`."""
    pull: float
    magnet_gap: float
    guide: float
    guide_damping: float
    turning: float
    turning_damping: float
    jam: float
    """Stiffness and damping of a probe that is jammed in its funnel, N/m and N s/m."""
    jam_damping: float
    stiffness: float
    """Pressure per depth of an overlap of two hulls, N/m^3."""
    damping: float
    """Pressure per speed, N s/m^3."""


FACES = types.NamedTuple((F2, F2, F2, F2, F3, F2, *(F8,) * 10), Faces)


@callee
def face_to(r, d):
    """Face (0..5: +x, -x, +y, ...) of a module with axes r whose outward normal is closest to d (world)."""
    inside = turn_back(r, d)
    axis = 0
    for k in range(1, 3):
        if abs(inside[k]) > abs(inside[axis]):
            axis = k
    return 2 * axis + (1 if inside[axis] < 0.0 else 0)


@callee
def _surface_traction(plane, normal, p, v, w, faces):
    """Pressure and friction on the second of two hulls, N/m^2, at a point p of the surface between them. All in the first hull's frame.

    Args:
        plane: (4,) face of the first hull, see `overlap.faces_that_meet`. normal: of the surface.
        v, w: velocity and angular rate of the second hull relative to the first, at the first hull's centre.
    """
    depth, slip = plane[3] - (plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2]), plus(v, cross(w, p))
    out = dot(slip, normal)
    pressure = max(0.0, 2.0 * faces.stiffness * depth - faces.damping * out)
    along = minus(slip, times(out, normal))
    speed = math.sqrt(dot(along, along))
    rub = min(faces.damping, FRICTION * pressure / speed) if speed > 1e-9 else 0.0
    return minus(times(pressure, normal), times(rub, along))


@callee
def _add_hull_contact(modules, faces, x, i, j, seats, wrench):
    """Adds the contact force between the overlapping hulls i and j.

    Each hull is a bed of springs whose pressure rises with the depth below the nearest face. The contact surface is where both depths
    are equal (Elandt et al., A pressure field model, IROS 2019). The spring force is the gradient of an energy, the volume integral of
    the smaller of the two pressures over the overlap, for any pair of faces at any tilt: the springs return exactly the energy put in.
    """
    (p_i, r_i), (p_j, r_j) = seats
    half, other = times(0.5, triple(modules.size, i, 0)), times(0.5, triple(modules.size, j, 0))
    r, at = turn_into(r_i, r_j), turn_back(r_i, minus(p_j, p_i))
    own, count, deepest = faces_that_meet(faces.planes, half, other, r, at)
    if count == 0:
        return
    middle, room = shared_box(half, other, r, at)
    first, second = modules.body[i], modules.body[j]
    v = turn_back(r_i, minus(velocity_at(x, second, p_i), velocity_at(x, first, p_i)))
    w = turn_back(r_i, minus(rate_of(x, second), rate_of(x, first)))
    f, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for a in range(own):
        for b in range(own, count):
            share, normal, p_1, p_2, p_3 = patch(faces.outline, faces.planes, count, a, b, middle, room, deepest)
            if share > 0.0:
                for p in (p_1, p_2, p_3):
                    push = times(share, _surface_traction(faces.planes[a], normal, p, v, w, faces))
                    f, moment = plus(f, push), plus(moment, cross(p, push))
    push_apart(wrench, x, first, second, p_i, turn(r_i, f))
    turn_apart(wrench, x, first, second, turn(r_i, moment))


@callee
def _outward(r, f):
    """Outward unit normal of face f of a module with axes r."""
    return times(1.0 if f % 2 == 0 else -1.0, column(r, f // 2))


@callee
def _facing(modules, i, j, seats):
    """Faces of i and j that face each other, their outward normals, centres, gap and lateral offset; world."""
    (p_i, r_i), (p_j, r_j) = seats
    d = minus(p_j, p_i)
    f_i, f_j = face_to(r_i, d), face_to(r_j, times(-1.0, d))
    n_i, n_j = _outward(r_i, f_i), _outward(r_j, f_j)
    a = plus(p_i, times(0.5 * modules.size[i, f_i // 2], n_i))
    b = plus(p_j, times(0.5 * modules.size[j, f_j // 2], n_j))
    way = minus(b, a)
    gap = dot(way, n_i)
    return (f_i, f_j), (n_i, n_j), (a, b), gap, minus(way, times(gap, n_i))


@callee
def _roll(seats, facing, normal):
    """Rotation of the second of two faces about the first one's normal, relative to the nearest quarter turn."""
    (_, r_i), (_, r_j) = seats
    u, w = column(r_i, (facing[0] // 2 + 1) % 3), column(r_j, (facing[1] // 2 + 1) % 3)
    angle, quarter = math.atan2(dot(w, cross(normal, u)), dot(w, u)), 0.5 * math.pi
    return angle - quarter * round(angle / quarter)


@compiled(types.UniTuple(F8, 8)(MODULES, FACES, F2, I8, I8))
def mating(modules, faces, x, i, j):
    """(face of i, face of j, gap, lateral error, tilt, roll from the nearest quarter turn, closing speed, 1 if probe and drogue)."""
    seats = (pose_of(modules, x, i), pose_of(modules, x, j))
    (f_i, f_j), (n_i, n_j), (a, b), gap, side = _facing(modules, i, j, seats)
    tilt, roll = math.acos(max(-1.0, min(1.0, -dot(n_i, n_j)))), _roll(seats, (f_i, f_j), n_i)
    middle = times(0.5, plus(a, b))
    closing = -dot(minus(velocity_at(x, modules.body[j], middle), velocity_at(x, modules.body[i], middle)), n_i)
    fits = 1.0 if faces.kind[i, f_i] * faces.kind[j, f_j] < 0.0 else 0.0
    return float(f_i), float(f_j), gap, math.sqrt(dot(side, side)), tilt, roll, closing, fits


@callee
def _add_docking_forces(modules, faces, x, i, j, seats, wrench):
    """Adds the forces of magnets, funnel and jam between the two faces that face each other."""
    (f_i, f_j), (n_i, n_j), (_, b), gap, side = _facing(modules, i, j, seats)
    if faces.kind[i, f_i] * faces.kind[j, f_j] >= 0.0:
        return
    g0, first, second = faces.magnet_gap, modules.body[i], modules.body[j]
    coil = 0.5 * (faces.coil[i, f_i] + faces.coil[j, f_j])
    if coil != 0.0:
        far = math.sqrt((max(0.0, gap) + g0) ** 2 + dot(side, side))  # force is the gradient of -1/far, hence conservative
        pull = coil * faces.pull * g0 * g0 / far**3
        push_apart(wrench, x, first, second, b, times(-pull, plus(side, times(max(0.0, gap) + g0, n_i))))
    if faces.inside[i, j] == 0.0:
        return
    v = minus(velocity_at(x, second, b), velocity_at(x, first, b))
    sideways = minus(v, times(dot(v, n_i), n_i))
    spin = minus(rate_of(x, second), rate_of(x, first))
    if faces.stop[i, j] > 0.0:  # jammed: damped sideways, stopped from going further in
        force = times(-faces.guide_damping, sideways)
        deep = faces.stop[i, j] - gap
        if deep > 0.0:
            normal = max(0.0, faces.jam * deep - faces.jam_damping * dot(v, n_i))
            force = plus(force, times(normal, n_i))
        push_apart(wrench, x, first, second, b, force)
        turn_apart(wrench, x, first, second, times(-faces.turning_damping, spin))
        return
    push_apart(wrench, x, first, second, b, plus(times(-faces.guide, side), times(-faces.guide_damping, sideways)))
    roll = _roll(seats, (f_i, f_j), n_i)
    moment = minus(times(faces.turning, cross(n_j, times(-1.0, n_i))), times(faces.turning * roll, n_i))
    turn_apart(wrench, x, first, second, minus(moment, times(faces.turning_damping, spin)))


@inlined
def _is_near(modules, x, i, j):
    """Inlined body of `near`."""
    if modules.body[i] == modules.body[j]:
        return False
    d, a, b = minus(centre_of(modules, x, i), centre_of(modules, x, j)), triple(modules.size, i, 0), triple(modules.size, j, 0)
    reach = 0.5 * (math.sqrt(dot(a, a)) + math.sqrt(dot(b, b))) + NEAR_M
    return dot(d, d) < reach * reach


@compiled(types.boolean(MODULES, F2, I8, I8))
def near(modules, x, i, j):
    """Whether modules i and j belong to different bodies and are close enough to interact."""
    return _is_near(modules, x, i, j)


@callee
def _add_pair_forces(modules, faces, x, i, j, wrench):
    """Adds all forces between two modules i and j that are near each other."""
    seats = (pose_of(modules, x, i), pose_of(modules, x, j))
    _add_hull_contact(modules, faces, x, i, j, seats, wrench)
    _add_docking_forces(modules, faces, x, i, j, seats, wrench)


@callee
def interact(bodies, modules, faces, x):
    """Adds the forces between modules of different bodies to `bodies.wrench`."""
    count = modules.body.shape[0]
    for i in range(count):
        for j in range(i + 1, count):
            if _is_near(modules, x, i, j):
                _add_pair_forces(modules, faces, x, i, j, bodies.wrench)


@compiled(types.void(BODIES, MODULES, FACES, WATER, I1))
def touch(bodies, modules, faces, water, chosen):
    """Adds wall and contact forces of the modules where `chosen` (m,) is 1 to `bodies.wrench`.

    A contact adds its counter-force to the other body as well.
    """
    x, count = bodies.state, modules.body.shape[0]
    for m in range(count):
        if chosen[m] and touches(modules, m, water, x):
            add_walls(bodies, modules, m, water, x)
    for i in range(count):
        for j in range(i + 1, count):
            if chosen[i] + chosen[j] > 0 and _is_near(modules, x, i, j):
                _add_pair_forces(modules, faces, x, i, j, bodies.wrench)
