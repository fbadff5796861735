"""The estimator's measurement models, compiled: residual, Jacobian and noise of the inertial sensors with depth, and
of a tag.

States and errors are those of `propagation`. One row for each number measured; what did not come (NaN) has no row.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, njit, types

from firmware_py.core.propagation import ERRORS
from firmware_py.core.rotations import M, V, difference, skew, to_matrix

GRAVITY = 9.80665
"""m/s^2, standard gravity."""
MODEL = types.Tuple((float64[::1], float64[:, ::1], float64[:, ::1]))  # type: ignore[no-untyped-call]
"""Residual (m,), Jacobian (m, 25), noise covariance (m, m)."""


@njit(MODEL(float64[::1], float64[::1], float64[::1], float64, float64[::1], float64[::1]), cache=True)
def inertial(x, gyro, accel, depth, sigma, moved):  # type: ignore[no-untyped-def]
    """Gyro (3,), accelerometer (3,) and depth; sigma (3,) in that order.

    The accelerometer gives the tilt: its model is gravity plus `moved` (3,), the acceleration that thrusters and drag
    give the body by the process model, body frame, taken as known.
    """
    residual = np.empty(7)
    h = np.zeros((7, ERRORS))
    variance = np.empty(7)
    rows = 0
    if not math.isnan(gyro[0]):
        for i in range(3):
            residual[i] = gyro[i] - x[10 + i] - x[13 + i]
            h[i, 9 + i] = h[i, 12 + i] = 1.0
            variance[i] = sigma[0] ** 2
        rows = 3
    if not math.isnan(accel[0]):
        down = to_matrix(x[3:7].copy())[2].copy()
        h[rows : rows + 3, 3:6] = -GRAVITY * skew(down)
        for i in range(3):
            residual[rows + i] = accel[i] - (x[16 + i] + moved[i] - GRAVITY * down[i])
            h[rows + i, 15 + i] = 1.0
            variance[rows + i] = sigma[1] ** 2
        rows += 3
    if not math.isnan(depth):
        residual[rows] = depth - x[2] - x[25]
        h[rows, 2] = h[rows, 24] = 1.0
        variance[rows] = sigma[2] ** 2
        rows += 1
    return residual[:rows].copy(), h[:rows].copy(), np.diag(variance[:rows])


@njit(MODEL(float64[::1], float64[::1], float64[::1], float64[::1], float64[::1]), cache=True)
def tag(x, p_wt, lever_b, q_wb, variance):  # type: ignore[no-untyped-def]
    """Tag centre p_wt (3,) at lever_b (3,) and attitude q_wb (4,); variance (6,) of position (world) and attitude
    (body).
    """
    q = x[3:7].copy()
    r = to_matrix(q)
    h = np.zeros((6, ERRORS))
    h[:3, :3] = np.eye(3)
    h[:3, 3:6] = -r @ skew(lever_b)
    h[3:, 3:6] = np.eye(3)
    residual = np.empty(6)
    residual[:3] = p_wt - x[:3] - r @ lever_b
    residual[3:] = difference(q_wb, q)
    return residual, h, np.diag(variance)


@njit(f"float64({V},{M},{M},{M})", cache=True)
def normalised_square(residual, h, noise, covariance):  # type: ignore[no-untyped-def]
    """Normalised innovation squared, residual^T S^-1 residual."""
    s = h @ covariance @ h.T + noise
    return residual @ np.linalg.solve(s, residual)


@njit(f"{V}({V},{M},{V},{M},float64,float64)", cache=True)
def carried_pose_variance(x, covariance, density, mass_inv, lag, rate_variance):  # type: ignore[no-untyped-def]
    """(6,) variance of position (world) and attitude (body) after carrying the state for `lag` seconds by gyro and
    model.

    Args:
        density: (25,) process noise, per second. rate_variance: of the carried attitude, rad^2/s.
    """
    r = to_matrix(x[3:7].copy())
    f = np.zeros((6, ERRORS))
    f[:, :6] = np.eye(6)
    f[:3, 6:9] = r * lag
    f[3:, 12:15] = -np.eye(3) * lag
    f[:3, 18:21] = r @ np.ascontiguousarray(mass_inv[:3, :3]) @ r.T * (0.5 * lag * lag)
    fp = f @ covariance
    out = np.empty(6)
    for i in range(6):
        out[i] = np.dot(fp[i], f[i])
    out[:3] += density[6:9] * lag**3 / 3.0
    out[3:] += rate_variance * lag
    return out
