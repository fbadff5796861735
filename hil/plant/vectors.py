"""Vectors as tuples of three floats, for compiled code: they live in registers, where arrays of three would cost more than the sums."""

from __future__ import annotations

from numba import njit, types

F8 = types.float64
F1, F2, F3 = F8[::1], F8[:, ::1], F8[:, :, ::1]
I1 = types.int64[::1]
V3 = types.UniTuple(F8, 3)
M3 = types.UniTuple(V3, 3)


@njit(V3(V3, V3), cache=True)
def cross(a, b):
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(V3(V3, V3), cache=True)
def plus(a, b):
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@njit(V3(V3, V3), cache=True)
def minus(a, b):
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@njit(V3(F8, V3), cache=True)
def times(s, a):
    """s a."""
    return (s * a[0], s * a[1], s * a[2])


@njit(F8(V3, V3), cache=True)
def dot(a, b):
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(V3(M3, V3), cache=True)
def turn(r, a):
    """r a."""
    return (dot(r[0], a), dot(r[1], a), dot(r[2], a))


@njit(V3(M3, V3), cache=True)
def turn_back(r, a):
    """r^T a."""
    return (
        r[0][0] * a[0] + r[1][0] * a[1] + r[2][0] * a[2],
        r[0][1] * a[0] + r[1][1] * a[1] + r[2][1] * a[2],
        r[0][2] * a[0] + r[1][2] * a[1] + r[2][2] * a[2],
    )


@njit(V3(F2, types.int64, types.int64), cache=True)
def triple(array, row, first):
    """Three numbers of a row, from column `first`."""
    return (array[row, first], array[row, first + 1], array[row, first + 2])


@njit(M3(F3, types.int64), cache=True)
def matrix(array, row):
    """Matrix number `row`."""
    return (
        (array[row, 0, 0], array[row, 0, 1], array[row, 0, 2]),
        (array[row, 1, 0], array[row, 1, 1], array[row, 1, 2]),
        (array[row, 2, 0], array[row, 2, 1], array[row, 2, 2]),
    )


@njit(M3(F8, F8, F8, F8), cache=True)
def matrix_of(w, i, j, k):
    """Rotation matrix of a unit quaternion."""
    return (
        (1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - w * k), 2.0 * (i * k + w * j)),
        (2.0 * (i * j + w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k - w * i)),
        (2.0 * (i * k - w * j), 2.0 * (j * k + w * i), 1.0 - 2.0 * (i * i + j * j)),
    )
