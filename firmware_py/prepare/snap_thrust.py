"""Checks whether a body can fly a path: the wrench that the path needs, the share of the thrusters' range that this takes, and
how far the body leans where a moment is left to buoyancy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numba import njit
from scipy.optimize import linprog

from firmware_py.core import rotations
from firmware_py.core.body import RANK_TOLERANCE, Body, rank_by
from firmware_py.core.drag_lookup import NODES, add_drag
from firmware_py.core.rigid_body import add_restoring, take_coriolis
from firmware_py.core.rotations import M, V, cross, rotate_back

_SATURATION_TOLERANCE = 1e-6
"""Tolerance, as a share of a thruster's limit, within which the thruster counts as saturated."""

_OUTSIDE = 1e-6
"""Share of a wrench that may lie outside the span through rounding."""
_NEGLIGIBLE_WRENCH = 1e-9
"""Size of a wrench that counts as zero, N and N m."""

_LEAN_STEP = 1e-4
"""Rotation of attitudes for the finite differences by lean, rad."""
_NO_STIFFNESS = 1e-6
"""Stiffness that counts as zero, N m/rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Division:
    """The wrench that k states of motion need, divided between thrusters and leaning.

    Attributes:
        thrust: (k, 6) wrench left to the thrusters, within their span, N and N m.
        lean: (k,) rad by which the body leans from the reference attitude until this wrench suffices; infinite where
            nothing keeps it from falling over.
        axis: (k,) index in AXES of the moment that leaning mainly stands in for.
        lacking: (k, 6) wrench that neither supplies; zero for motion that the body can fly.
    """

    thrust: np.ndarray
    lean: np.ndarray
    axis: np.ndarray
    lacking: np.ndarray


def wrenches(body: Body, motion: np.ndarray) -> np.ndarray:
    """(k, 6) thruster wrench, body frame, that the motion needs in still water: tau = M dnu/dt + C(nu) nu + D + g (paper eq. 2).

    Args:
        body: masses, drag, righting moment.
        motion: (k, 19) p_wb, q_wb, v_w, w_b, a_w, alpha_b.
    """
    out, drag = np.empty((len(motion), 6)), body.drag
    _take_wrenches(body.mass, body.righting, drag.nodes, drag.rotational, drag.linear, np.ascontiguousarray(motion), out)
    return out


@njit(f"void({M},{V},{NODES},{V},{V},{M},{M})", cache=True, error_model="numpy")
def _take_wrenches(mass, righting, nodes, rotational, linear, motion, out):  # type: ignore[no-untyped-def]
    """Writes the wrenches (k, 6) of motion (k, 19) to `out`, see `wrenches`; mass (6, 6), righting (3,), and fields of the DragTable."""
    nu, change, passive = np.empty(6), np.empty(6), np.empty(6)
    for k in range(len(motion)):
        q_wb, w_b = motion[k, 3:7], motion[k, 10:13]
        nu[:3], nu[3:] = rotate_back(q_wb, motion[k, 7:10]), w_b
        change[:3], change[3:] = rotate_back(q_wb, motion[k, 13:16]) - cross(w_b, nu[:3]), motion[k, 16:19]
        passive[:] = 0.0
        take_coriolis(mass, nu, passive)
        add_drag(nodes, rotational, linear, nu, passive)
        add_restoring(righting, q_wb, passive)
        for i in range(6):
            out[k, i] = -passive[i]
            for j in range(6):
                out[k, i] += mass[i, j] * change[j]


def divide(body: Body, motion: np.ndarray) -> Division:
    """Divides the wrench between the thrusters and, where these span fewer than six axes, buoyancy and water.

    The body leans by N s about the moments N outside the span: W + dW/ds s lies in the span if K s = -N' W with the stiffness
    K = N' dW/ds. Buoyancy makes K positive; the moment of the added mass on a moving body (Munk) may undo that.

    Args:
        body: thrusters, masses, drag, righting moment.
        motion: (k, 19) as for `wrenches`.
    """
    wanted = wrenches(body, motion)
    left, sizes, _ = np.linalg.svd(body.steered_matrix)
    outside = left[:, rank_by(sizes) :]
    if not outside.size:
        return Division(wanted, np.zeros(len(wanted)), np.full(len(wanted), 3), np.zeros_like(wanted))
    slope = np.stack([_change_by_lean(body, motion, axis) for axis in outside[3:].T], axis=2)
    stiffness = outside.T @ slope
    stiffness[np.abs(stiffness).max(axis=(1, 2)) < _NO_STIFFNESS] = 0.0
    s = -(np.linalg.pinv(stiffness, rcond=RANK_TOLERANCE) @ (wanted @ outside)[..., None])
    thrust = wanted + (slope @ s)[..., 0]
    lacking = thrust @ outside @ outside.T
    thrust -= lacking
    lacking[~_matters(lacking, wanted)] = 0.0
    leaning = (outside[3:] @ s)[..., 0]
    lean = np.linalg.norm(leaning, axis=1)
    lean[np.linalg.eigvalsh(stiffness + np.swapaxes(stiffness, 1, 2)).min(axis=1) < -_NO_STIFFNESS] = np.inf
    return Division(thrust, lean, 3 + np.argmax(np.abs(leaning), axis=1), lacking)


def _change_by_lean(body: Body, motion: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(k, 6) change of the wrenches per radian that the body leans about `axis` (3,), body frame."""
    ends = []
    for step in (_LEAN_STEP, -_LEAN_STEP):
        by, leant = rotations.exp(step * axis), motion.copy()
        leant[:, 3:7] = motion[:, 3:7] @ [rotations.multiply(unit, by) for unit in np.eye(4)]
        back = np.array([rotations.rotate_back(by, unit) for unit in np.eye(3)])
        leant[:, 10:13], leant[:, 16:19] = motion[:, 10:13] @ back, motion[:, 16:19] @ back
        ends.append(wrenches(body, leant))
    return np.asarray((ends[0] - ends[1]) / (2.0 * _LEAN_STEP))


