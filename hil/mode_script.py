"""The operator's script for flying one mode: arm, enter the mode, then keep steering in it with sticks, set-points or a path."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from firmware_py.core.setpoint import rest_at
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Mode, Outputs, Request, Setpoint, Sticks
from firmware_py.description.fleet import Fleet
from firmware_py.prepare import paths
from hil.orders import STREAM_EVERY_S, Orders, heartbeats, is_due, is_time_to_arm
from hil.scenario import Scenario

PILOTED = (Mode.MANUAL, Mode.STABILIZE, Mode.ALT_HOLD)
RADIUS_M, TURN_S = 0.25, 15.0
"""Circle of AUTO and of GUIDED's set-points, and the time for one lap."""


class ModeScript(Orders):
    """The requests of one run. It arms only once: a robot that a fault disarmed stays disarmed."""

    def __init__(self, scenario: Scenario, fleet: Fleet) -> None:
        self._fleet, self._task = fleet, scenario.task
        self._mode = Mode[scenario.task.mode]
        self.ticks = scenario.task.end_ns // fleet.period_ns
        self._armed = self._begun = False

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        """The requests in the tick at `time_ns` since the start, given the outputs of the previous tick."""
        if last is None:
            return []
        self._armed = self._armed or last.records[0].state == State.ARMED
        if not self._armed:
            return [Request(Action.ARM)] if is_time_to_arm(time_ns, self._fleet) else []
        if time_ns < self._task.begin_ns:
            return []
        asked = [] if self._begun else self._begin()
        self._begun = True
        if is_due(time_ns, self._fleet, STREAM_EVERY_S) and time_ns < self._task.pilot_until_s * 1e9:
            asked += self._stream(1e-9 * (time_ns - self._task.begin_ns))
        return asked + heartbeats(time_ns, self._fleet, self._task)

    def _begin(self) -> list[Request]:
        if self._mode == Mode.AUTO:
            turns = self._task.duration_s / TURN_S
            centre = self._task.centre_m - np.array([RADIUS_M, 0.0, 0.0])
            return [Request(Action.TRACK, 0, paths.circle(centre, RADIUS_M, turns, self._task.duration_s))]
        return [Request(Action.SET_MODE, 0, self._mode)]

    def _stream(self, t_s: float) -> list[Request]:
        if self._mode in PILOTED:
            return [Request(Action.STICKS, 0, Sticks())]
        return [Request(Action.SET_POINT, 0, self._point(t_s))] if self._mode == Mode.GUIDED else []

    def _point(self, t_s: float) -> Setpoint:
        """Set-point on a circle through the start, at constant speed."""
        angle, rate = 2.0 * math.pi * t_s / TURN_S, 2.0 * math.pi / TURN_S
        out, along = np.array([math.cos(angle) - 1.0, math.sin(angle), 0.0]), np.array([-math.sin(angle), math.cos(angle), 0.0])
        place = rest_at(self._task.centre_m + RADIUS_M * out, np.array([1.0, 0.0, 0.0, 0.0]))
        return place._replace(v_w=RADIUS_M * rate * along)
