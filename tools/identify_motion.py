"""For tools/identify.py: the actual motion of a recorded flight, from kinematics alone, without mass, drag or thrusters.

A Kalman filter of position, velocity, attitude and the biases of gyro and accelerometer, driven by these two sensors and corrected by tags
at the times of their pictures, then smoothed backwards (Rauch, Tung, Striebel 1965). Nothing that the firmware assumes about the vehicle
can therefore leak into the fit.

State x (16,): position and velocity (world) 0:6, attitude 6:10, biases of gyro 10:13 and accelerometer 13:16. Its error e (15,):
dp 0:3 and dv 3:6 world, dtheta 6:9 body, dbg 9:12, dba 12:15.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from identify_log import Recording
from scipy.stats import chi2

from firmware_py.core.rotations import difference, exp, multiply, normalise, rotate, skew, to_matrix
from firmware_py.description.water import GRAVITY

STATES, ERRORS = 16, 15
INITIAL_SIGMA = np.repeat([0.05, 0.3, 0.05, 0.05, 0.3], 3)
"""Sigma of the error at the first tag: m, m/s, rad, rad/s, m/s^2."""
GATE = float(chi2.ppf(0.9999, 6))
"""Largest normalised innovation squared (NIS) of a tag that is accepted."""
SIXTH_DIFFERENCE = np.array([1.0, -6.0, 15.0, -20.0, 15.0, -6.0, 1.0])


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion over n ticks: position (n, 3) m and velocity (n, 3) m/s in the world, attitude (n, 4), rate (n, 3) rad/s in the body frame."""

    p_wb: np.ndarray
    v_w: np.ndarray
    q_wb: np.ndarray
    w_b: np.ndarray


def noise_of(samples: np.ndarray) -> float:
    """Standard deviation of the white noise of (n, 3) samples: motion is smooth, so sixth differences contain noise alone."""
    differences = sum(c * samples[i : len(samples) - 6 + i] for i, c in enumerate(SIXTH_DIFFERENCE))
    typical = 1.4826 * np.nanmedian(np.abs(differences), axis=0)
    return float(np.sqrt(np.mean(np.square(typical)) / np.sum(np.square(SIXTH_DIFFERENCE))))


def smooth(recording: Recording) -> Motion:
    """Motion of the centre of mass, by the filter and the backward smoother; these follow the IMU, whose motion the accelerometer feels."""
    gyro, accel = filled(recording.gyro), filled(recording.accel)
    noise = recording.noise
    density = np.repeat(
        [0.0, noise_of(accel), noise_of(gyro), noise.gyro_bias_walk, noise.accel_bias_walk], 3
    ) ** 2  # sensor noise per sample, bias walks per second
    density[3:9] *= recording.period_s
    poses = recording.poses
    tags = np.array([[(p.capture_ns - recording.time_ns[0]) * 1e-9 / recording.period_s, p.tags] for p in poses])
    lever = recording.body.r_bi[0]
    pictures = np.array([np.concatenate([p.p_wt, p.lever_b - lever, p.q_wb]) for p in poses])
    variance = np.repeat([noise.tag_sigma_m, noise.tag_sigma_axis_m, noise.tag_sigma_rad], [2, 1, 3]) ** 2
    first = pictures[0]
    start = np.zeros(STATES)
    start[6:10] = first[6:10]
    start[:3] = first[:3] - rotate(first[6:10].copy(), first[3:6].copy())
    order = np.argsort(tags[:, 0], kind="stable")
    states = _smooth(start, INITIAL_SIGMA, gyro, accel, recording.period_s, density, tags[order], pictures[order], variance, GATE)
    rate, turns = gyro - states[:, 10:13], [to_matrix(q) for q in states[:, 6:10].copy()]
    away = np.array([r @ np.stack([lever, np.cross(w, lever)], axis=1) for r, w in zip(turns, rate, strict=True)])
    return Motion(states[:, :3] - away[..., 0], states[:, 3:6] - away[..., 1], states[:, 6:10], rate)


def filled(samples: np.ndarray) -> np.ndarray:
    """(n, k) samples with missing ones interpolated."""
    out, rows = samples.copy(), np.arange(len(samples))
    for column in out.T:
        known = np.isfinite(column)
        column[:] = np.interp(rows, rows[known], column[known])
    return out


