"""The trajectory that AUTO tracks: it begins once the set-point has come to its start. Part of `guidance_modes`."""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core.rotations import difference
from firmware_py.core.setpoint import Trajectory, Wish
from firmware_py.core.types import Setpoint


class Tracking:
    """One trajectory, and when it began."""

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self._start_ns: int | None = None
        """None while the body is on its way to the start."""

    @property
    def wish(self) -> Wish:
        """The way to its start, at rest there."""
        start = self._trajectory.sample(0.0)
        return Wish(np.zeros(3), np.zeros(3), start.p_wb, start.q_wb)

    def delay(self, by_ns: int) -> None:
        """Puts off all that is left of it."""
        self._start_ns = None if self._start_ns is None else self._start_ns + by_ns

    def runs(self, time_ns: int, at: Setpoint, join_m: float, join_rad: float) -> bool:
        """Whether it runs; begins it now if the set-point `at` is within `join_m` and `join_rad` of its start."""
        if self._start_ns is None:
            start = self._trajectory.sample(0.0)
            gap, turn = np.linalg.norm(start.p_wb - at.p_wb), np.linalg.norm(difference(start.q_wb, at.q_wb))
            if gap <= join_m and turn <= join_rad:
                self._start_ns = time_ns
        return self._start_ns is not None

    def sample(self, time_ns: int, lead_s: float) -> tuple[Setpoint, Setpoint] | None:
        """Returns the set-points now and `lead_s` later, once it runs; None where one of them is not finite."""
        assert self._start_ns is not None
        t = (time_ns - self._start_ns) * 1e-9
        now, ahead = self._trajectory.sample(t), self._trajectory.sample(t + lead_s)
        motion = np.concatenate((*now, *ahead))
        return (now, ahead) if math.isfinite(motion.dot(motion)) else None
