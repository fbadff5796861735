"""The estimator's measurement models, compiled: residual, Jacobian and noise of the inertial sensors with depth, and
of a tag.

States and errors are those of `propagation`. A model has one row per measured number; a missing one (NaN) has no row.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from firmware_py.core.propagation import ERRORS, PLANT, STATE, carry, inertial_acceleration, inject, predict, squared_speeds
from firmware_py.core.rotations import M, V, difference, rotate_back, skew, to_matrix
from firmware_py.core.types import COMMAND_TIMEOUT_NS
from firmware_py.description.water import GRAVITY

ANY_NIS = math.inf
UNTOLD_S = COMMAND_TIMEOUT_NS / 1e9
"""Time within which thrust may fail unnoticed while no inertial sensor tells of the motion: so long a microcontroller that hears nothing
keeps its thrusters on. A robot that held a tilt without tags, and whose bus was interrupted for 0.3 s, was sure of an attitude that was
2 deg wrong, and swam metres off by it."""
MOST_SPEED_M_S, MOST_RATE_RAD_S = 10.0, 30.0
"""A state beyond these has diverged, and the filter begins anew. No thruster vehicle swims faster than a few m/s, in currents of up to two;
the GYRO frame ends at 16.4 rad/s about each axis, 28.4 in all. A robot that tumbled without a gyro did 7 rad/s; after a false depth the
filter believed 1e160 m/s."""


@njit(cache=True)
def inertial(x, gyro, accel, depth, sigma, moved, mobility):  # type: ignore[no-untyped-def]
    """Measurement model of gyro (3,), accelerometer (3,) and depth; sigma (3,) in that order.

    The accelerometer observes the tilt and the disturbance: its model is gravity plus `moved` (3,), the acceleration of the body by the
    process model from thrusters, drag and disturbance, body frame. mobility: (3, 3) acceleration per force, body frame.
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
        r = to_matrix(x[3:7])
        down, pushed = r[2], rotate_back(x[3:7], x[19:22])
        h[rows : rows + 3, 3:6] = mobility @ skew(pushed) - GRAVITY * skew(down)
        h[rows : rows + 3, 18:21] = mobility @ np.ascontiguousarray(r.T)
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
    return residual[:rows], h[:rows], variance[:rows]


@njit(cache=True)
def tag(x, p_wt, lever_b, q_wb, variance):  # type: ignore[no-untyped-def]
    """Measurement model of a tag: centre p_wt (3,) at lever_b (3,) and attitude q_wb (4,); variance (6,) of position (world) and
    attitude (body).
    """
    q = x[3:7]
    r = to_matrix(q)
    h = np.zeros((6, ERRORS))
    h[:3, :3] = np.eye(3)
    h[:3, 3:6] = -r @ skew(lever_b)
    h[3:, 3:6] = np.eye(3)
    residual = np.empty(6)
    residual[:3] = p_wt - x[:3] - r @ lever_b
    residual[3:] = difference(q_wb, q)
    return residual, h, variance


@njit(cache=True)
def update(x, covariance, residual, h, variance, shared, gate):  # type: ignore[no-untyped-def]
    """Returns the normalised innovation squared, and state and covariance after the measurement; unchanged where `gate` is exceeded.

    The Kalman filter's update, one row at a time: the noise of the rows is independent, so that no matrix is inverted, and the
    squared innovations over their variances add up to residual^T S^-1 residual (Bierman 1977, chapter II). filterpy's
    update gives the same result (tests) in eight times the time.

    Args:
        x, covariance: (32,) and (28, 28).
        residual, h, variance: (m,), (m, 28), (m,) of the measurement.
        shared: (m, 28) covariance of each row's noise with the error, for a disturbance that both moves the state and is measured. Non-zero
            only for errors that no row observes (a column of zeros in h), so that the rows stay independent.
        gate: largest normalised innovation squared that is accepted. A NaN is not.
    """
    p = covariance.copy()
    error = np.zeros(ERRORS)
    ph = np.empty(ERRORS)
    nis = 0.0
    for row in range(residual.size):
        innovation, s = residual[row], variance[row]
        for i in range(ERRORS):
            ph[i] = shared[row, i]
        for j in range(ERRORS):
            share = h[row, j]
            if share != 0.0:
                innovation -= share * error[j]
                for i in range(ERRORS):
                    ph[i] += share * p[j, i]
        for j in range(ERRORS):
            s += h[row, j] * ph[j]
        root = 1.0 / math.sqrt(s)
        innovation *= root
        nis += innovation**2
        for i in range(ERRORS):
            ph[i] *= root  # so that the reduction of p is symmetric to the last bit
        for i in range(ERRORS):
            gain = ph[i]
            error[i] += gain * innovation
            for j in range(ERRORS):
                p[i, j] -= gain * ph[j]
    if not nis <= gate:
        return nis, x.copy(), covariance.copy()
    return nis, inject(x, error), p


