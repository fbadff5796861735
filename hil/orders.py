"""Whoever gives the orders of a run, by requests alone, and when somebody at the bench tries to arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from firmware_py.core.types import Outputs, Request
from firmware_py.description.fleet import Fleet
from hil.scenario_rules import ARM_FROM_S

ARM_EVERY_S = 0.5
"""Then again so often until it is granted."""


class Orders(Protocol):
    """The orders of one run."""

    ticks: int
    """How long the run takes at the most; `is_over` may end it before."""

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        """What is asked for in the tick at `time_ns` since the start, given the outputs of the tick before."""
        ...

    def is_over(self, time_ns: int) -> bool:
        """Whether the run may end before its time; it does not where nothing else is said."""
        return False


def is_time_to_arm(time_ns: int, fleet: Fleet) -> bool:
    """Whether to arm is asked for in the tick at `time_ns`."""
    return time_ns >= ARM_FROM_S * 1e9 and is_due(time_ns, fleet, ARM_EVERY_S)


def is_due(time_ns: int, fleet: Fleet, every_s: float) -> bool:
    """Whether what comes every so often, no oftener than the slowest fleet's ticks (20 ms), comes in the tick at `time_ns`."""
    return time_ns // fleet.period_ns % round(every_s * fleet.rate_hz) == 0
