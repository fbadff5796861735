"""The operator's script of a docking scenario: arm every body, then run the steps of the scenario one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.core.rotations import heading
from firmware_py.core.setpoint import Trajectory, rest_at
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, DockRequest, Mode, Outputs, Request
from firmware_py.description.fleet import Fleet
from firmware_py.description.vehicle import FACE_NAMES
from firmware_py.prepare import paths
from hil.orders import Orders, heartbeats, is_time_to_arm
from hil.scenario import Scenario
from hil.script import refuse_outside
from hil.task import Step

NOBODY = -1
"""Index in place of a module that a step does not have."""
AFTERWARDS_NS = 3_000_000_000
"""Time that the run continues after the last step: joined modules must stay joined, and parted ones apart."""


class DockScript(Orders):
    """The requests of one run with [[step]]s. Raises DescriptionError for a strip that leaves the tank."""

    def __init__(self, scenario: Scenario, fleet: Fleet) -> None:
        for step in scenario.step:
            if step.do in ("moebius_start", "moebius"):
                refuse_outside(_strip(step, scenario), scenario)
        self._scenario = scenario
        self._fleet = fleet
        self._bodies: dict[int, set[int]] = {}
        self._steps = list(scenario.step)
        self._running: list[_Running] = []
        self._armed: set[int] = set()
        """Modules that have been armed."""
        self._over_ns: int | None = None
        self.ticks = scenario.task.end_ns // fleet.period_ns

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        """The requests in the tick at `time_ns` since the start, given the outputs of the previous tick."""
        if last is None:
            return []
        self._bodies = _bodies_of(last, len(self._fleet.module))
        asked = self._arm(time_ns, last)
        if time_ns < self._scenario.task.begin_ns:
            return asked
        if any([self._is_given_up(r, last) for r in self._running]):  # the later steps no longer make sense, except for waiting
            self._running, self._steps = [], [step for step in self._steps if step.do == "wait"]
        self._running = [r for r in self._running if not self._is_over(r, time_ns)]
        while self._steps and (not self._running or self._steps[0].also):
            asked += self._begin(self._steps.pop(0), time_ns, last)
        if not self._running and not self._steps and self._over_ns is None:
            self._over_ns = time_ns
        return asked + heartbeats(time_ns, self._fleet, self._scenario.task)

    def is_over(self, time_ns: int) -> bool:
        """Whether every step has been over for AFTERWARDS_NS."""
        return self._over_ns is not None and time_ns >= self._over_ns + AFTERWARDS_NS

    def _arm(self, time_ns: int, last: Outputs) -> list[Request]:
        """Arms every body once; each then hovers level where it is, whatever its attitude before arming."""
        asked: list[Request] = []
        for record in last.records:
            if record.body not in self._armed:
                if record.state == State.ARMED:
                    self._armed |= self._bodies[record.body]
                    here = rest_at(record.estimate.p_wb, heading(record.estimate.q_wb))
                    asked.append(Request(Action.HOLD, record.body, here))
                elif is_time_to_arm(time_ns, self._fleet):
                    asked.append(Request(Action.ARM, record.body))
        return asked

    def _begin(self, step: Step, time_ns: int, last: Outputs) -> list[Request]:
        module, target = [*(self._scenario.index_of(number) for number in step.modules), NOBODY, NOBODY][:2]
        running = _Running(step, time_ns + round(step.duration_s * 1e9), module, target)
        self._running.append(running)
        if step.do == "wait":
            return []
        body = self._number(module)
        if step.do in ("dock", "undock"):
            wanted = DockRequest(
                module, FACE_NAMES.index(step.face), target, FACE_NAMES.index(step.target_face),
                step.quarter_turns, step.both_approach,
            )  # fmt: skip
            return [Request(Action.DOCK if step.do == "dock" else Action.UNDOCK, body, wanted)]
        record = next(r for r in last.records if r.body == body)
        return [Request(Action.TRACK, body, _path(step, self._scenario, record.setpoint.p_wb, record.setpoint.q_wb))]

    def _is_given_up(self, running: _Running, last: Outputs) -> bool:
        """Whether a dock that was under way has ended with its bodies still apart. A refused dock was never under way."""
        if running.step.do != "dock":
            return False
        docking = [r.mode == Mode.DOCK for r in last.records if r.body == self._number(running.module)]
        was_docking, running.docking = running.docking, any(docking)
        return was_docking and docking == [False]

    def _is_over(self, running: _Running, time_ns: int) -> bool:
        if running.step.do in ("dock", "undock"):
            return self._are_one(running) == (running.step.do == "dock")
        return time_ns >= running.end_ns

    def _are_one(self, running: _Running) -> bool:
        """Whether the two modules of a step belong to the same body."""
        return self._number(running.module) == self._number(running.target)

    def _number(self, module: int) -> int:
        """Number of the body that contains a module; NOBODY if none does."""
        return next((number for number, modules in self._bodies.items() if module in modules), NOBODY)


def _bodies_of(last: Outputs, modules: int) -> dict[int, set[int]]:
    """Modules of each body, by its number. In the tick in which bodies join or part, `last.joints` still has the previous joints."""
    body_of = list(range(modules))
    for a, b in [] if last.joints is None else last.joints["module"].tolist():
        body_of = [body_of[a] if body == body_of[b] else body for body in body_of]
    return {record.body: {m for m in range(modules) if body_of[m] == body_of[record.body]} for record in last.records}


@dataclass(slots=True)
class _Running:
    """A step under way."""

    step: Step
    end_ns: int
    module: int
    target: int
    docking: bool = False
    """Whether its body was in mode DOCK in the previous tick."""


def _path(step: Step, scenario: Scenario, p_wb: np.ndarray, q_wb: np.ndarray) -> Trajectory:
    here = rest_at(np.array(p_wb), np.array(q_wb))
    if step.do == "move":
        return paths.line(here, rest_at(np.array(step.position_m), np.array(q_wb)), step.duration_s)
    strip = _strip(step, scenario)
    return paths.line(here, strip.sample(0.0), step.duration_s) if step.do == "moebius_start" else strip


def _strip(step: Step, scenario: Scenario) -> Trajectory:
    task = scenario.task
    return paths.moebius(task.centre_m, step.duration_s, task.radius_m, task.half_width_m, task.turns)
