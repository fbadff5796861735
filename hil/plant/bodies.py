"""Motion of rigid bodies in water: Kirchhoff's equations.

A body is one or more modules docked rigidly. Its frame has the axes of their lattice, origin O at its first hull's centre. Its
state, (13,): position of O in the world, quaternion body to world, velocity of O and angular rate in the body frame.

With the momenta of robot and entrained water (p, L) and of the water outside (h, l: added mass times velocity relative
to the water), all about O in the body frame (Lamb, Hydrodynamics, ch. VI):
    d(p + h)/dt = F - w x (p + h),    d(L + l)/dt = N - w x (L + l) - v x p - v_r x h.
"""

from __future__ import annotations

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
    compiled,
    cross,
    matrix,
    matrix_of,
    minus,
    plus,
    times,
    triple,
    turn,
    turn_back,
)  # fmt: skip
from hil.plant.water import WATER, is_clear, push_of_walls

I8 = types.int64


class Bodies(NamedTuple):
    """Arrays over b bodies."""

    state: np.ndarray
    """(b, 13)."""
    rigid: np.ndarray
    """(b, 6, 6) mass matrix of robot and entrained water about O."""
    added: np.ndarray
    """(b, 6, 6) added mass about O."""
    inverse: np.ndarray
    """(b, 6, 6) inverse of their sum."""
    weight: np.ndarray
    """(b, 8) weight W and buoyancy B of the dry parts, N; W r_W and B r_B, N m."""
    hull: np.ndarray
    """(b, 4) mass of the water that the hulls displace, entrained water included, kg; mass times centre, kg m."""
    wrench: np.ndarray
    """(b, 6) working memory: force and moment about O, body frame."""
    clamped: np.ndarray
    """(b,) 1 where a load cell holds the body in its place."""


class Modules(NamedTuple):
    """Arrays over m modules."""

    body: np.ndarray
    """(m,) index of the body."""
    position: np.ndarray
    """(m, 3) hull centre in the body frame."""
    turn: np.ndarray
    """(m, 3, 3) module frame to body frame."""
    quaternion: np.ndarray
    """(m, 4) the same."""
    size: np.ndarray
    """(m, 3) edges of the hull."""
    drag: np.ndarray
    """(m, 5) coefficients: face-on, edge-on, of rotation about x, y, z."""
    linear: np.ndarray
    """(m, 6) linear damping."""
    quadratic: np.ndarray
    """(m, 6) quadratic damping that a vehicle file publishes in place of areas."""
    shelter: np.ndarray
    """(m,) row of the module's map; -1: it swims alone."""
    sides: np.ndarray
    """(m, 3) share of its sides across x, y, z that no other module covers."""
    maps: np.ndarray
    """(k, 3, n, n, 4) see `shelter.seen_share`."""


BODIES = types.NamedTuple((F2, F3, F3, F3, F2, F2, F2, I1), Bodies)
MODULES = types.NamedTuple((I1, F2, F3, F2, F2, F2, F2, F2, I1, F2, F5), Modules)


@compiled(types.void(F2, I8, V3, V3))
def add_force(wrench, b, at, f):
    """Adds the force f at the point `at` to row b of wrenches; body frame."""
    n = cross(at, f)
    for i in range(3):
        wrench[b, i] += f[i]
        wrench[b, 3 + i] += n[i]


@compiled(V3(F3, I8, I8, V3, V3))
def half_momentum(mass, b, first, v, w):
    """Rows `first` to first + 2 of mass matrix number b times [v; w]: linear momentum from 0, angular from 3."""
    p = (0.0, 0.0, 0.0)
    for j in range(3):
        p = plus(p, times(v[j], (mass[b, first, j], mass[b, first + 1, j], mass[b, first + 2, j])))
        p = plus(p, times(w[j], (mass[b, first, 3 + j], mass[b, first + 1, 3 + j], mass[b, first + 2, 3 + j])))
    return p


