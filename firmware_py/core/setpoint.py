"""Stage 4 of a tick: where the body should be now, and a thruster lag ahead."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from firmware_py.core.types import Estimate, Setpoint


class Trajectory(Protocol):
    """A motion over time. Built by `prepare.paths`; sampled in the tick."""

    duration_s: float

    def sample(self, t_s: float) -> Setpoint:
        """The set-point at `t_s`; before 0 and after `duration_s` it rests at the ends."""
        ...


def rest_at(p_wb: np.ndarray, q_wb: np.ndarray) -> Setpoint:
    """Standing still."""
    zero = np.zeros(3)
    return Setpoint(np.ascontiguousarray(p_wb), np.ascontiguousarray(q_wb), zero, zero, zero, zero)


class Guidance:
    """Keeps the motion that was asked for and samples it."""

    def __init__(self, lead_s: float) -> None:
        self._lead_s = lead_s
        self._trajectory: Trajectory | None = None
        self._start_ns = 0
        self._hold = rest_at(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def hold(self, setpoint: Setpoint) -> None:
        """Stand still at `setpoint` from now on."""
        self._trajectory = None
        self._hold = setpoint

    def hold_here(self, estimate: Estimate) -> None:
        """Stand still where the body is believed to be."""
        self.hold(rest_at(estimate.p_wb, estimate.q_wb))

    def follow(self, trajectory: Trajectory, start_ns: int) -> None:
        """Follow `trajectory` from `start_ns` on."""
        self._trajectory = trajectory
        self._start_ns = start_ns

    def step(self, time_ns: int) -> tuple[Setpoint, Setpoint]:
        """The set-point at `time_ns`, and the one that the thrusters' force will meet."""
        if self._trajectory is None:
            return self._hold, self._hold
        t = (time_ns - self._start_ns) * 1e-9
        return self._trajectory.sample(t), self._trajectory.sample(t + self._lead_s)

    def finished(self, time_ns: int) -> bool:
        """Whether nothing moves any more."""
        return self._trajectory is None or (time_ns - self._start_ns) * 1e-9 >= self._trajectory.duration_s
