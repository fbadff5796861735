"""The estimator's process model, compiled: the nominal state moved over a step, and the Jacobian of its error.

Nominal state x (26,): position p_wb 0:3, attitude q_wb 3:7, velocity nu 7:13 (body), gyro bias 13:16, accelerometer
bias 16:19, disturbance force 19:22 (world, N), disturbance moment 22:25 (body, N m), depth bias 25.
Error state e (25,): the same with the attitude error as a rotation vector in the body frame: dp 0:3, dtheta 3:6, dnu
6:12, dbg 12:15, dba 15:18, df 18:21, dm 21:24, dbz 24.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from firmware_py.core.drag_lookup import add_drag
from firmware_py.core.rigid_body import add_restoring, take_coriolis
from firmware_py.core.rotations import M, V, cross, exp, multiply, normalise, rotate, rotate_back, skew, to_matrix

STATES = 26
ERRORS = 25
MOVING = 12
"""Errors of pose and velocity, which come first; those of biases and disturbance stand still in a prediction."""
N = "float64[:,:,:,::1]"
PLANT = f"{M},{M},{V},{N},{V},{V}"
"""Types of the body's arrays: mass, mass_inv, righting, drag nodes, rotational and linear damping."""
STATE = f"Tuple(({V},{M}))"
"""Types of a state and its covariance."""


@njit(f"{V}({V},{V},{V},{PLANT})", cache=True)
def acceleration(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """(6,) dnu/dt of the body under the (6,) wrench `external` (thrusters and disturbance, body frame)."""
    total = external.copy()
    take_coriolis(mass, nu, total)
    add_drag(nodes, rotational, linear, nu, total)
    add_restoring(righting, q, total)
    out = np.zeros(6)
    for i in range(6):
        for j in range(6):
            out[i] += mass_inv[i, j] * total[j]
    return out


@njit(f"{V}({V},{V},{PLANT})", cache=True)
def inertial_acceleration(x, tau, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """(3,) acceleration of the centre of mass against the world, body frame, in state x under the thruster wrench tau
    (6,).
    """
    q = x[3:7].copy()
    nu = x[7:13].copy()
    external = tau.copy()
    external[:3] += rotate_back(q, x[19:22].copy())
    external[3:] += x[22:25]
    rate = acceleration(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear)
    return rate[:3] + cross(nu[3:].copy(), nu[:3].copy())


@njit(f"{V}({V},{V},float64,{PLANT})", cache=True)
def step(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """(26,) state after dt seconds under the thruster wrench tau (6,), by the midpoint rule."""
    q = x[3:7].copy()
    nu = x[7:13].copy()
    external = tau.copy()
    external[3:] += x[22:25]
    external[:3] += rotate_back(q, x[19:22].copy())
    nu_mid = nu + 0.5 * dt * acceleration(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear)
    q_mid = multiply(q, exp(0.5 * dt * nu[3:]))
    external[:3] = tau[:3] + rotate_back(q_mid, x[19:22].copy())
    out = x.copy()
    out[7:13] = nu + dt * acceleration(nu_mid, q_mid, external, mass, mass_inv, righting, nodes, rotational, linear)
    out[:3] += dt * rotate(q_mid, nu_mid[:3].copy())
    out[3:7] = normalise(multiply(q, exp(dt * nu_mid[3:])))
    return out


@njit(f"{M}({V},{V},float64,{PLANT})", cache=True)
def transition(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """(12, 25) moving rows of F = I + A dt + (A dt)^2 / 2 of the error over one step, A the Jacobian at x.

    Biases and disturbance stand still: their rows of F are those of the identity.
    """
    q = x[3:7].copy()
    nu = x[7:13].copy()
    r = to_matrix(q)
    force_b = rotate_back(q, x[19:22].copy())
    a = np.zeros((MOVING, ERRORS))
    a[0:3, 3:6] = -r @ skew(nu[:3].copy())
    a[0:3, 6:9] = r
    a[3:6, 3:6] = -skew(nu[3:].copy())
    external = tau.copy()
    external[:3] += force_b
    external[3:] += x[22:25]
    base = acceleration(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear)
    step_size = 1e-4
    for i in range(6):
        here = nu[i]
        nu[i] += step_size
        there = acceleration(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear)
        nu[i] = here
        for j in range(6):
            a[6 + j, 6 + i] = (there[j] - base[j]) / step_size
    linear_part = np.ascontiguousarray(mass_inv[:, :3])
    angular_part = np.ascontiguousarray(mass_inv[:, 3:])
    down = r[2].copy()
    a[6:12, 3:6] = linear_part @ skew(force_b) - angular_part @ (skew(righting) @ skew(down))
    a[6:12, 18:21] = linear_part @ np.ascontiguousarray(r.T)
    a[6:12, 21:24] = angular_part
    for i in range(3):
        a[3 + i, 9 + i] = 1.0
    f = dt * a + (0.5 * dt * dt) * (np.ascontiguousarray(a[:, :MOVING]) @ a)
    for i in range(MOVING):
        f[i, i] += 1.0
    return f


@njit(f"{STATE}({V},{M},{V},float64,{V},{PLANT})", cache=True)
def predict(x, covariance, tau, dt, density, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """State (26,) and covariance (25, 25) after dt seconds: F P F^T + Q dt. density: (25,) process noise, per second."""
    f = transition(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear)
    moved = f @ covariance
    out = covariance.copy()
    out[:MOVING, :MOVING] = moved @ np.ascontiguousarray(f.T)
    for i in range(MOVING):
        for j in range(i):  # rounding off symmetry would grow with every unstable motion, and no measurement damps it
            out[i, j] = out[j, i] = 0.5 * (out[i, j] + out[j, i])
        for j in range(MOVING, ERRORS):
            out[i, j] = out[j, i] = moved[i, j]
    for i in range(ERRORS):
        out[i, i] += density[i] * dt
    return step(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear), out


@njit(f"{V}({V},{M},{M},float64,float64,{PLANT})", cache=True)
def carry(x, taus, gyros, dt, until_first, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """(26,) state moved from the anchor to now through stored inputs.

    Args:
        taus: (k, 6) mean thruster wrench of each remaining tick; gyros: (k, 3) measured rate at its end, NaN where
            none came.
        dt: tick, s; until_first: what is left of the first tick, s.
    """
    for i in range(taus.shape[0]):
        h = until_first if i == 0 else dt
        if h > 0.0:
            x = step(x, taus[i].copy(), h, mass, mass_inv, righting, nodes, rotational, linear)
        if not np.isnan(gyros[i, 0]):
            x[10:13] = gyros[i] - x[13:16]
    return x


@njit(f"{V}({V},{V})", cache=True)
def inject(x, e):  # type: ignore[no-untyped-def]
    """(26,) state with the (25,) error added."""
    out = x.copy()
    out[:3] += e[:3]
    out[3:7] = normalise(multiply(x[3:7].copy(), exp(e[3:6].copy())))
    out[7:] += e[6:]
    return out
