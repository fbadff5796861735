"""What `missing_thrust` sums over the ticks of a block: modelled wrench, measured acceleration, and the flow that no model includes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.drag_lookup import NODES, add_drag
from firmware_py.core.rigid_body import add_restoring, take_coriolis
from firmware_py.core.rotations import M, V, cross, turned_back
from firmware_py.description.water import GRAVITY


@njit(f"void({V},{NODES},{V},{V},{V},{V},{V})", cache=True)
def add_model(righting, nodes, rotational, linear, nu, q_wb, out):  # type: ignore[no-untyped-def]
    """Adds the wrench of drag and buoyancy to `out` (6,)."""
    add_drag(nodes, rotational, linear, nu, out)
    add_restoring(righting, q_wb, out)


@njit(f"void({M},{V},{V})", cache=True)
def add_coriolis(mass, nu, out):  # type: ignore[no-untyped-def]
    """Adds the Coriolis wrench to `out` (6,), relative to the acceleration that an accelerometer measures: dv/dt + w x v."""
    take_coriolis(mass, nu, out)
    out += np.ascontiguousarray(mass[:, :3]) @ cross(nu[3:], nu[:3])


def across(body: Body) -> np.ndarray:
    """(3, 3) weights of flow along an axis (column) in what brakes a turn about another (row), mean 1: as the cube of the third extent."""
    low, high = (body.r_bm - 0.5 * body.hull_m).min(axis=0), (body.r_bm + 0.5 * body.hull_m).max(axis=0)
    cubes, weights = (high - low) ** 3, np.zeros((3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        weights[i, [j, k]] = 2.0 * cubes[[k, j]] / (cubes[j] + cubes[k])
    return weights


@njit(f"void({V},{M},{V})", cache=True)
def add_flow(nu, weights, out):  # type: ignore[no-untyped-def]
    """Adds to `out` (6,) for each axis the weighted speed across it (`across`) times the rate about it, m/s rad/s, and the product of the
    other two velocities, m^2/s^2: the additional (Munk) moment, N m, per kg of error in the difference of the masses along those two axes.
    """
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] += (weights[i, j] * abs(nu[j]) + weights[i, k] * abs(nu[k])) * nu[3 + i]
        out[3 + i] += nu[j] * nu[k]


@njit(f"void({V},{V},{V})", cache=True)
def add_motion(accel, q_wb, out):  # type: ignore[no-untyped-def]
    """Adds to `out` (3,) the acceleration of a body that measures the specific force `accel` (3,), m/s^2."""
    down = turned_back(q_wb, 0.0, 0.0, GRAVITY)
    for i in range(3):
        out[i] += accel[i] + down[i]


@njit(f"float64({V},{V},{V},{M},{V},{NODES},{V},{V},{M},{V},{V},{V},{V})", cache=True)
def add_tick(nu, q_wb, force_n, mass, righting, nodes, rotational, linear, weights, model, coriolis, flow, forces):  # type: ignore[no-untyped-def]
    """Adds one tick to the sums of a block (the last four arguments) and returns the speed, m/s."""
    add_model(righting, nodes, rotational, linear, nu, q_wb, model)
    add_coriolis(mass, nu, coriolis)
    add_flow(nu, weights, flow)
    forces += force_n
    return math.sqrt(nu[0] ** 2 + nu[1] ** 2 + nu[2] ** 2)