def _matters(part: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(k,) whether a part (k, 6) of the wrenches (k, 6) exceeds rounding."""
    return np.asarray(np.linalg.norm(part, axis=1) > _OUTSIDE * np.linalg.norm(wanted, axis=1) + _NEGLIGIBLE_WRENCH)


def sag(wanted: np.ndarray, run: int) -> np.ndarray:
    """(k, 6) deviation of the wrench beside a row from the straight line to the next one: an eighth of the second difference.

    Args:
        wanted: (k, 6) wrenches.
        run: number of consecutive rows that are equally spaced samples of a smooth motion; fewer than three are no motion, with zero sag.
    """
    if run < 3:
        return np.zeros_like(wanted)
    rows = wanted.reshape(-1, run, 6)
    bend = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    return np.concatenate([bend[:, :1], bend, bend[:, -1:]], axis=1).reshape(wanted.shape) / -8.0


def usage(body: Body, wanted: np.ndarray, least: float = 0.0, sags: np.ndarray | None = None) -> tuple[float, int]:
    """Largest share of the thrusters' range that any of the wrenches takes, and the index of that wrench.

    The share of one wrench w is the least s for which forces f with J f = w and s f_min <= f <= s f_max exist; outside the
    thrusters' span it is infinite. The pseudo-inverse gives upper bounds. While the largest bound exceeds the largest share found,
    a linear program finds the share there, and its forces, divided alike, bound the shares of the neighbours. A few programs
    therefore suffice for a path, and no wrench is missed.

    The share is a gauge, convex and proportional to the wrench, so the share of a sum is at most the sum of the shares: between two
    rows it is at most the larger of theirs plus the share of the sag from the line between them.

    Args:
        body: with its thrusters.
        wanted: (k, 6) wrenches.
        least: share below which the maximum need not be exact; the result is then below it too.
        sags: (k, 6) result of `sag`, whose shares are added.
    """
    pinv = body.thrusters.pinv
    between = np.zeros(len(wanted)) if sags is None else _share(body, sags @ pinv.T)
    above = _bound(body, wanted, pinv) + between
    best, where = 0.0, int(np.argmax(above))
    while above[k := int(np.argmax(above))] > max(best, least):
        share, forces = least_usage(body, wanted[k])
        if share + between[k] > best:
            best, where = share + float(between[k]), k
        above = np.minimum(above, _bound(body, wanted, _division(body, share, forces)) + between)
        above[k] = -np.inf
    return best, where


def _bound(body: Body, wanted: np.ndarray, division: np.ndarray) -> np.ndarray:
    """(k,) upper bounds of the shares of wrenches (k, 6), from the forces that `division` (n, 6) maps them to; infinite where these forces
    do not produce the wrench.
    """
    forces = wanted @ division.T
    above = _share(body, forces)
    above[_matters(wanted - forces @ body.thrusters.matrix.T, wanted)] = np.inf
    return above


def _division(body: Body, share: float, forces: np.ndarray) -> np.ndarray:
    """(n, 6) linear map from wrenches to forces that generalises `forces` (n,), the least for one wrench: thrusters saturated at their
    `share` stay in proportion to each other, and the others supply the rest.
    """
    thrusters = body.thrusters
    limits = np.where(forces > 0.0, thrusters.f_max, thrusters.f_min)
    full = np.abs(forces - share * limits) <= _SATURATION_TOLERANCE * np.abs(limits)
    basis = np.column_stack([np.eye(len(forces))[:, ~full], np.where(full, limits, 0.0)])
    return np.asarray(basis @ np.linalg.pinv(thrusters.matrix @ basis))


def _share(body: Body, forces: np.ndarray) -> np.ndarray:
    """(k,) largest share of its range that any thruster uses for forces (k, n), N."""
    return np.asarray(np.maximum(forces / body.thrusters.f_max, forces / body.thrusters.f_min).max(axis=1))


def least_usage(body: Body, wrench: np.ndarray) -> tuple[float, np.ndarray]:
    """The share of one wrench (6,), and forces (n,) that reach it, N, by linear program (HiGHS).

    The share is infinite for a wrench outside the thrusters' span.
    """
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
    return (float(result.x[-1]), result.x[:-1]) if result.success else (float("inf"), np.zeros(n))