def _predict(x, gyro, accel, dt):
    """State after dt seconds of a mean rate and specific force (3,), and the (15, 15) transition of its error."""
    w, f = gyro - x[10:13], accel - x[13:16]
    half = multiply(x[6:10].copy(), exp(0.5 * dt * w))
    r = to_matrix(half)
    a = r @ f
    a[2] += GRAVITY
    out = x.copy()
    out[:3] += dt * x[3:6] + 0.5 * dt * dt * a
    out[3:6] += dt * a
    out[6:10] = normalise(multiply(x[6:10].copy(), exp(dt * w)))
    phi = np.eye(ERRORS)
    lean = r @ skew(f)
    for i in range(3):
        phi[i, 3 + i] = dt
        phi[6 + i, 9 + i] = -dt
    phi[:3, 6:9], phi[3:6, 6:9] = -0.5 * dt * dt * lean, -dt * lean
    phi[:3, 12:15], phi[3:6, 12:15] = -0.5 * dt * dt * r, -dt * r
    phi[6:9, 6:9] -= dt * skew(w)
    return out, phi


def _update(x, covariance, picture, late_s, gyro, variance, gate):
    """State and covariance after a picture taken `late_s` after the tick; unchanged where the gate is exceeded."""
    w = gyro - x[10:13]
    q = normalise(multiply(x[6:10].copy(), exp(late_s * w)))
    r = to_matrix(q)
    lever = picture[3:6].copy()
    residual = np.empty(6)
    residual[:3] = picture[:3] - x[:3] - late_s * x[3:6] - r @ lever
    residual[3:] = difference(picture[6:10].copy(), q)
    h = np.zeros((6, ERRORS))
    for i in range(3):
        h[i, i] = h[3 + i, 6 + i] = 1.0
        h[i, 3 + i] = late_s
    h[:3, 6:9] = -r @ skew(lever)
    ph = covariance @ h.T
    s = h @ ph + np.diag(variance)
    inverse = np.linalg.inv(s)
    if residual @ inverse @ residual > gate:
        return x, covariance
    gain = ph @ inverse
    keep = np.eye(ERRORS) - gain @ h
    after = keep @ covariance @ keep.T + gain @ np.diag(variance) @ gain.T
    return _apply_error(x, gain @ residual), after


def _apply_error(x, e):
    out = x.copy()
    out[:6] += e[:6]
    out[6:10] = normalise(multiply(x[6:10].copy(), exp(e[6:9].copy())))
    out[10:16] += e[9:15]
    return out


def _error_between(a, b):
    """(15,) error that, added to b, gives a."""
    out = np.empty(ERRORS)
    out[:6] = a[:6] - b[:6]
    out[6:9] = difference(a[6:10].copy(), b[6:10].copy())
    out[9:] = a[10:] - b[10:]
    return out


def _smooth(start, sigma, gyro, accel, dt, density, tags, pictures, variance, gate):
    """(n, 16) smoothed states.

    Args:
        gyro, accel: (n, 3). density: (15,) process noise, per second.
        tags: (k, 2) time of each picture in ticks since the first tick, and its number of tags, which divides the variance;
            pictures: (k, 10) tag centre, its lever, attitude. variance: (6,) measurement noise of one tag.
    """
    n = gyro.shape[0]
    ahead, after = np.empty((n, STATES)), np.empty((n, STATES))
    p_ahead, p_after = np.empty((n, ERRORS, ERRORS)), np.empty((n, ERRORS, ERRORS))
    phi = np.empty((n, ERRORS, ERRORS))
    x, p = start, np.diag(sigma * sigma)
    k = 0
    for i in range(n):
        if i > 0:
            x, phi[i] = _predict(x, 0.5 * (gyro[i - 1] + gyro[i]), 0.5 * (accel[i - 1] + accel[i]), dt)
            p = phi[i] @ p @ phi[i].T + np.diag(density * dt)
        ahead[i], p_ahead[i] = x, p
        while k < tags.shape[0] and tags[k, 0] < i + 0.5:
            x, p = _update(x, p, pictures[k], (tags[k, 0] - i) * dt, gyro[i], variance / tags[k, 1], gate)
            k += 1
        after[i], p_after[i] = x, p
    out = after.copy()
    for i in range(n - 2, -1, -1):
        gain = np.linalg.solve(p_ahead[i + 1], phi[i + 1] @ p_after[i]).T
        out[i] = _apply_error(after[i], gain @ _error_between(out[i + 1], ahead[i + 1]))
    return out
