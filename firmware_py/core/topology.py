"""How joining and parting of bodies transforms estimator state and covariance. No Body is built here.

The new Body comes prepared (prepare.docking). Velocities of a joined body follow from conservation of momentum.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.propagation import ERRORS, STATES, Error, Nominal
from firmware_py.core.rotations import conjugate, cross, multiply, normalise, rotate, rotate_back, skew, to_matrix

JOINED_SIGMA = (0.003, 0.01, 0.01, 0.03)
"""Added to a joined body's sigma: position m, attitude rad, velocity m/s, rate rad/s. Covers the play of the faces, and the shock."""
PARTED_SIGMA = (0.07, 0.05, 0.07, 0.1)
"""The same for a parted body: magnets push the pieces apart before they are flown as two. On the bench each has by then moved 35 mm and
0.02 rad, at 80 mm/s and 0.1 rad/s (dock-undock-dock, seed 1), and twice as far where the push takes all of its second (`release_s`)."""
DEPTH_BIAS_SPREAD_M = 0.02
BIAS_SPREAD = np.repeat([0.005, 0.05, DEPTH_BIAS_SPREAD_M], [3, 3, 1])
"""(7,) sigma of the biases of gyro, rad/s, accelerometer, m/s^2, and depth, m, between modules (synthetic, as the bench draws
them). A body estimates their mean."""
BIASES = np.r_[Error.GYRO_BIAS, Error.ACCEL_BIAS, Error.DEPTH_BIAS]
"""Indices of these biases in the error state."""
LEVEL = np.array([1.0, 1.0, 0.0])
"""Mask of the horizontal part of a force in the world."""
TURNING = np.ix_(np.r_[Error.MOMENT, Error.RIGHTING], np.r_[Error.MOMENT, Error.RIGHTING])
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
    return np.asarray(to_matrix(x[Nominal.ATTITUDE].copy())[2])


def in_both(mine: Sequence[int], theirs: Sequence[int]) -> list[tuple[int, int]]:
    """Index pairs (in `mine`, in `theirs`) of the modules that are in both bodies."""
    return [(i, theirs.index(module)) for i, module in enumerate(mine) if module in theirs]


def join(parts: Sequence[tuple[Body, Motion]], body: Body) -> Motion:
    """State of `body`, made of the bodies `parts`; its first module is one of the first part."""
    x = np.zeros(STATES)
    first, motion = parts[0]
    x[Nominal.ATTITUDE] = attitude_of(body, first, motion.x[Nominal.ATTITUDE].copy())
    x[Nominal.POSITION] = _position(first, motion.x, body, x[Nominal.ATTITUDE])
    momentum, force, moment, off = np.zeros(6), np.zeros(3), np.zeros(3), np.zeros(3)
    for part, moved in parts:
        lever_b, turn = _place(part, body)
        h = _transport(lever_b, turn)
        momentum += h.T @ part.mass @ moved.x[Nominal.NU]
        force += moved.x[Nominal.FORCE]
        level_b = rotate_back(x[Nominal.ATTITUDE].copy(), moved.x[Nominal.FORCE] * LEVEL)
        moment += turn.T @ moved.x[Nominal.MOMENT] + cross(lever_b, level_b)
        off += turn.T @ moved.x[Nominal.RIGHTING] - lever_b * moved.x[Nominal.VERTICAL_FORCE]  # which has a righting moment at a lever
    x[Nominal.NU] = body.mass_inv @ momentum
    x[Nominal.FORCE], x[Nominal.MOMENT], x[Nominal.RIGHTING] = force, moment, off
    modules = [len(part.modules) for part, _ in parts]
    biases = np.average([_biases(part, moved.x, body) for part, moved in parts], axis=0, weights=modules)
    x[Nominal.GYRO_BIAS], x[Nominal.ACCEL_BIAS] = biases[:3], biases[3:]
    x[Nominal.DEPTH_BIAS] = np.average([moved.x[Nominal.DEPTH_BIAS] for _, moved in parts], weights=modules)
    x[Nominal.DOWN] = down_of(x)
    accepted, tag_ns = min(moved.accepted for _, moved in parts), min(moved.tag_ns for _, moved in parts)
    return Motion(x, _covariance(motion, first, x, body, JOINED_SIGMA), accepted, tag_ns)


