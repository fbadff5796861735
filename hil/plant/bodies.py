"""Motion of rigid bodies in water: Kirchhoff's equations.

A body is one or more modules docked rigidly. Its frame has its origin O at the hull centre of its first module. State of a
body, (13,): position of O in the world, quaternion body to world, velocity of O and angular rate, both in the body frame.

With the momenta of robot and entrained water (p, L) and of the water outside (h, l: added mass times velocity relative to the
water), all about O in the body frame (Lamb, Hydrodynamics, ch. VI):
    d(p + h)/dt = F - w x (p + h),    d(L + l)/dt = N - w x (L + l) - v x p - v_r x h.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types

from hil.plant import drag
from hil.plant.water import F1, F2, F3, WATER, push_of_walls

I1 = types.int64[::1]


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


class Modules(NamedTuple):
    """Arrays over m modules."""

    body: np.ndarray
    """(m,) index of the body."""
    position: np.ndarray
    """(m, 3) hull centre in the body frame."""
    turn: np.ndarray
    """(m, 3, 3) module frame to body frame."""
    size: np.ndarray
    """(m, 3) edges of the hull."""
    drag: np.ndarray
    """(m, 5) coefficients: face-on, edge-on, of rotation about x, y, z."""
    linear: np.ndarray
    """(m, 6) linear damping."""
    quadratic: np.ndarray
    """(m, 6) quadratic damping that a vehicle file publishes in place of areas."""


class Scratch(NamedTuple):
    """Working memory of the derivative."""

    turn: np.ndarray
    """(b, 3, 3) body to world."""
    wrench: np.ndarray
    """(b, 6) about O, body frame."""
    work: np.ndarray
    """(16, 3)."""


BODIES = types.NamedTuple((F2, F3, F3, F3, F2, F2), Bodies)
MODULES = types.NamedTuple((I1, F2, F3, F2, F2, F2, F2), Modules)
SCRATCH = types.NamedTuple((F3, F2, F2), Scratch)


def make_scratch(bodies: int) -> Scratch:
    """Working memory for so many bodies."""
    return Scratch(np.zeros((bodies, 3, 3)), np.zeros((bodies, 6)), np.zeros((16, 3)))


@njit(types.void(F1, F2), cache=True)
def matrix_of(x, r):
    """Writes the (3, 3) rotation matrix of the state's quaternion into r."""
    w, i, j, k = x[3], x[4], x[5], x[6]
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)


@njit(types.void(F2, F1, F1), cache=True)
def turn(r, a, out):
    """out = r a."""
    out[0] = r[0, 0] * a[0] + r[0, 1] * a[1] + r[0, 2] * a[2]
    out[1] = r[1, 0] * a[0] + r[1, 1] * a[1] + r[1, 2] * a[2]
    out[2] = r[2, 0] * a[0] + r[2, 1] * a[1] + r[2, 2] * a[2]


@njit(types.void(F2, F1, F1), cache=True)
def turn_back(r, a, out):
    """out = r^T a."""
    out[0] = r[0, 0] * a[0] + r[1, 0] * a[1] + r[2, 0] * a[2]
    out[1] = r[0, 1] * a[0] + r[1, 1] * a[1] + r[2, 1] * a[2]
    out[2] = r[0, 2] * a[0] + r[1, 2] * a[1] + r[2, 2] * a[2]


@njit(types.void(F1, F1, F1, types.float64), cache=True)
def add_cross(out, a, b, sign):
    """out += sign a x b."""
    out[0] += sign * (a[1] * b[2] - a[2] * b[1])
    out[1] += sign * (a[2] * b[0] - a[0] * b[2])
    out[2] += sign * (a[0] * b[1] - a[1] * b[0])


@njit(types.void(F1, F1, F1), cache=True)
def add_force(wrench, at, f):
    """Adds the force f at the point `at` to a wrench (6,); all in one frame."""
    for i in range(3):
        wrench[i] += f[i]
    add_cross(wrench[3:], at, f, 1.0)


