"""Legs of a flight, made from mission items, and how many of them the body has reached. MissionFlight follows the body along them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np

from firmware_py.ground.geodesy import Origin
from firmware_py.ground.identity import Identity
from firmware_py.ground.mission_items import ACCEPTANCE_M, LOITER_UNLIMITED, Item, flight_order

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


def legs_from(items: Sequence[Item], first: int, origin: Origin, identity: Identity) -> tuple[Leg, ...]:
    """Returns the legs of a mission from item `first` on. Raises MissionError."""
    turns, speed = identity.waypoints_turn, math.nan
    legs: list[Leg] = []
    speeds = [item for item in items[:first] if item.speed_m_s is not None]  # speeds set by passed items stay in force
    for item in (*speeds, *flight_order(items, first)):
        if item.sequence < identity.first_item:
            continue  # home, the target of a jump
        if item.speed_m_s is not None:
            speed = item.speed_m_s if item.speed_m_s > 0 else math.nan
        place = item.place(origin)
        if place is not None:
            legs.append(Leg(item.sequence, place, item.yaw if turns else None, item.hold_s, speed, item.acceptance_m))
        elif item.delay_s > 0:
            last = legs.pop() if legs else Leg(item.sequence, None, None, 0.0, speed)
            legs.append(last._replace(hold_s=last.hold_s + item.delay_s))
        if item.command == LOITER_UNLIMITED:
            break
    return tuple(legs)


def at_another_speed(legs: Sequence[Leg]) -> tuple[Leg, ...]:
    """Returns the legs with the speed that was set last, up to the next change of speed among them."""
    alike = list(takewhile(lambda leg: np.array_equal(leg.speed_m_s, legs[0].speed_m_s, equal_nan=True), legs))
    return (*(leg._replace(speed_m_s=math.nan) for leg in alike), *legs[len(alike) :])
