"""Interface of the scripts that give the orders of a run, by requests alone, and the times at which they try to arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from firmware_py.core.types import Action, Outputs, Request
from firmware_py.description.fleet import Fleet
from hil.scenario_rules import ARM_FROM_S

if TYPE_CHECKING:
    from hil.task import Task

ARM_EVERY_S = 0.5
"""Period of further attempts to arm, until one is granted."""
STREAM_EVERY_S = 0.1
"""Period of sticks, set-points and the ground station's heartbeat."""


class Orders(Protocol):
    """The orders of one run."""

    ticks: int
    """Maximum length of the run; `is_over` may end it earlier."""

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        """The requests in the tick at `time_ns` since the start, given the outputs of the previous tick."""
        ...

    def is_over(self, time_ns: int) -> bool:
        """Whether the run may end before its last tick; never by default."""
        return False


def is_time_to_arm(time_ns: int, fleet: Fleet) -> bool:
    """Whether an attempt to arm is due in the tick at `time_ns`."""
    return time_ns >= ARM_FROM_S * 1e9 and is_due(time_ns, fleet, ARM_EVERY_S)


def is_due(time_ns: int, fleet: Fleet, every_s: float) -> bool:
    """Whether an action with period `every_s` (at least 20 ms, the tick of the slowest fleet) is due in the tick at `time_ns`."""
    return time_ns // fleet.period_ns % round(every_s * fleet.rate_hz) == 0


def heartbeats(time_ns: int, fleet: Fleet, task: Task) -> list[Request]:
    """The ground station's heartbeat, if one is due in the tick at `time_ns` and the station is still heard."""
    return [Request(Action.GROUND_ALIVE)] if time_ns < task.ground_until_s * 1e9 and is_due(time_ns, fleet, STREAM_EVERY_S) else []
