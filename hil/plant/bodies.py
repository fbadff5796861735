"""Motion of rigid bodies in water: Kirchhoff's equations.

A body is one or more rigidly docked modules. Its frame has the axes of their lattice and its origin O at the centre of the first
hull. Its state, (13,): position of O in the world, quaternion body to world, velocity of O and angular rate in the body frame.

The momenta are those of robot and entrained water (p, L) and of the water outside (h, l: added mass times velocity relative to
the water), all about O in the body frame (Lamb, Hydrodynamics, ch. VI):
    d(p + h)/dt = F - w x (p + h),    d(L + l)/dt = N - w x (L + l) - v x p - v_r x h.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from hil.plant import drag
from hil.plant.shelter import F5, seen_share
from hil.plant.vectors import (
    F1,
    F2,
    F3,
    F8,
    I1,
    V3,
    callee,
    compiled,
    cross,
    inlined,
    mass_of,
    mass_times,
    matrix,
    matrix_of,
    minus,
    plus,
    six,
    times,
    triple,
    turn,
    turn_back,
)  # fmt: skip
from hil.plant.water import is_clear, push_of_walls, room

NEAR_M = 1e-6
"""Margin on a hull's half diagonal against rounding errors."""


class Bodies(NamedTuple):
    """Arrays over b bodies."""

    state: np.ndarray
    """(b, 13)."""
    rigid: np.ndarray
    """(b, 6, 6) mass matrix of robot and entrained water about O."""
    added: np.ndarray
    """(b, 6, 6) added mass about O."""
    inverse: np.ndarray
    """(b, 6, 6) inverse of rigid plus added mass."""
    weight: np.ndarray
    """(b, 8) weight W, entrained water included, and buoyancy B, N; W r_W and B r_B, N m."""
    hull: np.ndarray
    """(b, 4) mass of the water that the hulls displace, entrained water included, kg; mass times centre, kg m."""
    wrench: np.ndarray
    """(b, 6) working memory: force and moment about O, body frame."""
    clamped: np.ndarray
    """(b,) 1 where a load cell holds the body in place."""


class Modules(NamedTuple):
    """Arrays over m modules."""

    body: np.ndarray
    """(m,) index of the body."""
    position: np.ndarray
    """(m, 3) hull centre in the body frame."""
    turn: np.ndarray
    """(m, 3, 3) module frame to body frame."""
    quaternion: np.ndarray
    """(m, 4) the same rotation as a quaternion."""
    size: np.ndarray
    """(m, 3) edges of the hull."""
    drag: np.ndarray
    """(m, 5) coefficients: face-on, edge-on, of rotation about x, y, z."""
    linear: np.ndarray
    """(m, 6) linear damping."""
    quadratic: np.ndarray
    """(m, 6) quadratic damping that a vehicle file publishes in place of areas."""
    shelter: np.ndarray
    """(m,) row of the module in `maps`; -1: the only module of its body."""
    sides: np.ndarray
    """(m, 3) share of the hull's sides across x, y, z that no other module covers."""
    maps: np.ndarray
    """(k, 3, n, n, 4) shelter maps, see `shelter.seen_share`."""


BODIES = types.NamedTuple((F2, F3, F3, F3, F2, F2, F2, I1), Bodies)
MODULES = types.NamedTuple((I1, F2, F3, F2, F2, F2, F2, F2, I1, F2, F5), Modules)


@inlined
def add_force(wrench, b, at, f):
    """Adds the force f at the point `at` to row b of wrenches; body frame."""
    n = cross(at, f)
    for i in range(3):
        wrench[b, i] += f[i]
        wrench[b, 3 + i] += n[i]


@inlined
def weigh(weight, weight_at, lift, lift_at, displaced, displaced_at, r, flow_rate):
    """Force and moment of weight, buoyancy and the pressure gradient of accelerating water (Froude-Krylov), body frame.

    Args:
        weight, lift, displaced: N, N, kg; `_at`: each multiplied by its point of action, N m, N m, kg m.
        r: body to world. flow_rate: acceleration of the water, world.
    """
    down, rate = r[2], turn_back(r, flow_rate)
    f = plus(times(weight - lift, down), times(displaced, rate))
    return f, plus(cross(minus(weight_at, lift_at), down), cross(displaced_at, rate))