def part_of(whole: Body, motion: Motion, body: Body) -> Motion:
    """State of `body`, which was a piece of `whole`. The disturbance is shared out by mass, righting by its variance: a part of it was the
    lever of the pieces' lifts, which no piece has alone. Shared out by mass, it grew with every dock.
    """
    x = motion.x.copy()
    x[Nominal.ATTITUDE] = attitude_of(body, whole, motion.x[Nominal.ATTITUDE].copy())
    x[Nominal.POSITION] = _position(whole, motion.x, body, x[Nominal.ATTITUDE])
    lever_b, turn = _place(body, whole)
    x[Nominal.NU] = _transport(lever_b, turn) @ motion.x[Nominal.NU]
    share = body.rigid_mass_kg / whole.rigid_mass_kg
    x[Nominal.FORCE] = motion.x[Nominal.FORCE] * share
    x[Nominal.MOMENT] = turn @ motion.x[Nominal.MOMENT] * share
    x[Nominal.RIGHTING] = turn @ motion.x[Nominal.RIGHTING] * body.righting_sigma**2 / (np.square(turn) @ whole.righting_sigma**2)
    biases = _biases(whole, motion.x, body)
    x[Nominal.GYRO_BIAS], x[Nominal.ACCEL_BIAS] = biases[:3], biases[3:]
    x[Nominal.DOWN] = down_of(x)
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


def attitude_of(new: Body, old: Body, q_wb: np.ndarray) -> np.ndarray:
    """(4,) attitude of `new` where that of `old` is `q_wb` (4,), by a module that both contain."""
    i, j = in_both(old.modules, new.modules)[0]
    turn = multiply(np.ascontiguousarray(old.q_bm[i]), conjugate(np.ascontiguousarray(new.q_bm[j])))
    return np.asarray(normalise(multiply(q_wb, turn)))


def _position(old: Body, x: np.ndarray, new: Body, q_new: np.ndarray) -> np.ndarray:
    """(3,) position of `new`, which has the attitude q_new (4,), from the state of `old`, by a module that both contain."""
    i, j = in_both(old.modules, new.modules)[0]
    p_wm = x[Nominal.POSITION] + rotate(x[Nominal.ATTITUDE].copy(), np.ascontiguousarray(old.r_bm[i]))
    return np.asarray(p_wm - rotate(q_new, np.ascontiguousarray(new.r_bm[j])))


def _biases(old: Body, x: np.ndarray, new: Body) -> np.ndarray:
    """(6,) gyro and accelerometer bias in the axes of `new`."""
    _, turn = _place(new, old)
    return np.concatenate([turn @ x[Nominal.GYRO_BIAS], turn @ x[Nominal.ACCEL_BIAS]])


def _covariance(old: Motion, before: Body, x: np.ndarray, after: Body, shock: Sequence[float]) -> np.ndarray:
    """(28, 28) covariance of the new body in state x: variances of the old one about the new axes, increased by the shock; that of the
    disturbance force is scaled by mass.

    All correlations but one are dropped. How the acting moment divides into disturbance and righting is unknown for the new body, and
    righting starts with its initial sigma; but their sum, the acting moment, is known as well as before, scaled by inertia.

    Args:
        shock: sigma to add to position m, attitude rad, velocity m/s, rate rad/s.
    """
    variance = old.covariance.diagonal().copy()
    turn = to_matrix(x[Nominal.ATTITUDE].copy()).T @ to_matrix(old.x[Nominal.ATTITUDE].copy())
    in_the_body = slice(3, 18)  # attitude, velocity, rate, both biases
    variance[in_the_body] = (variance[in_the_body].reshape(5, 3) @ np.square(turn).T).ravel()
    variance[Error.FORCE] *= (after.rigid_mass_kg / before.rigid_mass_kg) ** 2
    variance[:12] += np.repeat(np.array(shock), 3) ** 2
    out = np.diag(variance)
    assert len(out) == ERRORS
    acts, lean = turn @ np.hstack([np.eye(3), skew(down_of(old.x))]), skew(down_of(x))
    grown = (np.trace(after.mass[3:, 3:]) / np.trace(before.mass[3:, 3:])) ** 2
    acting = (acts @ old.covariance[TURNING] @ acts.T).diagonal() * grown
    righting = np.diag(after.righting_sigma**2)
    out[Error.MOMENT, Error.MOMENT], out[Error.RIGHTING, Error.RIGHTING] = np.diag(acting) + lean @ righting @ lean.T, righting
    out[Error.MOMENT, Error.RIGHTING] = -lean @ righting
    out[Error.RIGHTING, Error.MOMENT] = out[Error.MOMENT, Error.RIGHTING].T
    return out
