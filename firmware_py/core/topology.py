"""How joining and parting of bodies transforms estimator state and covariance. No Body is built here.

The new Body comes prepared (prepare.docking). Velocities of a joined body follow from conservation of momentum.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.propagation import ERRORS, STATES
from firmware_py.core.rotations import conjugate, cross, multiply, normalise, rotate, rotate_back, skew, to_matrix

JOINED_SIGMA = (0.003, 0.01, 0.01, 0.03)
"""Added to a joined body's sigma: position m, attitude rad, velocity m/s, rate rad/s. Covers the play of the faces, and the shock."""
PARTED_SIGMA = (0.07, 0.05, 0.07, 0.1)
"""The same for a parted body: magnets push the pieces apart for up to a second (`release_s`) before they are flown as two. On the bench
each has by then moved 70 mm and 0.05 rad, at 70 mm/s and 0.1 rad/s (dock-undock-dock, seed 1)."""
BIAS_SPREAD = np.repeat([0.005, 0.05, 0.02], [3, 3, 1])
"""(7,) sigma of the biases of gyro, rad/s, accelerometer, m/s^2, and depth, m, between modules (synthetic, as the bench draws
them). A body estimates their mean."""
BIASES = np.r_[12:18, 24]
"""Indices of these biases in the error state."""
LEVEL = np.array([1.0, 1.0, 0.0])
"""Mask of the horizontal part of a force in the world."""
TURNING = np.ix_(np.r_[21:24, 25:28], np.r_[21:24, 25:28])
"""Index of disturbance moment and righting in a covariance (28, 28)."""


class Motion(NamedTuple):
    """State of one body's estimator at one time: x (32,) and covariance (28, 28), as core.propagation orders them."""

    x: np.ndarray
    covariance: np.ndarray
    accepted: int
    """Number of tag observations accepted so far."""
    tag_ns: int
    """Time of the newest tag observation."""


def down_of(x: np.ndarray) -> np.ndarray:
    """(3,) unit vector down, in the axes of a body in state x."""
    return np.asarray(to_matrix(x[3:7].copy())[2])


def in_both(mine: Sequence[int], theirs: Sequence[int]) -> list[tuple[int, int]]:
    """Index pairs (in `mine`, in `theirs`) of the modules that are in both bodies."""
    return [(i, theirs.index(module)) for i, module in enumerate(mine) if module in theirs]


def join(parts: Sequence[tuple[Body, Motion]], body: Body) -> Motion:
    """State of `body`, made of the bodies `parts`; its first module is one of the first part."""
    x = np.zeros(STATES)
    first, motion = parts[0]
    x[3:7] = _attitude(first, motion.x, body)
    x[:3] = _position(first, motion.x, body, x[3:7])
    momentum, force, moment, off = np.zeros(6), np.zeros(3), np.zeros(3), np.zeros(3)
    for part, moved in parts:
        lever_b, turn = _place(part, body)
        h = _transport(lever_b, turn)
        momentum += h.T @ part.mass @ moved.x[7:13]
        force += moved.x[19:22]
        level_b = rotate_back(x[3:7].copy(), moved.x[19:22] * LEVEL)
        moment += turn.T @ moved.x[22:25] + cross(lever_b, level_b)
        off += turn.T @ moved.x[26:29] - lever_b * moved.x[21]  # a vertical force at a lever has a righting moment
    x[7:13] = body.mass_inv @ momentum
    x[19:22], x[22:25], x[26:29] = force, moment, off
    modules = [len(part.modules) for part, _ in parts]
    x[13:19] = np.average([_biases(part, moved.x, body) for part, moved in parts], axis=0, weights=modules)
    x[25] = np.average([moved.x[25] for _, moved in parts], weights=modules)
    x[29:] = down_of(x)
    accepted, tag_ns = min(moved.accepted for _, moved in parts), min(moved.tag_ns for _, moved in parts)
    return Motion(x, _covariance(motion, first, x, body, JOINED_SIGMA), accepted, tag_ns)


def part_of(whole: Body, motion: Motion, body: Body) -> Motion:
    """State of `body`, which was a piece of `whole`. The disturbance is shared out by mass."""
    x = motion.x.copy()
    x[3:7] = _attitude(whole, motion.x, body)
    x[:3] = _position(whole, motion.x, body, x[3:7])
    lever_b, turn = _place(body, whole)
    x[7:13] = _transport(lever_b, turn) @ motion.x[7:13]
    share = body.rigid_mass_kg / whole.rigid_mass_kg
    x[19:22] = motion.x[19:22] * share
    x[22:25] = turn @ motion.x[22:25] * share
    x[26:29] = turn @ motion.x[26:29] * share
    x[13:19] = _biases(whole, motion.x, body)
    x[29:] = down_of(x)
    covariance = _covariance(motion, whole, x, body, PARTED_SIGMA)
    covariance[BIASES, BIASES] += BIAS_SPREAD**2 * (1.0 / len(body.modules) - 1.0 / len(whole.modules))
    return Motion(x, covariance, motion.accepted, motion.tag_ns)