@njit(cache=True)
def fuse_inertial(  # type: ignore[no-untyped-def]
    x, covariance, tau, gyro, accel, depth, elapsed, dt, density, under_way, sigma, mass, mass_inv, righting, nodes, rotational, linear
):  # fmt: skip
    """Returns state and covariance after one sample of gyro, accelerometer and depth, each NaN where missing.

    The unmodelled acceleration (white, `density` (28,) per second) has moved the body over the `elapsed` seconds of the last prediction,
    and the accelerometer has measured it: so the velocity follows the measured acceleration, not the commanded one. A sample that is
    fused for only a part of its `dt` seconds is weighted for that part. Under way the accelerometer noise is larger (`under_way`, as in
    `predict`), because mass and drag are uncertain.
    """
    moved = inertial_acceleration(x, tau, mass, mass_inv, righting, nodes, rotational, linear)
    mobility = np.ascontiguousarray(mass_inv[:3, :3])
    residual, h, variance = inertial(x, gyro, accel, depth, sigma, moved, mobility)
    shared = np.zeros((residual.size, ERRORS))
    if not math.isnan(accel[0]) and elapsed > 0.0:
        first = 0 if math.isnan(gyro[0]) else 3
        speed, rate = squared_speeds(x)
        moving = under_way[3] ** 2 * speed + under_way[4] ** 2 * rate
        for i in range(3):
            shared[first + i, 6 + i] = density[6 + i]
            variance[first + i] = ((variance[first + i] + moving) * dt + density[6 + i]) / elapsed
    _, x_after, after = update(x, covariance, residual, h, variance, shared, ANY_NIS)
    return x_after, after


@njit(f"{STATE}({V},{M},{M},{M},{M},float64,int64,float64,float64,{V},{V},{V},{PLANT})", cache=True)
def advance(  # type: ignore[no-untyped-def]
    x, covariance, taus, gyros, accels_depths, first, count, dt, rest, density, under_way, sigma,
    mass, mass_inv, righting, nodes, rotational, linear,
):  # fmt: skip
    """Returns state and covariance advanced through stored samples, each fused at its time.

    Args:
        taus: (k, 6), gyros: (k, 3), accels_depths: (k, 4) accelerometer and depth, of each tick, NaN where missing.
        first: time to the first sample, s; count: samples to fuse; dt: time between them, s; rest: time left after the last, s.
        density, under_way: as in `predict`. sigma: (3,) as in `inertial`.
    """
    for i in range(count):
        tau, elapsed = taus[i], first if i == 0 else dt
        noise = density
        if math.isnan(gyros[i, 0]) and math.isnan(accels_depths[i, 0]):
            noise = density.copy()
            noise[6:12] += UNTOLD_S * (mass_inv @ tau) ** 2
        x, covariance = predict(x, covariance, tau, elapsed, noise, under_way, mass, mass_inv, righting, nodes, rotational, linear)
        x, covariance = fuse_inertial(
            x, covariance, tau, gyros[i], accels_depths[i, :3], accels_depths[i, 3], elapsed, dt, density, under_way, sigma,
            mass, mass_inv, righting, nodes, rotational, linear,
        )  # fmt: skip
    if rest > 0.0:
        tau = taus[count]
        x, covariance = predict(x, covariance, tau, rest, density, under_way, mass, mass_inv, righting, nodes, rotational, linear)
        x, covariance = fuse_inertial(
            x, covariance, tau, np.full(3, math.nan), accels_depths[count, :3], math.nan, rest, dt, density, under_way, sigma,
            mass, mass_inv, righting, nodes, rotational, linear,
        )  # fmt: skip
    return x, covariance


