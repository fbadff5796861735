"""The operator's script of the force test: arm the clamped bodies, then move the stick along a force trajectory."""

from __future__ import annotations

import math
from collections.abc import Sequence

from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Mode, Outputs, Request, Sticks
from firmware_py.description.fleet import Fleet
from hil.orders import Orders, is_due, is_time_to_arm
from hil.scenario import Scenario
from hil.scenario_rules import ARM_FROM_S

STICKS_EVERY_S = 0.02
WAVES = ((0.6, 0.1), (0.4, 0.25))
"""Share and frequency (Hz) of the sines that make up the trajectory."""
MANUAL_BEFORE_S = 2.0
"""Time in manual mode before the trajectory begins."""


def stick_at(t_s: float, amplitude: float) -> float:
    """Position of the stick `t_s` after the start of the trajectory, -1 to 1."""
    return amplitude * sum(share * math.sin(2.0 * math.pi * hertz * t_s) for share, hertz in WAVES)


class ForceScript(Orders):
    """The requests of one run: the same stick position for every body, hence the same share of its capability."""

    def __init__(self, scenario: Scenario, fleet: Fleet) -> None:
        self._fleet, self._task = fleet, scenario.task
        self._leaders = [members[0] for members in scenario.groups]
        self._manual: set[int] = set()
        self.ticks = scenario.task.end_ns // fleet.period_ns

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        """The requests in the tick at `time_ns` since the start, given the outputs of the previous tick."""
        if last is None or time_ns < ARM_FROM_S * 1e9:
            return []
        asked: list[Request] = []
        if is_time_to_arm(time_ns, self._fleet):
            asked += [Request(Action.ARM, r.body) for r in last.records if r.state != State.ARMED]
        manual = time_ns >= self._task.begin_ns - MANUAL_BEFORE_S * 1e9
        if manual and is_due(time_ns, self._fleet, STICKS_EVERY_S):
            moved = 0.0 if time_ns < self._task.begin_ns else stick_at(1e-9 * (time_ns - self._task.begin_ns), self._task.stick)
            sticks = Sticks((moved, 0.0, 0.0))
            for body in self._leaders:
                asked.append(Request(Action.STICKS, body, sticks))
                if body not in self._manual:
                    self._manual.add(body)
                    asked.append(Request(Action.SET_MODE, body, Mode.MANUAL))
        return asked
