"""The estimator's process model, compiled: propagation of the nominal state over a step, and the Jacobian of its error.

Nominal state x (32,): position p_wb 0:3, attitude q_wb 3:7, velocity nu 7:13 (body), gyro bias 13:16, accelerometer
bias 16:19, disturbance force 19:22 (world, N), disturbance moment 22:25 (body, N m), depth bias 25, and the error of the body's righting
vector, 26:29 (body, N m), due to arm and trim: once known, it gives the moment at every attitude, which a disturbance moment could only
follow. 29:32 is not a state of the robot but the down direction (body) used in the gains; it follows the attitude with a deadband (LEASH).
Error state e (28,): the same with the attitude error as a rotation vector in the body frame: dp 0:3, dtheta 3:6, dnu
6:12, dbg 12:15, dba 15:18, df 18:21, dm 21:24, dbz 24, dh 25:28.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from firmware_py.core.drag_lookup import NODES, add_drag
from firmware_py.core.rigid_body import add_restoring, take_coriolis
from firmware_py.core.rotations import M, V, cross, exp, multiply, normalise, rotate_back, skew, to_matrix, turn, turned, turned_back

STATES = 32
ERRORS = 28
LEASH = 0.02
"""Deadband, rad, within which the down direction may turn before the gains of the righting vector follow: one degree, five times the tilt
of a hovering robot (3.5 mrad RMS with the noise that the filter assumes). The attitude jitter of a robot that holds its attitude is
correlated with the noise in the innovations. Gains that took this jitter for tilting estimated a righting arm from it that grew for an
hour, with ever smaller variance."""
MOVING = 12
"""Number of errors of pose and velocity, which come first; those of biases, disturbance and righting are constant in a prediction."""
PLANT = f"{M},{M},{V},{NODES},{V},{V}"
"""Types of the body's arrays: mass, mass_inv, righting, drag nodes, rotational and linear damping."""
STATE = f"Tuple(({V},{M}))"
"""Types of a state and its covariance."""


class Nominal:
    """Where the parts of the nominal state are in x (32,), for code that is not compiled."""

    POSITION, ATTITUDE, NU = slice(0, 3), slice(3, 7), slice(7, 13)
    RATE = slice(10, 13)
    """Angular part of NU."""
    GYRO_BIAS, ACCEL_BIAS, DEPTH_BIAS = slice(13, 16), slice(16, 19), 25
    FORCE, MOMENT, RIGHTING, DOWN = slice(19, 22), slice(22, 25), slice(26, 29), slice(29, 32)
    VERTICAL_FORCE = 21


class Error:
    """Where the parts of the error state are in e (28,), in each axis of its covariance, and in its process noise."""

    POSITION, ATTITUDE, VELOCITY, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
    GYRO_BIAS, ACCEL_BIAS, DEPTH_BIAS = slice(12, 15), slice(15, 18), 24
    FORCE, MOMENT, RIGHTING = slice(18, 21), slice(21, 24), slice(25, 28)


@njit(cache=True)
def accelerate(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear, total, out):  # type: ignore[no-untyped-def]
    """Writes dnu/dt of the body under the (6,) wrench `external` (thrusters and disturbance, body frame) to `out` (6,), and the total
    wrench to the first six elements of `total`.
    """
    for i in range(6):
        total[i] = external[i]
    take_coriolis(mass, nu, total)
    add_drag(nodes, rotational, linear, nu, total)
    add_restoring(righting, q, total)
    for i in range(6):
        out[i] = 0.0
        for j in range(6):
            out[i] += mass_inv[i, j] * total[j]