@njit(f"Tuple((float64,{V},{M}))({V},{M},{V},{V},{V},{V},float64,float64)", cache=True)
def fuse_tag(x, covariance, p_wt, lever_b, q_wb, variance, tags, gate):  # type: ignore[no-untyped-def]
    """Applies `update` with the mean pose of one picture, worth `tags` tags (variance / tags)."""
    residual, h, noise = tag(x, p_wt, lever_b, q_wb, variance / tags)
    return update(x, covariance, residual, h, noise, np.zeros((6, ERRORS)), gate)


@njit(f"{STATE}({V},{M},float64,int64,float64)", cache=True)
def fuse_stillness(x, covariance, variance, axes, heading_variance):  # type: ignore[no-untyped-def]
    """Returns state (32,) and covariance (28, 28) after pseudo-measurements: zero velocity over ground, and the believed heading.

    Args:
        variance: variance of the zero velocity, (m/s)^2; axes: 2 for the horizontal velocity alone, 3 for the vertical one too.
        heading_variance: rad^2; infinite leaves the heading unmeasured.
    """
    r, rows = to_matrix(x[3:7]), axes + 1
    h, residual, noise = np.zeros((rows, ERRORS)), np.zeros(rows), np.full(rows, variance)
    for i in range(axes):
        h[i, 6:9] = r[i]
        residual[i] = -np.dot(r[i], x[7:10])
    h[axes, 3:6] = r[2]
    noise[axes] = heading_variance
    _, x_after, after = update(x, covariance, residual, h, noise, np.zeros((rows, ERRORS)), ANY_NIS)
    return x_after, after


@njit(cache=True)
def carried_pose_variance(x, covariance, density, mass_inv, lag, rate_variance):  # type: ignore[no-untyped-def]
    """Returns the (6,) variance of position (world) and attitude (body) after carrying the state for `lag` seconds by gyro and
    model.

    Args:
        density: (28,) process noise, per second. rate_variance: growth of the attitude variance, rad^2/s.
    """
    r = to_matrix(x[3:7])
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


@njit(f"boolean({V},{V})", cache=True)
def are_finite(a, b):  # type: ignore[no-untyped-def]
    """Whether every number of two vectors is finite."""
    return bool(np.all(np.isfinite(a)) and np.all(np.isfinite(b)))


@njit(cache=True)
def is_sound(x, variance):  # type: ignore[no-untyped-def]
    """Whether a state (32,) is finite and its speed and rate are possible, and every variance (6,) is finite and not negative."""
    speed = math.sqrt(x[7] ** 2 + x[8] ** 2 + x[9] ** 2)
    rate = math.sqrt(x[10] ** 2 + x[11] ** 2 + x[12] ** 2)
    return bool(are_finite(x, variance) and variance.min() >= 0.0 and speed <= MOST_SPEED_M_S and rate <= MOST_RATE_RAD_S)


@njit(f"Tuple(({V},{V},boolean))({V},{M},{M},{M},float64,float64,{V},float64,float64,{PLANT})", cache=True)
def carried(  # type: ignore[no-untyped-def]
    x, covariance, taus, gyros, dt, until_first, density, lag, rate_variance, mass, mass_inv, righting, nodes, rotational, linear
):  # fmt: skip
    """Returns state (32,) now, sigma (6,) of its pose, and whether both are sound. Arguments as `carry` and `carried_pose_variance`."""
    now = carry(x, taus, gyros, dt, until_first, mass, mass_inv, righting, nodes, rotational, linear)
    variance = carried_pose_variance(x, covariance, density, mass_inv, lag, rate_variance)
    return now, np.sqrt(variance), is_sound(now, variance)