@njit(types.void(F2, F1, F1, F1), cache=True)
def momentum(mass, v, w, out):
    """out (6,) = mass (6, 6) times [v; w]."""
    for i in range(6):
        total = 0.0
        for j in range(3):
            total += mass[i, j] * v[j] + mass[i, 3 + j] * w[j]
        out[i] = total


@njit(types.void(BODIES, MODULES, WATER, F1, F1, F2, F2, F2, SCRATCH), cache=True)
def derivative(bodies, modules, water, flow, flow_rate, thrust, x, out, scratch):
    """Rate of change of the states.

    Args:
        flow, flow_rate: (3,) velocity and acceleration of the water, world.
        thrust: (b, 6) wrench of all thrusters (and whatever else acts) about O, body frame.
        x: (b, 13) states; out: (b, 13) written.
    """
    for b in range(x.shape[0]):
        matrix_of(x[b], scratch.turn[b])
        scratch.wrench[b, :] = thrust[b]
        _add_weight(bodies, b, flow_rate, scratch)
    for m in range(modules.body.shape[0]):
        _add_drag(modules, m, water, flow, x, scratch)
        _add_walls(modules, m, water, x, scratch)
    for b in range(x.shape[0]):
        _accelerate(bodies, b, flow, flow_rate, x[b], out[b], scratch)


@njit(types.void(BODIES, types.int64, F1, SCRATCH), cache=True)
def _add_weight(bodies, b, flow_rate, scratch):
    """Weight, buoyancy, and the pressure gradient of water that accelerates (Froude-Krylov)."""
    r, wrench, down, rate = scratch.turn[b], scratch.wrench[b], scratch.work[0], scratch.work[1]
    for i in range(3):
        down[i] = r[2, i]
    turn_back(r, flow_rate, rate)
    weight, hull = bodies.weight[b], bodies.hull[b]
    for i in range(3):
        wrench[i] += (weight[0] - weight[1]) * down[i] + hull[0] * rate[i]
    add_cross(wrench[3:], weight[2:5], down, 1.0)
    add_cross(wrench[3:], weight[5:8], down, -1.0)
    add_cross(wrench[3:], hull[1:4], rate, 1.0)


@njit(types.void(MODULES, types.int64, WATER, F1, F2, SCRATCH), cache=True)
def _add_drag(modules, m, water, flow, x, scratch):
    """Drag of one module at its hull centre, by its velocity relative to the water."""
    b = modules.body[m]
    work, state = scratch.work, x[b]
    v, w, f, n, spare = work[2], work[3], work[4], work[5], work[6]
    turn_back(scratch.turn[b], flow, spare)
    for i in range(3):
        spare[i] = state[7 + i] - spare[i]
    add_cross(spare, state[10:13], modules.position[m], 1.0)
    turn_back(modules.turn[m], spare, v)
    turn_back(modules.turn[m], state[10:13], w)
    half_rho, c, (sx, sy, sz) = 0.5 * water.density, modules.drag[m], (modules.size[m, 0], modules.size[m, 1], modules.size[m, 2])
    factor = half_rho * drag.translation(sx, sy, sz, c[0], c[1], v[0], v[1], v[2])
    n[0] = -half_rho * c[2] * drag.rotation(sy, sz, sx, v[1], v[2], w[0])
    n[1] = -half_rho * c[3] * drag.rotation(sz, sx, sy, v[2], v[0], w[1])
    n[2] = -half_rho * c[4] * drag.rotation(sx, sy, sz, v[0], v[1], w[2])
    for i in range(3):
        f[i] = -(factor + modules.linear[m, i] + modules.quadratic[m, i] * abs(v[i])) * v[i]
        n[i] -= (modules.linear[m, 3 + i] + modules.quadratic[m, 3 + i] * abs(w[i])) * w[i]
    turn(modules.turn[m], f, v)
    turn(modules.turn[m], n, w)
    add_force(scratch.wrench[b], modules.position[m], v)
    for i in range(3):
        scratch.wrench[b, 3 + i] += w[i]


