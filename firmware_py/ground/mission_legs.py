"""Legs of a flight, and how many of them the body has reached. MissionFlight follows the body along them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from firmware_py.ground.mission_items import ACCEPTANCE_M

GO_TO = -1
"""Sequence number of a leg that belongs to no mission."""
_LATE_S = 5.0
"""Delay, beyond that of the leg before, with which a leg counts as late."""


class Leg(NamedTuple):
    """A place to go to."""

    sequence: int
    p_wb: np.ndarray | None
    """(3,) m; None: the present place."""
    yaw: float | None
    """rad; None: unchanged."""
    hold_s: float
    """Time to stay; above 0 the body stops there."""
    speed_m_s: float
    """NaN, until planned: the speed of missions at that time."""
    acceptance_m: float = ACCEPTANCE_M
    """Distance from the place at which it counts as reached."""


@dataclass(slots=True)
class Flight:
    """A flight under way, or waiting for its plan."""

    legs: tuple[Leg, ...]
    plan_inputs: tuple[Any, ...]
    """All inputs of the plan, except the start pose."""
    begun_tick: int
    """Tick of the request of the hold in which the body waits for the plan."""
    serial: int = 0
    """Serial number of the job of its plan; 0 until that is asked for."""
    arrivals_s: tuple[float, ...] = ()
    task_changes: int = 0
    """System.task_changes when the flight was requested; while it is tracked, as of the last tick."""
    changed_tick: int = 0
    """Tick in which task_changes was seen to change while the flight is tracked."""
    members: tuple[int, ...] = ()
    """Fleet indices of the body's modules when the flight was requested: it is planned for these."""
    hold_reached: bool = False
    """Whether that hold has been in force."""
    started_ns: int | None = None
    reached: int = 0
    """Number of legs that are reached."""
    reached_s: float = 0.0
    """Time from the start at which the last of them was reached."""
    late_s: float = 0.0
    """Delay with which it was reached; infinite once the next leg counts as late."""
    replaced: bool = False
    """Whether the flight belongs to the previous mission; then nothing of the present one is flown."""

    @property
    def of_mission(self) -> bool:
        """Whether the flight belongs to a mission, rather than going to a single place."""
        return self.legs[0].sequence != GO_TO

    @property
    def is_late(self) -> bool:
        """Whether the next leg counts as late."""
        return math.isinf(self.late_s)

    def left(self, t_s: float) -> tuple[Leg, ...]:
        """Returns the legs left to fly at `t_s` from the start, at least the last: with the one where the body holds, those not reached."""
        last = self.reached - 1
        holds = last >= 0 and t_s < self.arrivals_s[last] + self.legs[last].hold_s
        return self.legs[last if holds else self.reached :] or self.legs[-1:]

    def reach(self, t_s: float) -> None:
        """Counts the next leg as reached at `t_s` from the start."""
        self.reached_s, self.late_s = t_s, t_s - self.arrivals_s[self.reached]
        self.reached += 1

    def becomes_late(self, t_s: float) -> bool:
        """Whether the next leg, not reached at `t_s` from the start, counts as late from now on: true once for each leg."""
        is_late = t_s - self.arrivals_s[self.reached] > self.late_s + _LATE_S
        if is_late:
            self.late_s = math.inf
        return is_late