def _place(part: Body, whole: Body) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass of `part` from that of `whole` (3,), and (3, 3) whole frame to part frame; either may be the larger."""
    i, j = in_both(part.modules, whole.modules)[0]
    q_wp = multiply(np.ascontiguousarray(whole.q_bm[j]), conjugate(np.ascontiguousarray(part.q_bm[i])))
    r_wp = to_matrix(normalise(q_wp))
    return whole.r_bm[j] - r_wp @ part.r_bm[i], np.ascontiguousarray(r_wp.T)


def moved_wrench(old: Body, new: Body) -> np.ndarray:
    """(6, 6) matrix that takes a wrench on `old` to the same one on `new`, each about its body's centre of mass and along its axes. The
    bodies share a module.
    """
    return _transport(*_place(old, new)).T  # as nu_old = H nu_new, and the power is the same


def _transport(lever_b: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """(6, 6) H with nu_part = H nu_whole, for a part at `lever_b` whose axes are `turn` @ those of the whole."""
    h = np.zeros((6, 6))
    h[:3, :3] = h[3:, 3:] = turn
    h[:3, 3:] = -turn @ skew(np.ascontiguousarray(lever_b))
    return h


def _attitude(old: Body, x: np.ndarray, new: Body) -> np.ndarray:
    """(4,) attitude of `new` from that of `old`, by a module that both contain."""
    i, j = in_both(old.modules, new.modules)[0]
    turn = multiply(np.ascontiguousarray(old.q_bm[i]), conjugate(np.ascontiguousarray(new.q_bm[j])))
    return np.asarray(normalise(multiply(x[3:7].copy(), turn)))


def _position(old: Body, x: np.ndarray, new: Body, q_new: np.ndarray) -> np.ndarray:
    i, j = in_both(old.modules, new.modules)[0]
    p_wm = x[:3] + rotate(x[3:7].copy(), np.ascontiguousarray(old.r_bm[i]))
    return np.asarray(p_wm - rotate(q_new, np.ascontiguousarray(new.r_bm[j])))


def _biases(old: Body, x: np.ndarray, new: Body) -> np.ndarray:
    """(6,) gyro and accelerometer bias in the axes of `new`."""
    _, turn = _place(new, old)
    return np.concatenate([turn @ x[13:16], turn @ x[16:19]])


def _covariance(old: Motion, before: Body, x: np.ndarray, after: Body, shock: Sequence[float]) -> np.ndarray:
    """(28, 28) covariance of the new body in state x: variances of the old one about the new axes, increased by the shock; that of the
    disturbance force is scaled by mass.

    All correlations but one are dropped. How the acting moment divides into disturbance and righting is unknown for the new body, and
    righting starts with its initial sigma; but their sum, the acting moment, is known as well as before, scaled by inertia.

    Args:
        shock: sigma to add to position m, attitude rad, velocity m/s, rate rad/s.
    """
    variance = old.covariance.diagonal().copy()
    turn = to_matrix(x[3:7].copy()).T @ to_matrix(old.x[3:7].copy())
    variance[3:18] = (variance[3:18].reshape(5, 3) @ np.square(turn).T).ravel()
    variance[18:21] *= (after.rigid_mass_kg / before.rigid_mass_kg) ** 2
    variance[:12] += np.repeat(np.array(shock), 3) ** 2
    out = np.diag(variance)
    assert len(out) == ERRORS
    acts, lean = turn @ np.hstack([np.eye(3), skew(down_of(old.x))]), skew(down_of(x))
    grown = (np.trace(after.mass[3:, 3:]) / np.trace(before.mass[3:, 3:])) ** 2
    acting = (acts @ old.covariance[TURNING] @ acts.T).diagonal() * grown
    righting = np.diag(after.righting_sigma**2)
    out[21:24, 21:24], out[25:, 25:] = np.diag(acting) + lean @ righting @ lean.T, righting
    out[21:24, 25:] = -lean @ righting
    out[25:, 21:24] = out[21:24, 25:].T
    return out
