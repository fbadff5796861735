"""Start of the estimator without a tag: levelled by gravity, with heading and position unknown until the first tags give them.

This is the coarse alignment of inertial navigation (Groves 2013, Principles of GNSS, Inertial and Multisensor Navigation, 5.6): at rest
the accelerometer shows which way is down. That alone is enough to stabilise a robot, hold its depth and surface.
"""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core.measurements import FLIP_RAD
from firmware_py.core.rotations import conjugate, from_euler, multiply, rotate
from firmware_py.core.types import BodyPose
from firmware_py.description.water import GRAVITY

AT_REST_M_S2 = 0.05 * GRAVITY
"""Largest difference in magnitude between mean specific force and gravity for a body at rest: nothing pushes it up or down. A sideways
acceleration passes this check and tilts the initial attitude, by ten degrees for 1.7 m/s^2; the filter, whose model includes the
thrusters, corrects that within seconds."""
AT_REST_RAD_S = 0.5
"""Largest mean angular rate for a body at rest: in half of the averaging window, 0.1 s, it turns the body by three degrees."""
ENOUGH = 10
"""Samples that tell gravity, however few of the ticks they are: an IMU may be slower than the tick. In their mean a noise of 0.03 m/s^2 a
sample, that of the bench, tilts gravity by 0.06 deg."""
AGREE_RAD, AGREE_M, AGREE_M_S, AGREE_S = 0.1, 0.1, 1.0, 1.0
"""Two tag poses agree if they differ by no more than this in heading (rad), position (m) and time (s). The position limit grows by
AGREE_M_S (m/s) with the time between them, because a body that is assumed to stand still may move that fast. The heading limit is ten times
a tag's attitude noise; a flipped tag is off by twice the angle at which it is seen."""


def upright(gyros: np.ndarray, accels: np.ndarray) -> np.ndarray | None:
    """Returns the attitude (4,), heading 0, from the mean of (k, 3) specific forces, m/s^2; None where gravity cannot be isolated.

    At least half of the samples of both kinds, or `ENOUGH`, must be present (NaN marks a missing one), and by the specific forces and the
    (k, 3) angular rates, rad/s, the body must be about at rest.
    """
    felt, turned = accels[~np.isnan(accels[:, 0])], gyros[~np.isnan(gyros[:, 0])]
    if min(len(felt), len(turned)) < max(1, min(ENOUGH, len(accels) // 2)):
        return None
    x, y, z = (-felt.mean(axis=0)).tolist()
    force = math.sqrt(x * x + y * y + z * z)
    if not abs(force - GRAVITY) <= AT_REST_M_S2 or not np.linalg.norm(turned.mean(axis=0)) <= AT_REST_RAD_S:
        return None
    return from_euler(math.atan2(y, z), math.asin(max(-1.0, min(1.0, -x / force))), 0.0)


def tilt_between(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the angle, rad, between the tilts of two attitudes (4,), whatever their headings."""
    _, x, y, _ = multiply(a, conjugate(b)).tolist()
    return 2.0 * math.asin(min(1.0, math.hypot(x, y)))


class TagAgreement:
    """Screens tag poses before the position is known: counts the run of those that agree with gravity and with the one before."""

    def __init__(self) -> None:
        self.count = 0
        self._heading, self._offset, self._capture_ns = math.nan, np.full(3, math.nan), 0

    def agrees(self, pose: BodyPose, p_wb: np.ndarray, q_wb: np.ndarray) -> bool:
        """Whether `pose` agrees with q_wb (4,) on which way is down; if not, the tag is flipped or not mounted where the vehicle file says.

        For a pose that agrees, updates `count`: compares the heading and position change that it implies for the body at p_wb (3,), m, with
        those of the pose before.
        """
        if tilt_between(pose.q_wb, q_wb) > FLIP_RAD:
            return False
        w, _, _, z = multiply(pose.q_wb, conjugate(q_wb)).tolist()
        heading, offset = 2.0 * math.atan2(z, w), pose.p_wt - rotate(pose.q_wb, pose.lever_b) - p_wb
        turned = abs(math.remainder(heading - self._heading, 2.0 * math.pi))  # NaN at first, which agrees with nothing
        gap_s = (pose.capture_ns - self._capture_ns) * 1e-9
        near = float(np.linalg.norm(offset - self._offset)) <= AGREE_M + AGREE_M_S * gap_s
        same = turned <= AGREE_RAD and near and gap_s <= AGREE_S
        self.count = self.count + 1 if same else 1
        self._heading, self._offset, self._capture_ns = heading, offset, pose.capture_ns
        return True
