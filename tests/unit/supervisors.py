"""Helpers of the supervisor tests: a supervisor in a given state, requests to it, and its event texts."""

from dataclasses import replace
from typing import Any

import numpy as np

from firmware_py.core.health import Health
from firmware_py.core.setpoint import rest_at
from firmware_py.core.supervisor import Decision, Supervisor
from firmware_py.core.transitions import TRIGGERS, State, Trigger
from firmware_py.core.types import Action, DockRequest, Mode, Request, Sticks
from firmware_py.description.parameters import Parameters
from tests.unit.healths import GOOD

P = Parameters()
QUICK = replace(
    P,
    failsafes=replace(
        P.failsafes, leak_delay_s=0.0, battery_low_delay_s=0.0, cabin_hot_delay_s=0.0, cabin_hot_action=5, module_silent_delay_s=0.0
    ),
)
HERE = rest_at(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0, 0.0]))
STICKS = Sticks((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
DOCK = DockRequest(0, 0, 1, 1)


class Path:
    duration_s = 2.0

    def sample(self, t_s: float) -> Any:
        return HERE


PATH = Path()
ARGUMENTS: dict[Action, Any] = {
    Action.SET_MODE: Mode.AUTO, Action.STICKS: STICKS, Action.SET_POINT: HERE, Action.TRACK: PATH, Action.DOCK: DOCK,
    Action.UNDOCK: DOCK, Action.MOTOR_TEST: (0, 0.1, 1.0),
}  # fmt: skip
REQUESTS = {trigger: Request(action, 0, ARGUMENTS.get(action)) for action, trigger in TRIGGERS.items()} | {
    Trigger.FORCED_ARM: Request(Action.ARM, 0, True)
}
"""A request for each trigger that a request causes."""


def supervisor_in(state: State = State.ARMED, mode: Mode = Mode.POSHOLD, parameters: Parameters = P) -> Supervisor:
    supervisor = Supervisor(parameters)
    supervisor.state, supervisor.mode = state, mode
    return supervisor


def ask(supervisor: Supervisor, action: Action, argument: Any = None, health: Health = GOOD) -> list[Decision]:
    return supervisor.step(False, health, [Request(action, 0, argument)])


def texts(supervisor: Supervisor) -> list[str]:
    return [event.text for event in supervisor.events]