@compiled(types.void(BODIES, I8, F2, V3))
def _add_weight(bodies, b, x, flow_rate):
    """Weight, buoyancy, and the pressure gradient of water that accelerates (Froude-Krylov)."""
    r = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    down, rate = r[2], turn_back(r, flow_rate)
    weight, hull = bodies.weight, bodies.hull
    f = plus(times(weight[b, 0] - weight[b, 1], down), times(hull[b, 0], rate))
    lever = minus(triple(weight, b, 2), triple(weight, b, 5))
    n = plus(cross(lever, down), cross(triple(hull, b, 1), rate))
    for i in range(3):
        bodies.wrench[b, i] += f[i]
        bodies.wrench[b, 3 + i] += n[i]


@compiled(types.void(BODIES, MODULES, I8, WATER, F2, V3))
def _add_drag(bodies, modules, m, water, x, flow):
    """Drag of one module at its hull centre, by its velocity relative to the water."""
    b = modules.body[m]
    r, at, inside = (
        matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]),
        triple(modules.position, m, 0),
        matrix(modules.turn, m),
    )
    rate = triple(x, b, 10)
    v = turn_back(inside, plus(minus(triple(x, b, 7), turn_back(r, flow)), cross(rate, at)))
    w = turn_back(inside, rate)
    sx, sy, sz = triple(modules.size, m, 0)
    ox, oy, oz = triple(modules.sides, m, 0)
    c, linear, quadratic, half_rho = modules.drag, modules.linear, modules.quadratic, 0.5 * water.density
    factor = half_rho * drag.translation(sx, sy, sz, c[m, 0], c[m, 1], v[0], v[1], v[2])
    share, lever = 1.0, (0.0, 0.0, 0.0)
    if modules.shelter[m] >= 0 and factor > 0.0:
        share, x_off, y_off, z_off = seen_share(modules.maps, modules.shelter[m], v)
        lever = (x_off, y_off, z_off)
    n = cross(lever, times(-factor, v))
    factor *= share
    f = (
        -(factor + linear[m, 0] + quadratic[m, 0] * abs(v[0])) * v[0],
        -(factor + linear[m, 1] + quadratic[m, 1] * abs(v[1])) * v[1],
        -(factor + linear[m, 2] + quadratic[m, 2] * abs(v[2])) * v[2],
    )
    n = (
        n[0] - half_rho * c[m, 2] * drag.rotation(sy, sz, sx, v[1], v[2], w[0], oy, oz)
        - (linear[m, 3] + quadratic[m, 3] * abs(w[0])) * w[0],
        n[1] - half_rho * c[m, 3] * drag.rotation(sz, sx, sy, v[2], v[0], w[1], oz, ox)
        - (linear[m, 4] + quadratic[m, 4] * abs(w[1])) * w[1],
        n[2] - half_rho * c[m, 4] * drag.rotation(sx, sy, sz, v[0], v[1], w[2], ox, oy)
        - (linear[m, 5] + quadratic[m, 5] * abs(w[2])) * w[2],
    )  # fmt: skip
    add_force(bodies.wrench, b, at, turn(inside, f))
    n = turn(inside, n)
    for i in range(3):
        bodies.wrench[b, 3 + i] += n[i]


@compiled(types.boolean(MODULES, I8, WATER, F2))
def _touches(modules, m, water, x):
    """Whether a module is so near to wall, bottom or surface that its corners must be looked at."""
    b = modules.body[m]
    r, inside = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), matrix(modules.turn, m)
    centre, half = plus(triple(x, b, 0), turn(r, triple(modules.position, m, 0))), (0.0, 0.0, 0.0)
    for axis in range(3):
        edge = turn(r, (inside[0][axis], inside[1][axis], inside[2][axis]))
        s = 0.5 * modules.size[m, axis]
        half = (half[0] + s * abs(edge[0]), half[1] + s * abs(edge[1]), half[2] + s * abs(edge[2]))
    return not is_clear(water, centre, half)