@njit(types.void(MODULES, types.int64, WATER, F2, SCRATCH), cache=True)
def _add_walls(modules, m, water, x, scratch):
    """Walls, bottom and surface on the eight corners of one module."""
    b = modules.body[m]
    r, state, work = scratch.turn[b], x[b], scratch.work
    centre, corner, at, p, v, f = work[2], work[3], work[4], work[5], work[6], work[7]
    size = modules.size[m]
    turn(r, modules.position[m], centre)
    reach = 0.5 * math.sqrt(size[0] ** 2 + size[1] ** 2 + size[2] ** 2)
    far = 0.0 if water.is_box else math.hypot(state[0] + centre[0], state[1] + centre[1])
    for i in range(3):
        centre[i] += state[i]
        if i < 2 and water.is_box:
            far = max(far, abs(centre[i]) - water.extent[i] + water.extent[0])
    if far + reach < water.extent[0] and reach < centre[2] < water.extent[2] - reach:
        return
    lift = 0.25 * water.density * water.gravity * size[0] * size[1]
    for k in range(8):
        corner[0] = size[0] * (0.5 if k & 1 else -0.5)
        corner[1] = size[1] * (0.5 if k & 2 else -0.5)
        corner[2] = size[2] * (0.5 if k & 4 else -0.5)
        turn(modules.turn[m], corner, at)
        for i in range(3):
            at[i] += modules.position[m, i]
            corner[i] = state[7 + i]
        add_cross(corner, state[10:13], at, 1.0)
        turn(r, corner, v)
        turn(r, at, p)
        for i in range(3):
            p[i] += state[i]
        push_of_walls(water, p, v, f)
        if p[2] < 0.0:  # out of the water: its share of the water plane is no longer carried
            f[2] += max(0.0, -lift * p[2] - water.damping * v[2])
        turn_back(r, f, corner)
        add_force(scratch.wrench[b], at, corner)


@njit(types.void(BODIES, types.int64, F1, F1, F1, F1, SCRATCH), cache=True)
def _accelerate(bodies, b, flow, flow_rate, x, out, scratch):
    """Kirchhoff's equations solved for the accelerations, and the kinematics."""
    r, wrench, work = scratch.turn[b], scratch.wrench[b], scratch.work
    v, w = x[7:10], x[10:13]
    u, slip, carried = work[2], work[3], work[4]
    turn_back(r, flow, u)
    turn_back(r, flow_rate, carried)
    for i in range(3):
        slip[i] = v[i] - u[i]
        carried[i] = -carried[i]
    add_cross(carried, w, u, 1.0)  # dv_r/dt = dv/dt + carried
    rigid, added, pull = work[5:7].reshape(6), work[7:9].reshape(6), work[9:11].reshape(6)
    momentum(bodies.rigid[b], v, w, rigid)
    momentum(bodies.added[b], slip, w, added)
    none = work[11]
    none[:] = 0.0
    momentum(bodies.added[b], carried, none, pull)
    for i in range(6):
        wrench[i] -= pull[i]
    add_cross(wrench[:3], w, rigid[:3], -1.0)
    add_cross(wrench[:3], w, added[:3], -1.0)
    add_cross(wrench[3:], w, rigid[3:], -1.0)
    add_cross(wrench[3:], w, added[3:], -1.0)
    add_cross(wrench[3:], v, rigid[:3], -1.0)
    add_cross(wrench[3:], slip, added[:3], -1.0)
    momentum(bodies.inverse[b], wrench[:3], wrench[3:], out[7:13])
    turn(r, v, out[:3])
    out[3] = -0.5 * (x[4] * w[0] + x[5] * w[1] + x[6] * w[2])
    out[4] = 0.5 * (x[3] * w[0] + x[5] * w[2] - x[6] * w[1])
    out[5] = 0.5 * (x[3] * w[1] + x[6] * w[0] - x[4] * w[2])
    out[6] = 0.5 * (x[3] * w[2] + x[4] * w[1] - x[5] * w[0])
