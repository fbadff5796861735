"""What a body can do with the thrusters that are usable: the axes that are lost, and the wrenches that can still be made."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body, deceleration_of, rank_by, rank_of

LEAST_LEVER = 0.1
"""Smallest moment part of a lost axis (a unit vector) that is traded for force: below it, keeping a newton costs more than 10 N m; 1e16
where the moment part is rounding."""


class ThrusterFaults(NamedTuple):
    """Fault state of a body's thrusters."""

    alive: np.ndarray
    """(n,) bool: thrusters that may be used."""
    dead: tuple[int, ...]
    """Indices of thrusters found dead or lying."""
    lost_axes: int
    """Rank lost from the thruster matrix because of unusable thrusters; passive axes do not count."""
    keep: np.ndarray
    """(6, 6) matrix that removes from a wrench its passive axes and what the usable thrusters cannot make."""
    deceleration: np.ndarray
    """(2,) that of the usable thrusters, as Body.deceleration."""


def steered_rank(matrix: np.ndarray, passive: Sequence[int]) -> int:
    """Returns the rank of a (6, n) thruster matrix without its passive axes."""
    return rank_of(np.delete(matrix, passive, axis=0))


def thruster_state(body: Body, usable: np.ndarray, rank_of_all: int) -> ThrusterFaults:
    """Returns the fault state of a body whose `usable` thrusters, (n,) bool, may be used. rank_of_all: `steered_rank` of all thrusters."""
    alive, matrix, passive = usable.copy(), body.thrusters.matrix, list(body.passive)
    u, values, _ = np.linalg.svd(matrix * alive, full_matrices=alive.size < 6)  # u is (6, 6) even with fewer thrusters
    rank = rank_by(values)
    dead = tuple(int(i) for i in np.flatnonzero(~alive))
    keep = _keep(u[:, :rank], u[:, rank:])
    keep[:, passive] = 0.0
    lost_axes = rank_of_all - steered_rank(matrix * alive, passive)
    return ThrusterFaults(alive, dead, lost_axes, keep, deceleration_of(body.thrusters, body.mass, passive, alive))


def _keep(made: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Returns the (6, 6) matrix that makes a wrench feasible: it gives up moment first, so that the force stays, and force only then.

    Args:
        made, lost: (6, r) and (6, 6 - r) orthonormal bases of the wrenches that can be made, and of the rest.
    """
    if not lost.size:
        return np.eye(6)  # exact
    turned, levers, axes = np.linalg.svd(lost[3:], full_matrices=False)
    long = levers > LEAST_LEVER
    give_up = np.eye(6)
    give_up[3:] -= turned[:, long] / levers[long] @ axes[long] @ lost.T
    return np.asarray(made @ made.T @ give_up)
