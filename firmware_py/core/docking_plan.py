"""Prepared docks and undocks: their geometry and the resulting bodies, and where a module is in its body and in the world."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.rotations import multiply, normalise, rotate
from firmware_py.core.types import DockRequest, Estimate


class DockPlan(NamedTuple):
    """A prepared dock: the geometry of the two faces and the resulting body."""

    request: DockRequest
    closes: tuple[DockRequest, ...]
    """Every joint that the dock closes between the two bodies: more than one where it closes a ring."""
    merged: Body
    axis_t: np.ndarray
    """(3,) outward normal of the target's face, target module frame."""
    place_t: np.ndarray
    """(3,) centre of the active module when docked, target module frame, m."""
    q_ta: np.ndarray
    """(4,) active module frame to target module frame when docked."""

    @property
    def pitch_m(self) -> float:
        """Edge of a lattice cell."""
        return float(np.linalg.norm(self.place_t))


class UndockPlan(NamedTuple):
    """A prepared undock: the two resulting bodies."""

    opens: tuple[DockRequest, ...]
    """Every joint between the two, the requested one first; `module` is on the side that leaves."""
    stays: Body
    """The body with the target module."""
    leaves: Body
    axis_b: np.ndarray
    """(3,) unit vector along which it leaves, frame of the whole body."""


def module_in(body: Body, module: int) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) of a module's centre in its body, m, and quaternion (4,) from module frame to body frame."""
    i = body.modules.index(module)
    return np.ascontiguousarray(body.r_bm[i]), np.ascontiguousarray(body.q_bm[i])


def pose_of(estimate: Estimate, r_b: np.ndarray, q_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a module in the world from its body's estimate."""
    return estimate.p_wb + rotate(estimate.q_wb, r_b), normalise(multiply(estimate.q_wb, q_b))
