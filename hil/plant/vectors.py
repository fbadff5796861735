"""Vectors as tuples of three floats for compiled code: tuples stay in registers, arrays would cost more than the arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba import njit, types

F8, I8 = types.float64, types.int64
F1, F2, F3 = F8[::1], F8[:, ::1], F8[:, :, ::1]
I1 = I8[::1]
V3 = types.UniTuple(F8, 3)
M3 = types.UniTuple(V3, 3)


def compiled(signature: Any, makes_arrays: bool = False, **options: bool) -> Callable[[Callable[..., Any]], Any]:
    """Compiles for one signature; None: lazily, for any. Division by zero gives infinity as in numpy, since checks would cost a third.

    Args:
        makes_arrays: whether the code allocates arrays. Code that does not can skip reference counting, which costs more than the
            arithmetic (numba's undocumented option `_nrt`).
        options: of numba.njit.
    """
    how = {"cache": True, "error_model": "numpy", "_nrt": makes_arrays, **options}
    return cast("Callable[[Callable[..., Any]], Any]", njit(signature, **how))  # type: ignore[call-overload]


callee = compiled(None)
"""Compiles a function that only compiled code calls, for the types of each call; it is built and cached with its callers."""
inlined = compiled(None, forceinline=True)
"""As `callee`, and inlined into its callers, so that a loop over lanes can be vectorised."""


@inlined
def cross(a, b):
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def plus(a, b):
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inlined
def minus(a, b):
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inlined
def times(s, a):
    """s a."""
    return (s * a[0], s * a[1], s * a[2])


@inlined
def dot(a, b):
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def turn(r, a):
    """r a."""
    return (dot(r[0], a), dot(r[1], a), dot(r[2], a))


@inlined
def turn_back(r, a):
    """r^T a."""
    return (
        r[0][0] * a[0] + r[1][0] * a[1] + r[2][0] * a[2],
        r[0][1] * a[0] + r[1][1] * a[1] + r[2][1] * a[2],
        r[0][2] * a[0] + r[1][2] * a[1] + r[2][2] * a[2],
    )


@inlined
def column(r, k):
    """Column k of r: axis k of its frame."""
    return (r[0][k], r[1][k], r[2][k])


@inlined
def mass_times(mass, v, w):
    """Linear and angular momentum of a body with velocity v and rate w: the product of `mass` (see `mass_of`) and (v, w)."""
    p, spin = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for j in range(3):
        p = plus(p, times(v[j], (mass[0][0][j], mass[0][1][j], mass[0][2][j])))
        p = plus(p, times(w[j], (mass[1][0][j], mass[1][1][j], mass[1][2][j])))
        spin = plus(spin, times(v[j], (mass[2][0][j], mass[2][1][j], mass[2][2][j])))
        spin = plus(spin, times(w[j], (mass[3][0][j], mass[3][1][j], mass[3][2][j])))
    return p, spin


@callee
def triple(array, row, first):
    """Three numbers of a row, from column `first`."""
    return (array[row, first], array[row, first + 1], array[row, first + 2])


@callee
def six(array, row):
    """Six numbers of a row."""
    return (array[row, 0], array[row, 1], array[row, 2], array[row, 3], array[row, 4], array[row, 5])


@callee
def block(array, b, i, j):
    """Rows i to i + 2, columns j to j + 2 of matrix number b."""
    return (
        (array[b, i, j], array[b, i, j + 1], array[b, i, j + 2]),
        (array[b, i + 1, j], array[b, i + 1, j + 1], array[b, i + 1, j + 2]),
        (array[b, i + 2, j], array[b, i + 2, j + 1], array[b, i + 2, j + 2]),
    )


@callee
def mass_of(array, b):
    """Mass matrix number b as four blocks: force by linear, force by angular, moment by linear, moment by angular acceleration."""
    return (block(array, b, 0, 0), block(array, b, 0, 3), block(array, b, 3, 0), block(array, b, 3, 3))


@callee
def matrix(array, row):
    """Matrix number `row`."""
    return (
        (array[row, 0, 0], array[row, 0, 1], array[row, 0, 2]),
        (array[row, 1, 0], array[row, 1, 1], array[row, 1, 2]),
        (array[row, 2, 0], array[row, 2, 1], array[row, 2, 2]),
    )


@inlined
def matrix_of(w, i, j, k):
    """Rotation matrix of a unit quaternion."""
    return (
        (1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - w * k), 2.0 * (i * k + w * j)),
        (2.0 * (i * j + w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k - w * i)),
        (2.0 * (i * k - w * j), 2.0 * (j * k + w * i), 1.0 - 2.0 * (i * i + j * j)),
    )
