"""Fossen's equations of motion of one body about its centre of mass: M dnu/dt + C(nu) nu + D + g(eta) = tau. Compiled.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from firmware_py.core.rotations import M, V


@njit(cache=True)
def take_coriolis(mass, nu, out):  # type: ignore[no-untyped-def]
    """Subtracts the (6,) wrench C(nu) nu from `out`; allocates nothing, because C is never formed.

    Fossen (2011), theorem 3.2, of a symmetric (6, 6) mass matrix: C = [[0, -S(M11 v + M12 w)], [-S(M11 v + M12 w), -S(M21 v + M22 w)]].
    """
    px, py, pz, hx, hy, hz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(6):
        px += mass[0, i] * nu[i]
        py += mass[1, i] * nu[i]
        pz += mass[2, i] * nu[i]
        hx += mass[3, i] * nu[i]
        hy += mass[4, i] * nu[i]
        hz += mass[5, i] * nu[i]
    u, v, w, p, q, r = nu[0], nu[1], nu[2], nu[3], nu[4], nu[5]
    out[0] -= q * pz - r * py
    out[1] -= r * px - p * pz
    out[2] -= p * py - q * px
    out[3] -= v * pz - w * py + q * hz - r * hy
    out[4] -= w * px - u * pz + r * hx - p * hz
    out[5] -= u * py - v * px + p * hy - q * hx


@njit(f"{V}({M},{V})", cache=True)
def coriolis_wrench(mass, nu):  # type: ignore[no-untyped-def]
    """Returns (6,) C(nu) nu."""
    out = np.zeros(6)
    take_coriolis(mass, nu, out)
    return -out


@njit(cache=True)
def add_restoring(righting, q_wb, out):  # type: ignore[no-untyped-def]
    """Adds the moment of buoyancy to the wrench `out` (6,): righting x (upward unit vector, body frame)."""
    w, x, y, z = q_wb[0], q_wb[1], q_wb[2], q_wb[3]
    ux, uy, uz = -2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -(1.0 - 2.0 * (x * x + y * y))
    out[3] += righting[1] * uz - righting[2] * uy
    out[4] += righting[2] * ux - righting[0] * uz
    out[5] += righting[0] * uy - righting[1] * ux


@njit(f"{V}({V},{V})", cache=True)
def restoring_moment(righting, q_wb):  # type: ignore[no-untyped-def]
    """Returns the (3,) moment of buoyancy about the centre of mass, body frame, N m.

    Args:
        righting: (3,) buoyancy times centre of buoyancy from the centre of mass, body frame, N m.
    """
    out = np.zeros(6)
    add_restoring(righting, q_wb, out)
    return out[3:].copy()
