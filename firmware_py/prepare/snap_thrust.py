"""Whether a body's thrusters can fly a path: the wrench that it asks for, and how much of their range that takes."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.optimize import linprog

from firmware_py.core import rotations
from firmware_py.core.body import Body
from firmware_py.core.drag_lookup import drag_wrench
from firmware_py.core.rigid_body import coriolis_wrench, restoring_moment

_MOST_PROGRAMS = 60
"""Points, the worst by the pseudo-inverse, whose usage is found exactly."""


def wrenches(body: Body, motion: np.ndarray) -> np.ndarray:
    """(k, 6) thruster wrench, body frame, that still water asks for: tau = M dnu/dt + C(nu) nu + D + g (paper eq. 2).

    Args:
        body: masses, drag, righting moment.
        motion: (k, 19) p_wb, q_wb, v_w, w_b, a_w, alpha_b.
    """
    out = np.empty((len(motion), 6))
    drag = body.drag
    for k, row in enumerate(np.ascontiguousarray(motion)):
        q, w = row[3:7], row[10:13]
        nu, change = np.empty(6), np.empty(6)
        nu[:3], nu[3:] = rotations.rotate_back(q, row[7:10]), w
        change[:3] = rotations.rotate_back(q, row[13:16]) - np.cross(w, nu[:3])
        change[3:] = row[16:19]
        out[k] = body.mass @ change + coriolis_wrench(body.mass, nu)
        out[k] -= drag_wrench(drag.nodes, drag.rotational, drag.linear, nu)
        out[k, 3:] -= restoring_moment(body.righting, q)
    return out


def usage(body: Body, wanted: np.ndarray) -> tuple[float, int]:
    """Largest share of the thrusters' range that any of the wrenches takes, and which one it is.

    The share of one wrench w is the least s for which forces f with J f = w and s f_min <= f <= s f_max exist. The
    pseudo-inverse bounds it from above; where that exceeds what any lower bound allows, a linear program finds it.

    Args:
        body: its thrusters.
        wanted: (k, 6) wrenches.
    """
    thrusters = body.thrusters
    forces = wanted @ thrusters.pinv.T
    above = np.maximum(forces / thrusters.f_max, forces / thrusters.f_min).max(axis=1)
    order = np.argsort(-above, kind="stable")[:_MOST_PROGRAMS]
    best, where = 0.0, int(order[0])
    for k in order:
        if above[k] <= best:
            break
        share = least_usage(body, wanted[k])
        if share > best:
            best, where = share, int(k)
    return best, where


def least_usage(body: Body, wrench: np.ndarray) -> float:
    """The share of one wrench (6,), by linear program (HiGHS); infinite for a wrench outside the thrusters' span."""
    thrusters = body.thrusters
    n = thrusters.matrix.shape[1]
    cost = np.zeros(n + 1)
    cost[-1] = 1.0
    equal = np.hstack([thrusters.matrix, np.zeros((6, 1))])
    upper = sparse.hstack([sparse.eye(n), -thrusters.f_max[:, None]])
    lower = sparse.hstack([-sparse.eye(n), thrusters.f_min[:, None]])
    result = linprog(
        cost,
        A_ub=sparse.vstack([upper, lower]).tocsc(),
        b_ub=np.zeros(2 * n),
        A_eq=sparse.csc_matrix(equal),
        b_eq=wrench,
        bounds=[(None, None)] * n + [(0.0, None)],
        method="highs",
    )
    return float(result.x[-1]) if result.success else float("inf")