@compiled(types.void(BODIES, MODULES, I8, WATER, F2))
def _add_walls(bodies, modules, m, water, x):
    """Walls, bottom and surface on the eight corners of one module."""
    b = modules.body[m]
    r, inside = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), matrix(modules.turn, m)
    position, size, origin = triple(modules.position, m, 0), triple(modules.size, m, 0), triple(x, b, 0)
    lift = 0.25 * water.density * water.gravity * size[0] * size[1]
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
        if p[2] < 0.0:  # out of the water: its quarter of the water plane carries less
            f = (f[0], f[1], f[2] + max(0.0, -lift * p[2] - water.damping * v[2]))
        add_force(bodies.wrench, b, at, turn_back(r, f))


@compiled(types.void(BODIES, I8, F2, F2, V3, V3))
def accelerate(bodies, b, x, out, flow, flow_rate):
    """Kirchhoff's equations solved for the accelerations, and the kinematics. A clamped body stays where it is."""
    if bodies.clamped[b]:
        for i in range(13):
            out[b, i] = 0.0
        return
    q = (x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    r, v, w = matrix_of(q[0], q[1], q[2], q[3]), triple(x, b, 7), triple(x, b, 10)
    u, none = turn_back(r, flow), (0.0, 0.0, 0.0)
    slip = minus(v, u)
    carried = minus(cross(w, u), turn_back(r, flow_rate))  # dv_r/dt = dv/dt + carried
    p, spin = half_momentum(bodies.rigid, b, 0, v, w), half_momentum(bodies.rigid, b, 3, v, w)
    h, swirl = half_momentum(bodies.added, b, 0, slip, w), half_momentum(bodies.added, b, 3, slip, w)
    f, n = triple(bodies.wrench, b, 0), triple(bodies.wrench, b, 3)
    f = minus(minus(f, half_momentum(bodies.added, b, 0, carried, none)), cross(w, plus(p, h)))
    n = minus(minus(n, half_momentum(bodies.added, b, 3, carried, none)), cross(w, plus(spin, swirl)))
    n = minus(minus(n, cross(v, p)), cross(slip, h))
    a, alpha = half_momentum(bodies.inverse, b, 0, f, n), half_momentum(bodies.inverse, b, 3, f, n)
    rate = turn(r, v)
    for i in range(3):
        out[b, i], out[b, 7 + i], out[b, 10 + i] = rate[i], a[i], alpha[i]
    out[b, 3] = -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2])
    out[b, 4] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1])
    out[b, 5] = 0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2])
    out[b, 6] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0])


@compiled(types.void(BODIES, MODULES, WATER, V3, V3, F2, F2))
def load(bodies, modules, water, flow, flow_rate, thrust, x):
    """Writes into `bodies.wrench` what thrusters, weight, drag and walls do; arguments as `integrator.derivative`."""
    for b in range(x.shape[0]):
        for i in range(6):
            bodies.wrench[b, i] = thrust[b, i]
        _add_weight(bodies, b, x, flow_rate)
    for m in range(modules.body.shape[0]):
        _add_drag(bodies, modules, m, water, x, flow)
        if _touches(modules, m, water, x):
            _add_walls(bodies, modules, m, water, x)


@compiled(types.void(BODIES, MODULES, F2, F8, F2))
def observe(bodies, modules, rates, gravity, out):
    """Writes what each module is and feels.

    Args:
        rates: (b, 13) derivative of the states now.
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


@compiled(types.void(F1, V3, F2, F1))
def steered(x, nominal, rigid, out):
    """Writes where the nominal centre of mass is (0:3), its velocity (3:6), and where the true one is (6:9), world.

    Args:
        x: (13,) state of one body; nominal: from its origin; rigid: (6, 6) its rigid mass matrix about the origin.
    """
    r, place = matrix_of(x[3], x[4], x[5], x[6]), (x[0], x[1], x[2])
    v, w = (x[7], x[8], x[9]), (x[10], x[11], x[12])
    com = times(1.0 / rigid[0, 0], (rigid[5, 1], rigid[3, 2], rigid[4, 0]))
    at, velocity, true = plus(place, turn(r, nominal)), turn(r, plus(v, cross(w, nominal))), plus(place, turn(r, com))
    for i in range(3):
        out[i], out[3 + i], out[6 + i] = at[i], velocity[i], true[i]