@inlined
def respond(rigid, added, inverse, r, v, w, flow, flow_rate, f, n):
    """Solves Kirchhoff's equations for the linear acceleration of O and the angular acceleration, body frame.

    Args:
        rigid, added, inverse: mass matrices, see `Bodies`.
        r: body to world. v, w: velocity of O and rate, body frame. flow, flow_rate: velocity and acceleration of the water, world.
        f, n: force and moment about O.
    """
    u = turn_back(r, flow)
    slip = minus(v, u)
    carried = minus(cross(w, u), turn_back(r, flow_rate))  # dv_r/dt = dv/dt + carried
    (p, spin), (h, swirl) = mass_times(rigid, v, w), mass_times(added, slip, w)
    f = minus(minus(f, turn(added[0], carried)), cross(w, plus(p, h)))
    n = minus(minus(n, turn(added[2], carried)), cross(w, plus(spin, swirl)))
    n = minus(minus(n, cross(v, p)), cross(slip, h))
    return mass_times(inverse, f, n)


@inlined
def turning(q, w):
    """Time derivative of the quaternion q, body to world, at the angular rate w, body frame."""
    return (
        -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]),
        0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]),
        0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]),
        0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]),
    )


@inlined
def _add_weight(bodies, b, x, flow_rate):
    """Adds the result of `weigh` to the wrench of body b."""
    weight, hull, r = bodies.weight, bodies.hull, matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    f, n = weigh(
        weight[b, 0], triple(weight, b, 2), weight[b, 1], triple(weight, b, 5), hull[b, 0], triple(hull, b, 1), r, flow_rate
    )
    for i in range(3):
        bodies.wrench[b, i] += f[i]
        bodies.wrench[b, 3 + i] += n[i]


@inlined
def _add_drag(bodies, modules, m, water, x, flow):
    """Adds the drag of one module at its hull centre, from its velocity relative to the water."""
    b = modules.body[m]
    r, at, inside = (
        matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]),
        triple(modules.position, m, 0),
        matrix(modules.turn, m),
    )
    rate = triple(x, b, 10)
    v = turn_back(inside, plus(minus(triple(x, b, 7), turn_back(r, flow)), cross(rate, at)))
    w = turn_back(inside, rate)
    size, c, half_rho = triple(modules.size, m, 0), modules.drag, 0.5 * water.density
    factor = half_rho * drag.translation(size[0], size[1], size[2], c[m, 0], c[m, 1], v[0], v[1], v[2])
    share, lever = 1.0, (0.0, 0.0, 0.0)
    if modules.shelter[m] >= 0 and factor > 0.0:
        share, x_off, y_off, z_off = seen_share(modules.maps, modules.shelter[m], v)
        lever = (x_off, y_off, z_off)
    moment = cross(lever, times(-factor, v))
    sides, linear, quadratic = triple(modules.sides, m, 0), six(modules.linear, m), six(modules.quadratic, m)
    f, n = drag.box(size, sides, triple(c, m, 2), linear, quadratic, half_rho, factor * share, moment, v, w)
    add_force(bodies.wrench, b, at, turn(inside, f))
    n = turn(inside, n)
    for i in range(3):
        bodies.wrench[b, 3 + i] += n[i]


@inlined
def touches(modules, m, water, x):
    """Whether a module may touch wall, bottom or surface, so that `add_walls` must check its corners."""
    b, (sx, sy, sz) = modules.body[m], triple(modules.size, m, 0)
    r = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    centre, half = plus(triple(x, b, 0), turn(r, triple(modules.position, m, 0))), (0.0, 0.0, 0.0)
    if room(water, centre) > 0.5 * math.sqrt(sx * sx + sy * sy + sz * sz) + NEAR_M:
        return False
    inside = matrix(modules.turn, m)
    for axis in range(3):
        edge = turn(r, (inside[0][axis], inside[1][axis], inside[2][axis]))
        s = 0.5 * modules.size[m, axis]
        half = (half[0] + s * abs(edge[0]), half[1] + s * abs(edge[1]), half[2] + s * abs(edge[2]))
    return not is_clear(water, centre, half)


@callee
def add_walls(bodies, modules, m, water, x):
    """Adds the forces of walls, bottom and surface on the eight corners of one module."""
    b = modules.body[m]
    r, inside = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), matrix(modules.turn, m)
    position, size, origin = triple(modules.position, m, 0), triple(modules.size, m, 0), triple(x, b, 0)
    down = turn_back(inside, r[2])
    plane = size[1] * size[2] * down[0] ** 2 + size[2] * size[0] * down[1] ** 2 + size[0] * size[1] * down[2] ** 2
    lift = 0.25 * water.density * water.gravity * plane
    for k in range(8):
        corner = (
            size[0] * (0.5 if k & 1 else -0.5),
            size[1] * (0.5 if k & 2 else -0.5),
            size[2] * (0.5 if k & 4 else -0.5),
        )
        at = plus(position, turn(inside, corner))
        p = plus(origin, turn(r, at))
        v = turn(r, plus(triple(x, b, 7), cross(triple(x, b, 10), at)))
        f = push_of_walls(water, p, v)
        if p[2] < 0.0:  # out of the water: this corner's quarter of the water plane loses buoyancy
            f = (f[0], f[1], f[2] + max(0.0, -lift * p[2] - water.damping * v[2]))
        add_force(bodies.wrench, b, at, turn_back(r, f))


