"""Fossen's equations of motion of one body about its centre of mass: M dnu/dt + C(nu) nu + D + g(eta) = tau. Compiled.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from firmware_py.core.rotations import M, V, cross, rotate_back, skew


@njit(f"{M}({M},{V})", cache=True)
def coriolis(mass, nu):  # type: ignore[no-untyped-def]
    """(6, 6) Coriolis and centripetal matrix of a symmetric (6, 6) mass matrix; skew-symmetric for every nu.

    Fossen (2011), theorem 3.2: C = [[0, -S(M11 v + M12 w)], [-S(M11 v + M12 w), -S(M21 v + M22 w)]].
    """
    momentum = mass @ nu
    c = np.zeros((6, 6))
    linear = skew(momentum[:3].copy())
    c[:3, 3:] = -linear
    c[3:, :3] = -linear
    c[3:, 3:] = -skew(momentum[3:].copy())
    return c


@njit(f"{V}({M},{V})", cache=True)
def coriolis_wrench(mass, nu):  # type: ignore[no-untyped-def]
    """(6,) C(nu) nu without the matrix."""
    momentum = mass @ nu
    linear, angular = momentum[:3].copy(), momentum[3:].copy()
    v, w = nu[:3].copy(), nu[3:].copy()
    out = np.empty(6)
    out[:3] = cross(w, linear)
    out[3:] = cross(v, linear) + cross(w, angular)
    return out


@njit(f"{V}({V},{V})", cache=True)
def restoring_moment(righting, q_wb):  # type: ignore[no-untyped-def]
    """(3,) moment of buoyancy about the centre of mass, body frame, N m.

    Args:
        righting: (3,) buoyancy times centre of buoyancy from the centre of mass, body frame, N m.
    """
    down = np.array([0.0, 0.0, 1.0])
    return cross(righting, -rotate_back(q_wb, down))
