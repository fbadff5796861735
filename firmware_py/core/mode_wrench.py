"""The wrench of a mode: which parts of it the controller commands and which the sticks, blended over when the mode changes."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from firmware_py.core.rotations import heading, rotate, rotate_back
from firmware_py.core.types import Mode


class Keep(IntEnum):
    """Part of the controller's force or moment that is used; the rest comes from the sticks."""

    NOTHING = 0
    VERTICAL = 1
    """The vertical force."""
    ALL = 2


class Controlled(NamedTuple):
    """Parts of force and moment that the controller commands in a mode; sticks command the rest."""

    force: Keep
    moment: Keep


CONTROLLED = {
    Mode.MANUAL: Controlled(Keep.NOTHING, Keep.NOTHING),
    Mode.STABILIZE: Controlled(Keep.NOTHING, Keep.ALL),
    Mode.ALT_HOLD: Controlled(Keep.VERTICAL, Keep.ALL),
    Mode.POSHOLD: Controlled(Keep.ALL, Keep.ALL),
    Mode.AUTO: Controlled(Keep.ALL, Keep.ALL),
    Mode.GUIDED: Controlled(Keep.ALL, Keep.ALL),
    Mode.DOCK: Controlled(Keep.ALL, Keep.ALL),
    Mode.SURFACE: Controlled(Keep.ALL, Keep.ALL),
    Mode.MOTOR_DETECT: Controlled(Keep.NOTHING, Keep.NOTHING),
}


def mode_wrench(mode: Mode, wrench: np.ndarray, of_sticks: np.ndarray, q_wb: np.ndarray) -> np.ndarray:
    """Returns the wrench (6,) of a mode, body frame: what the controller commands in it (CONTROLLED), and the sticks for the rest.

    Args:
        wrench, of_sticks: (6,) wrenches of the controller and of the sticks, body frame.
        q_wb: (4,) attitude.
    """
    force, moment = CONTROLLED[mode]
    out = wrench.copy()
    if moment == Keep.NOTHING:
        out[3:] = of_sticks[3:]
    if force == Keep.NOTHING:
        out[:3] = of_sticks[:3]
    elif force == Keep.VERTICAL:
        level_w = np.asarray(rotate(heading(q_wb), np.r_[of_sticks[:2], 0.0]))
        out[:3] = rotate_back(q_wb, np.r_[level_w[:2], rotate(q_wb, wrench[:3].copy())[2]])
    return np.asarray(out)


class Blend:
    """Changes from one wrench to another without a jump: the difference fades out within `blend_s`."""

    def __init__(self) -> None:
        self.blend_s = 0.0
        self._wrench = np.zeros(6)
        """Wrench of the last tick, (6,), body frame."""
        self._begins = False
        """Whether a new blend begins at `_wrench` in the next tick."""
        self._offset, self._offset_ns = np.zeros(6), 0
        """Wrench before the change less that after it, (6,), and the time of the change: it fades out from then on."""

    def begin(self, wrench: np.ndarray | None = None) -> None:
        """Blends over from `wrench` (6,), by default that of the last tick, to the wrenches that follow."""
        self._begins = True
        if wrench is not None:
            self._wrench = wrench

    def over(self, wrench: np.ndarray, time_ns: int) -> np.ndarray:
        """Returns the wrench (6,) of this tick, which is to be `wrench` once the blend is over."""
        if self._begins:
            self._offset, self._offset_ns, self._begins = self._wrench - wrench, time_ns, False
        left = 1.0 - (time_ns - self._offset_ns) * 1e-9 / max(self.blend_s, 1e-9)
        if left > 0.0:
            wrench = wrench + left * self._offset
        self._wrench = wrench
        return np.asarray(wrench)
