"""Rotations: quaternions are scalar first; q_ab rotates vectors from frame b into frame a. Compiled; used by every stage."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

V = "float64[::1]"
M = "float64[:,::1]"
"""Numba types of a vector and of a matrix, for the signatures of compiled functions."""


@njit(cache=True)
def _product(a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """Hamilton product of (a, b, c, d) and (e, f, g, h)."""
    return a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e


@njit(cache=True)
def _exp(x, y, z):  # type: ignore[no-untyped-def]
    """Unit quaternion of the rotation vector (x, y, z), rad."""
    angle = math.sqrt(x**2 + y**2 + z**2)
    s = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), s * x, s * y, s * z


@njit(f"UniTuple(float64,3)({','.join(['float64'] * 7)})", cache=True)
def _turned(w, x, y, z, a, b, c):  # type: ignore[no-untyped-def]
    """(a, b, c) rotated by the unit quaternion (w, x, y, z)."""
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx


@njit(f"UniTuple(float64,3)({V},{','.join(['float64'] * 3)})", cache=True)
def turned(q, a, b, c):  # type: ignore[no-untyped-def]
    """q v q^-1 of q (4,) and v = (a, b, c), as a tuple without an array."""
    return _turned(q[0], q[1], q[2], q[3], a, b, c)


@njit(cache=True)
def turned_back(q, a, b, c):  # type: ignore[no-untyped-def]
    """q^-1 v q of q (4,) and v = (a, b, c), as a tuple without an array."""
    return _turned(q[0], -q[1], -q[2], -q[3], a, b, c)


@njit(f"void({V},{','.join(['float64'] * 3)},{V})", cache=True)
def turn(q, a, b, c, out):  # type: ignore[no-untyped-def]
    """Writes to `out` (4,) the attitude q turned by the rotation vector (a, b, c), rad, given in its own frame."""
    out[0], out[1], out[2], out[3] = _product(q[0], q[1], q[2], q[3], *_exp(a, b, c))


@njit(f"{V}({V},{V})", cache=True)
def multiply(a, b):  # type: ignore[no-untyped-def]
    """Hamilton product a * b, (4,)."""
    return np.array(_product(a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]))


@njit(f"{V}({V})", cache=True)
def conjugate(q):  # type: ignore[no-untyped-def]
    """Inverse of a unit quaternion, (4,)."""
    return np.array([q[0], -q[1], -q[2], -q[3]])


@njit(f"{V}({V})", cache=True)
def normalise(q):  # type: ignore[no-untyped-def]
    """q / |q|, with the sign that makes the scalar part non-negative."""
    n = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return q / (n if q[0] >= 0.0 else -n)


@njit(f"{M}({V})", cache=True)
def to_matrix(q):  # type: ignore[no-untyped-def]
    """(3, 3) rotation matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


@njit(f"{V}({M})", cache=True)
def from_matrix(r):  # type: ignore[no-untyped-def]
    """Unit quaternion of a (3, 3) rotation matrix (Shepperd's method: the largest component is computed first)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    squares = np.array([trace, r[0, 0], r[1, 1], r[2, 2]])
    k = np.argmax(squares)
    q = np.empty(4)
    if k == 0:
        q[0] = 1.0 + trace
        q[1], q[2], q[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    else:
        i = k - 1
        j, m = (i + 1) % 3, (i + 2) % 3
        q[1 + i] = 1.0 + r[i, i] - r[j, j] - r[m, m]
        q[0] = r[m, j] - r[j, m]
        q[1 + j] = r[j, i] + r[i, j]
        q[1 + m] = r[m, i] + r[i, m]
    return normalise(q)


@njit(f"{V}({V})", cache=True)
def exp(v):  # type: ignore[no-untyped-def]
    """Unit quaternion of a rotation vector, (3,) rad -> (4,)."""
    return np.array(_exp(v[0], v[1], v[2]))


@njit(f"{V}({V})", cache=True)
def log(q):  # type: ignore[no-untyped-def]
    """Rotation vector of a unit quaternion, (4,) -> (3,) rad, angle at most pi."""
    sign = 1.0 if q[0] >= 0.0 else -1.0
    s = math.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    k = 2.0 * sign if s < 1e-9 else 2.0 * math.atan2(s, sign * q[0]) * sign / s
    return np.array([k * q[1], k * q[2], k * q[3]])


@njit(f"{V}({V},{V})", cache=True)
def difference(a, b):  # type: ignore[no-untyped-def]
    """Rotation vector, in frame b, that turns attitude b into attitude a: log(b^-1 a)."""
    return log(multiply(conjugate(b), a))


@njit(f"{M}({V})", cache=True)
def skew(v):  # type: ignore[no-untyped-def]
    """(3, 3) cross-product matrix S with S u = v x u."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(f"{V}({V},{V})", cache=True)
def cross(a, b):  # type: ignore[no-untyped-def]
    """a x b, (3,)."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(f"{V}({V},{V})", cache=True)
def rotate(q, v):  # type: ignore[no-untyped-def]
    """q v q^-1, (3,)."""
    return np.array(turned(q, v[0], v[1], v[2]))


@njit(f"{V}({V},{V})", cache=True)
def rotate_back(q, v):  # type: ignore[no-untyped-def]
    """q^-1 v q, (3,)."""
    return np.array(turned_back(q, v[0], v[1], v[2]))


def from_euler(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Unit quaternion of the aerospace sequence yaw, pitch, roll (z, y', x'')."""
    half = 0.5 * np.array([roll, pitch, yaw])
    qx = np.array([math.cos(half[0]), math.sin(half[0]), 0.0, 0.0])
    qy = np.array([math.cos(half[1]), 0.0, math.sin(half[1]), 0.0])
    qz = np.array([math.cos(half[2]), 0.0, 0.0, math.sin(half[2])])
    return np.asarray(multiply(multiply(qz, qy), qx))


def to_euler(q: np.ndarray) -> tuple[float, float, float]:
    """Roll, pitch, yaw of the aerospace sequence, for display and MAVLink only; no controller uses them."""
    w, x, y, z = (float(c) for c in q)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def heading(q_wb: np.ndarray) -> np.ndarray:
    """Returns the level attitude (4,) with the body's heading; near vertical, the heading of its top (nose down) or bottom (nose up)."""
    r = np.asarray(to_matrix(q_wb))
    x = r[:, 0] if math.hypot(r[0, 0], r[1, 0]) > 0.3 else r[:, 2] * (1.0 if r[2, 0] < 0.0 else -1.0)
    return np.asarray(from_euler(0.0, 0.0, math.atan2(x[1], x[0])))