@inlined
def accelerate(bodies, b, x, out, flow, flow_rate):
    """Writes the derivative of the state of body b: kinematics and Kirchhoff's equations; zero for a clamped body."""
    if bodies.clamped[b]:
        for i in range(13):
            out[b, i] = 0.0
        return
    q, v, w = (x[b, 3], x[b, 4], x[b, 5], x[b, 6]), triple(x, b, 7), triple(x, b, 10)
    r, f, n = matrix_of(q[0], q[1], q[2], q[3]), triple(bodies.wrench, b, 0), triple(bodies.wrench, b, 3)
    masses = (mass_of(bodies.rigid, b), mass_of(bodies.added, b), mass_of(bodies.inverse, b))
    a, alpha = respond(masses[0], masses[1], masses[2], r, v, w, flow, flow_rate, f, n)
    rate, spin = turn(r, v), turning(q, w)
    for i in range(3):
        out[b, i], out[b, 7 + i], out[b, 10 + i] = rate[i], a[i], alpha[i]
    for i in range(4):
        out[b, 3 + i] = spin[i]


@inlined
def load(bodies, modules, water, flow, flow_rate, thrust, x):
    """Writes the sum of thrust, weight, drag and wall forces into `bodies.wrench`; arguments as in `integrator.derivative`."""
    for b in range(x.shape[0]):
        for i in range(6):
            bodies.wrench[b, i] = thrust[b, i]
        _add_weight(bodies, b, x, flow_rate)
    for m in range(modules.body.shape[0]):
        _add_drag(bodies, modules, m, water, x, flow)
        if touches(modules, m, water, x):
            add_walls(bodies, modules, m, water, x)


@compiled(types.void(BODIES, MODULES, F2, F8, F2))
def observe(bodies, modules, rates, gravity, out):
    """Writes pose, velocity, rate and specific force of each module.

    Args:
        rates: (b, 13) current derivative of the states.
        out: (m, 16) hull centre (world), quaternion, velocity (world), rate and specific force (module frame).
    """
    x = bodies.state
    for m in range(modules.body.shape[0]):
        b = modules.body[m]
        r, at, inside = (
            matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]),
            triple(modules.position, m, 0),
            matrix(modules.turn, m),
        )
        v, w = triple(x, b, 7), triple(x, b, 10)
        p = plus(triple(x, b, 0), turn(r, at))
        a = plus(plus(triple(rates, b, 7), cross(w, v)), plus(cross(triple(rates, b, 10), at), cross(w, cross(w, at))))
        felt = turn_back(inside, minus(a, times(gravity, r[2])))
        velocity, rate = turn(r, plus(v, cross(w, at))), turn_back(inside, w)
        for i in range(3):
            out[m, i], out[m, 7 + i], out[m, 10 + i], out[m, 13 + i] = p[i], velocity[i], rate[i], felt[i]
        q, c = modules.quaternion, x
        out[m, 3] = c[b, 3] * q[m, 0] - c[b, 4] * q[m, 1] - c[b, 5] * q[m, 2] - c[b, 6] * q[m, 3]
        out[m, 4] = c[b, 3] * q[m, 1] + c[b, 4] * q[m, 0] + c[b, 5] * q[m, 3] - c[b, 6] * q[m, 2]
        out[m, 5] = c[b, 3] * q[m, 2] - c[b, 4] * q[m, 3] + c[b, 5] * q[m, 0] + c[b, 6] * q[m, 1]
        out[m, 6] = c[b, 3] * q[m, 3] + c[b, 4] * q[m, 2] - c[b, 5] * q[m, 1] + c[b, 6] * q[m, 0]


@compiled(types.void(F1, V3, F1))
def nominal_centre_motion(x, nominal, out):
    """Writes position (0:3) and velocity (3:6) of the nominal centre of mass, world.

    Args:
        x: (13,) state of one body; nominal: centre of mass from its origin, body frame.
    """
    r, place = matrix_of(x[3], x[4], x[5], x[6]), (x[0], x[1], x[2])
    v, w = (x[7], x[8], x[9]), (x[10], x[11], x[12])
    at, velocity = plus(place, turn(r, nominal)), turn(r, plus(v, cross(w, nominal)))
    for i in range(3):
        out[i], out[3 + i] = at[i], velocity[i]
