"""How the estimator begins without a tag: upright by gravity, heading and place unknown, until the first tags give those.

What inertial navigation calls coarse alignment (Groves 2013, Principles of GNSS, Inertial and Multisensor Navigation, 5.6): at rest the
accelerometer shows which way is down. By that alone a robot is stabilised, holds its depth and surfaces.
"""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core.measurements import FLIP_RAD
from firmware_py.core.observation import GRAVITY
from firmware_py.core.rotations import conjugate, from_euler, multiply, rotate
from firmware_py.core.types import BodyPose

AT_REST_M_S2 = 0.05 * GRAVITY
"""Mean specific force and gravity differ by less in size where nothing pushes up or down. What pushes across tilts the beginning, by ten
degrees for 1.7 m/s^2; the filter, whose model knows the thrusters, rights it within seconds."""
AT_REST_RAD_S = 0.5
"""Half of the time over which the mean is taken, 0.1 s, then turns a body by three degrees."""
SAME_RAD, SAME_M, SAME_M_S, SAME_S = 0.1, 0.1, 1.0, 1.0
"""Tags that differ by less in heading, place, rad and m, and time, s, tell the same; a body that is said to stand still may move so
fast, m/s. Ten times a tag's noise in attitude; a flipped one is off by twice the angle at which it is seen."""


def upright(gyros: np.ndarray, accels: np.ndarray) -> np.ndarray | None:
    """Attitude (4,) with heading 0 by the mean of (k, 3) specific forces, m/s^2; None where gravity cannot be told from the rest.

    Half of them must have come (NaN: did not), and by those and the (k, 3) angular rates, rad/s, the body must be about at rest.
    """
    felt, turned = accels[~np.isnan(accels[:, 0])], gyros[~np.isnan(gyros[:, 0])]
    if min(len(felt), len(turned)) < max(1, len(accels) // 2):
        return None
    x, y, z = (-felt.mean(axis=0)).tolist()
    force = math.sqrt(x * x + y * y + z * z)
    if not abs(force - GRAVITY) <= AT_REST_M_S2 or not np.linalg.norm(turned.mean(axis=0)) <= AT_REST_RAD_S:
        return None
    return from_euler(math.atan2(y, z), math.asin(max(-1.0, min(1.0, -x / force))), 0.0)


class FirstSight:
    """Tags before the place is known: counts those that agree with gravity and with the one before."""

    def __init__(self) -> None:
        self.count = 0
        self._heading, self._offset, self._capture_ns = math.nan, np.full(3, math.nan), 0

    def agrees(self, pose: BodyPose, p_wb: np.ndarray, q_wb: np.ndarray) -> bool:
        """Whether `pose` has the same way down as q_wb (4,), or else is flipped or not where the vehicle file says; notes where it would
        move the body that is believed at p_wb (3,), m.
        """
        w, x, y, z = multiply(pose.q_wb, conjugate(q_wb)).tolist()
        if 2.0 * math.asin(min(1.0, math.hypot(x, y))) > FLIP_RAD:
            return False
        heading, offset = 2.0 * math.atan2(z, w), pose.p_wt - rotate(pose.q_wb, pose.lever_b) - p_wb
        turned = abs(math.remainder(heading - self._heading, 2.0 * math.pi))  # NaN at first, which is the same as nothing
        gap_s = (pose.capture_ns - self._capture_ns) * 1e-9
        near = float(np.linalg.norm(offset - self._offset)) <= SAME_M + SAME_M_S * gap_s
        same = turned <= SAME_RAD and near and gap_s <= SAME_S
        self.count = self.count + 1 if same else 1
        self._heading, self._offset, self._capture_ns = heading, offset, pose.capture_ns
        return True