@njit(cache=True)
def acceleration(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """Returns (6,) dnu/dt of the body under the (6,) wrench `external`."""
    out = np.empty(6)
    accelerate(nu, q, external, mass, mass_inv, righting, nodes, rotational, linear, np.empty(6), out)
    return out


@njit(cache=True)
def inertial_acceleration(x, tau, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """Returns the (3,) acceleration of the centre of mass relative to the world, body frame, in state x under the thruster wrench tau
    (6,).
    """
    q, nu = x[3:7], x[7:13]
    external = tau.copy()
    external[:3] += rotate_back(q, x[19:22])
    external[3:] += x[22:25]
    rate = acceleration(nu, q, external, mass, mass_inv, righting + x[26:29], nodes, rotational, linear)
    return rate[:3] + cross(nu[3:], nu[:3])


@njit(cache=True)
def step_into(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear, work, out):  # type: ignore[no-untyped-def]
    """Writes the state after dt seconds to `out` (32,), which must not be x; `work`: (7, 6) scratch memory. Allocates nothing."""
    q, q_mid, nu, nu_mid, external, rate, believed = work[0], work[1], work[2], work[3], work[4], work[5], work[6, :3]
    half = 0.5 * dt
    q[:4] = x[3:7]
    nu[:] = x[7:13]
    fx, fy, fz = turned_back(q, x[19], x[20], x[21])
    external[0], external[1], external[2] = tau[0] + fx, tau[1] + fy, tau[2] + fz
    for i in range(3):
        external[3 + i] = tau[3 + i] + x[22 + i]
        believed[i] = righting[i] + x[26 + i]
    accelerate(nu, q, external, mass, mass_inv, believed, nodes, rotational, linear, out, rate)
    for i in range(6):
        nu_mid[i] = nu[i] + half * rate[i]
    turn(q, half * nu[3], half * nu[4], half * nu[5], q_mid)
    fx, fy, fz = turned_back(q_mid, x[19], x[20], x[21])
    external[0], external[1], external[2] = tau[0] + fx, tau[1] + fy, tau[2] + fz
    accelerate(nu_mid, q_mid, external, mass, mass_inv, believed, nodes, rotational, linear, out, rate)
    vx, vy, vz = turned(q_mid, nu_mid[0], nu_mid[1], nu_mid[2])
    out[:] = x
    out[0] += dt * vx
    out[1] += dt * vy
    out[2] += dt * vz
    for i in range(6):
        out[7 + i] = nu[i] + dt * rate[i]
    turn(q, dt * nu_mid[3], dt * nu_mid[4], dt * nu_mid[5], q_mid)
    n = math.sqrt(q_mid[0] ** 2 + q_mid[1] ** 2 + q_mid[2] ** 2 + q_mid[3] ** 2)
    n = n if q_mid[0] >= 0.0 else -n
    for i in range(4):
        out[3 + i] = q_mid[i] / n
    dx, dy, dz = turned_back(out[3:7], 0.0, 0.0, 1.0)
    dx, dy, dz = dx - x[29], dy - x[30], dz - x[31]
    away = math.sqrt(dx**2 + dy**2 + dz**2)
    if away > LEASH:
        pulled = 1.0 - LEASH / away
        out[29] += pulled * dx
        out[30] += pulled * dy
        out[31] += pulled * dz


@njit(cache=True)
def step(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """Returns the (32,) state after dt seconds under the thruster wrench tau (6,), by the midpoint rule."""
    out = np.empty(STATES)
    step_into(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear, np.empty((7, 6)), out)
    return out


@njit(cache=True)
def transition(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """Returns the first (12, 28) rows (pose and velocity) of F = I + A dt + (A dt)^2 / 2 of the error over one step, A the Jacobian at x.

    Biases, disturbance and righting are constant: their rows of F are those of the identity.
    """
    q = x[3:7]
    nu = x[7:13].copy()
    r = to_matrix(q)
    force_b = rotate_back(q, x[19:22])
    a = np.zeros((MOVING, ERRORS))
    a[0:3, 3:6] = -r @ skew(nu[:3])
    a[0:3, 6:9] = r
    a[3:6, 3:6] = -skew(nu[3:])
    external = tau.copy()
    external[:3] += force_b
    external[3:] += x[22:25]
    believed = righting + x[26:29]
    base, there, total = np.empty(6), np.empty(6), np.empty(6)
    accelerate(nu, q, external, mass, mass_inv, believed, nodes, rotational, linear, total, base)
    step_size = 1e-4
    for i in range(6):
        here = nu[i]
        nu[i] += step_size
        accelerate(nu, q, external, mass, mass_inv, believed, nodes, rotational, linear, total, there)
        nu[i] = here
        for j in range(6):
            a[6 + j, 6 + i] = (there[j] - base[j]) / step_size
    linear_part = np.ascontiguousarray(mass_inv[:, :3])
    angular_part = np.ascontiguousarray(mass_inv[:, 3:])
    down = r[2]
    a[6:12, 3:6] = linear_part @ skew(force_b) - angular_part @ (skew(believed) @ skew(down))
    a[6:12, 18:21] = linear_part @ np.ascontiguousarray(r.T)
    a[6:12, 21:24] = angular_part
    a[6:12, 25:28] = angular_part @ skew(x[29:32])
    for i in range(3):
        a[3 + i, 9 + i] = 1.0
    f = dt * a + (0.5 * dt * dt) * (np.ascontiguousarray(a[:, :MOVING]) @ a)
    for i in range(MOVING):
        f[i, i] += 1.0
    return f


@njit(cache=True)
def squared_speeds(x):  # type: ignore[no-untyped-def]
    """Returns the squared speed, m^2/s^2, and the squared angular rate, rad^2/s^2, of state x."""
    return x[7] ** 2 + x[8] ** 2 + x[9] ** 2, x[10] ** 2 + x[11] ** 2 + x[12] ** 2


@njit(cache=True)
def predict(x, covariance, tau, dt, density, under_way, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """Returns state (32,) and covariance (28, 28) after dt seconds: F P F^T + Q.

    Unmodelled angular acceleration has turned the body during half of the step by the time the gyro at its end measures it: attitude and
    rate have the Q of a double integrator (Bar-Shalom et al. 2001, 6.2.2). Without that a body that meets 0.5 rad/s^2 more than its model
    knows is wrong by 8 deg after a minute at 100 Hz. Q is diagonal otherwise: tags correct the displacement by half a step of unmodelled
    linear acceleration.

    Args:
        density: (28,) process noise of a body at rest, per second.
        under_way: (5,) additional noise of a moving body, because errors of current, drag and mass act in proportion to its motion: of the
            random walk of the disturbance force N/sqrt(s) per m/s and per rad/s; of the angular acceleration rad/s^2/sqrt(Hz) per rad/s;
            of the accelerometer (`observation.fuse_inertial`) m/s^2 per m/s and per rad/s.
    """
    f = transition(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear)
    moved = f @ covariance
    out = covariance.copy()
    out[:MOVING, :MOVING] = moved @ np.ascontiguousarray(f.T)
    for i in range(MOVING):
        for j in range(i):  # asymmetry from rounding would grow with every unstable motion, undamped by measurements
            out[i, j] = out[j, i] = 0.5 * (out[i, j] + out[j, i])
        for j in range(MOVING, ERRORS):
            out[i, j] = out[j, i] = moved[i, j]
    for i in range(ERRORS):
        out[i, i] += density[i] * dt
    speed, rate = squared_speeds(x)
    turning = under_way[2] ** 2 * rate
    for i in range(3):
        alpha = density[9 + i] + turning
        out[9 + i, 9 + i] += turning * dt
        out[3 + i, 9 + i] += 0.5 * alpha * dt**2
        out[9 + i, 3 + i] += 0.5 * alpha * dt**2
        out[3 + i, 3 + i] += alpha * dt**3 / 3.0
        out[18 + i, 18 + i] += (under_way[0] ** 2 * speed + under_way[1] ** 2 * rate) * dt
    return step(x, tau, dt, mass, mass_inv, righting, nodes, rotational, linear), out


@njit(cache=True)
def carry(x, taus, gyros, dt, until_first, mass, mass_inv, righting, nodes, rotational, linear):  # type: ignore[no-untyped-def]
    """Returns the (32,) state carried from the head to now through stored inputs.

    Args:
        taus: (k, 6) mean thruster wrench of each remaining tick; gyros: (k, 3) measured rate at its end, NaN where
            missing.
        dt: tick period, s; until_first: remaining part of the first tick, s.
    """
    now, after, work = x.copy(), np.empty(STATES), np.empty((7, 6))
    for i in range(taus.shape[0]):
        h = until_first if i == 0 else dt
        if h > 0.0:
            step_into(now, taus[i], h, mass, mass_inv, righting, nodes, rotational, linear, work, after)
            now, after = after, now
        if not math.isnan(gyros[i, 0]):
            for k in range(3):
                now[10 + k] = gyros[i, k] - now[13 + k]
    return now


@njit(cache=True)
def inject(x, e):  # type: ignore[no-untyped-def]
    """Returns the (32,) state with the (28,) error added."""
    out = x.copy()
    out[:3] += e[:3]
    out[3:7] = normalise(multiply(x[3:7], exp(e[3:6])))
    out[7:29] += e[6:]
    return out
