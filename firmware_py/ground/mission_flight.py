"""Missions in the water: from items to legs, a plan asked of whoever can plan, and where on it the body is.

Planning takes a second and happens elsewhere: a PlanJob goes out, a Plan comes back, and the body tracks it. Whoever takes the body for
something else until then ends the flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.setpoint import Trajectory
from firmware_py.core.types import INFORMATION, WARNING, Action, Event, Mode
from firmware_py.description.parameters import Parameters
from firmware_py.ground.mission_items import (
    FASTEST,
    LOITER_UNLIMITED,
    SLOWEST,
    SPEED_DEFAULT,
    SPEED_STAYS,
    Item,
    MissionError,
    beyond_fence,
    flight_order,
)
from firmware_py.ground.system import NS_PER_S, System
from firmware_py.ground.telemetry import ACTIVE, DONE, NO_MISSION, PAUSED, READY, mission_current

_SETTLE_TICKS = 3
"""Ticks from asking for a hold to reading where it is held."""
_HOLD_TICKS = 100
"""Ticks from asking for a hold until it must be there: those that were queued while the loop took the request count too."""
_REACHED_REPEATS, _REACHED_EVERY_NS = 3, 300_000_000
_GO_TO = -1
"""Sequence number of a leg that belongs to no mission."""
_PRESENT = -1
"""DO_SET_MISSION_CURRENT's number of the item that is current."""


class Leg(NamedTuple):
    """A place to go to."""

    sequence: int
    p_wb: np.ndarray | None
    """(3,) m; None: where it is."""
    yaw: float | None
    """rad; None: as before."""
    hold_s: float
    """How long to stay; above 0 it stops there."""
    speed_m_s: float
    """NaN, before it is planned: as missions are flown then."""


class PlanJob(NamedTuple):
    """What is to be planned."""

    body: int
    serial: int
    p_wb: np.ndarray
    q_wb: np.ndarray
    legs: tuple[Leg, ...]
    acceleration: float
    corridor_m: float


class Plan(NamedTuple):
    """A planned flight; `arrivals_s` says when each leg's place is reached."""

    serial: int
    trajectory: Trajectory | None
    arrivals_s: tuple[float, ...]
    reason: str = ""
    """Why there is none."""


@dataclass(slots=True)
class _Flight:
    """Legs under way."""

    legs: tuple[Leg, ...]
    terms: tuple[Any, ...]
    """All that its plan is made of, but where it begins."""
    arrivals_s: tuple[float, ...] = ()
    taken: int = 0
    """System.taken when it began, and while it is followed, as of the last tick."""
    members: tuple[int, ...] = ()
    """Fleet indices of the body's modules then: it is planned for these."""
    holds: bool = False
    """The hold in which it waits for its plan was there."""
    started_ns: int | None = None
    reached: int = 0
    replaced: bool = False
    """It is of the mission before: of the one that is there now nothing is flown."""

    @property
    def of_mission(self) -> bool:
        """Whether it is one of a mission, and no way to a single place."""
        return self.legs[0].sequence != _GO_TO


class MissionFlight:
    """The mission of one body."""

    def __init__(self, system: System, parameters: Callable[[], Parameters]) -> None:
        self._system, self._parameters = system, parameters
        self.items: tuple[Item, ...] = ()
        self.jobs: list[PlanJob] = []
        """To be planned; whoever plans takes them."""
        self._serial = 0
        self._flight: _Flight | None = None
        self._left: tuple[Leg, ...] = ()
        """Of the mission that is paused: jumps that were made are not made again."""
        self._begun_at: int | None = None
        """The item from which it was begun last; None where a jump is to begin it there once more."""
        self._plan_at_tick: int | None = None
        """None once it is asked for."""
        self._hold_by_tick = 0
        self._speed: float | None = None
        self._repeat: list[tuple[int, int]] = []

    # ------------------------------------------------------------ what is asked

    def replace(self, items: tuple[Item, ...]) -> None:
        """A new mission, ready to be started. What flies goes on, of the old one; what is still being planned of it is not flown."""
        if self._flight is not None and self._flight.of_mission and not self._flight.arrivals_s:
            self._end_before_it_began("its mission was replaced")
        self.amend(items)
        p = self._system.subject.progress
        p.total, p.current = max(len(items) - self._first, 0), min(self._first, max(len(items) - 1, 0))
        p.state = READY if items else NO_MISSION
        if self._flight is not None:
            self._flight.replaced = self._flight.of_mission

    def amend(self, items: tuple[Item, ...]) -> None:
        """The same mission with other items in it, while it does not fly: it goes on where it is."""
        self.items, self._left = items, ()

    def against(self, item: Item) -> tuple[int, str]:
        """A MAV_MISSION_RESULT and why `item` is flown nowhere, by the fence as it is now; 0: it is."""
        place = item.place(self._system.subject.origin) if item.sequence >= self._first else None
        return (0, "") if place is None else beyond_fence(place, self._parameters().fence)

    @property
    def awaited(self) -> int:
        """Serial number of the job whose plan is waited for; 0: of none."""
        waits = self._flight is not None and self._plan_at_tick is None and not self._flight.arrivals_s
        return self._serial if waits else 0

    @property
    def flies(self) -> bool:
        """Whether the mission that is there is under way."""
        return self._system.subject.progress.state == ACTIVE

    def start(self, first: int | None) -> str:
        """Fly from item `first`, or go on where it stopped. What flies from there already flies on: its answer may be lost.

        Returns why not, or nothing.
        """
        s = self._system.subject
        self._end_if_taken()
        if not self.items:
            return "there is none"
        if not s.armed:
            return "the vehicle is disarmed"
        if self._flight is not None and self._system.taken != self._flight.taken:
            self._end(PAUSED)  # the next tick would, by what was asked before this: it flies on no more
        wanted = first
        if wanted is None:
            wanted = s.progress.current if s.progress.state == PAUSED else 0
        wanted = max(wanted, self._first)
        if s.progress.state == ACTIVE and (first is None or wanted == self._begun_at):
            return ""
        left = self._left if first is None and s.progress.state == PAUSED else ()
        try:
            legs = left or self._legs(wanted)
        except MissionError as error:
            return str(error)
        if not legs:
            return "nothing is left to fly"
        s.progress.state, s.progress.current, self._begun_at = ACTIVE, legs[0].sequence, wanted
        self._begin(legs)
        return ""

    def jump(self, index: int) -> str:
        """Go on at item `index`, -1: at the present one, and tell which it is. Returns why not, or nothing."""
        s = self._system.subject
        reason = self._jump(s.progress.current if index == _PRESENT else index)
        if not reason:
            self._system.broadcast("MISSION_CURRENT", mission_current(s)[0])
        return reason

    def _jump(self, index: int) -> str:
        if index not in range(len(self.items)):
            return f"item {index} of {len(self.items)} does not exist"
        self._end_if_taken()
        p = self._system.subject.progress
        if self.flies or (self._flight is not None and self._flight.replaced):
            self._begun_at = None
            return self.start(index)
        p.current, p.state, self._left = index, PAUSED, ()
        return ""

    def set_speed(self, speed_m_s: float) -> str:
        """Speed of what is planned from now on; -1: as before, -2: as the parameter says. Returns why not, or nothing."""
        wanted = {SPEED_STAYS: self._speed, SPEED_DEFAULT: None}.get(speed_m_s, speed_m_s)
        if wanted is not None and not SLOWEST <= wanted <= FASTEST:
            return _no_speed(wanted)
        self._speed = wanted
        return ""

    def go_to(self, latitude_deg: float, longitude_deg: float, altitude_m: float, yaw: float, speed_m_s: float) -> str:
        """Fly to one place inside the fence; a speed of 0 or less is that of missions. Returns why not, or nothing."""
        s = self._system.subject
        if not s.armed:
            return "the vehicle is disarmed"
        place = s.origin.local(latitude_deg, longitude_deg, altitude_m)
        result, reason = beyond_fence(place, self._parameters().fence)
        if result:
            return reason
        if speed_m_s > 0 and not SLOWEST <= speed_m_s <= FASTEST:
            return _no_speed(speed_m_s)
        if s.progress.state == ACTIVE:
            self._end(PAUSED)
        turned = yaw if math.isfinite(yaw) else None
        self._begin((Leg(_GO_TO, place, turned, 0.0, speed_m_s if speed_m_s > 0 else math.nan),))
        return ""

    # ------------------------------------------------------------ what happens

    def planned(self, plan: Plan) -> None:
        """A plan came back; nothing is asked of a body that does something else by now."""
        self._end_if_taken()
        if plan.serial != self._serial or self._flight is None:
            return
        if plan.trajectory is None:
            self._system.say(WARNING, f"mission refused: {plan.reason}")
            self._end(PAUSED)
            return
        self._flight.arrivals_s = plan.arrivals_s
        self._system.ask(Action.TRACK, plan.trajectory)

    def hear(self, event: Event) -> None:
        """A refusal ends the flight."""
        if event.text.startswith("TRACK refused") and self._flight is not None and self._flight.started_ns is None:
            self._end(PAUSED)

    def step(self, time_ns: int) -> None:
        """Follow the body along its legs."""
        self._end_if_taken()
        self._ask_for_plan()
        flight, s = self._flight, self._system.subject
        if flight is not None and flight.arrivals_s:
            tracking = s.armed and s.picture.mode(s.body) == Mode.AUTO
            if tracking and flight.started_ns is None:
                flight.started_ns = time_ns
            if tracking:
                flight.taken = self._system.taken  # of what was asked nothing has taken the body
                self._advance(flight, time_ns)
            elif flight.started_ns is not None:
                self._end(PAUSED)
        self._tell_again(time_ns)

    def _end_if_taken(self) -> None:
        """End a flight that did not begin when the body no longer waits for it."""
        flight = self._flight
        if flight is None or flight.started_ns is not None:
            return
        reason = self._against_waiting(flight)
        if reason:
            self._end_before_it_began(reason)

    def _end_before_it_began(self, reason: str) -> None:
        self._system.say(WARNING, f"flight ended before it began: {reason}")
        self._end(PAUSED)

    def _against_waiting(self, flight: _Flight) -> str:
        """Why a flight is not waited for any more; empty while it is."""
        s = self._system.subject
        mode = s.picture.mode(s.body)
        flight.holds = flight.holds or mode == Mode.POSHOLD
        if not s.armed:
            return "the vehicle is disarmed"
        if s.picture.members(s.body) != flight.members:
            return "the body is another one"
        if self._system.taken != flight.taken:
            return "paused, or something else was asked for"
        if mode == Mode.POSHOLD or (mode == Mode.AUTO and flight.arrivals_s):
            return ""
        return f"the mode is {mode.name}" if flight.holds or s.picture.ticks > self._hold_by_tick else ""

    def _ask_for_plan(self) -> None:
        s = self._system.subject
        if self._plan_at_tick is None or s.picture.ticks < self._plan_at_tick or self._flight is None or not self._flight.holds:
            return
        self._plan_at_tick = None
        at, ground = s.record.setpoint, self._parameters().ground
        self._serial += 1
        self._flight.terms = self._terms(self._flight.legs)
        self.jobs.append(
            PlanJob(
                s.body, self._serial, at.p_wb, at.q_wb, self._with_speeds(self._flight.legs), ground.mission_acceleration,
                ground.mission_corridor_m,
            )
        )  # fmt: skip

    def _with_speeds(self, legs: Sequence[Leg]) -> tuple[Leg, ...]:
        cruise = self._cruise
        return tuple(leg._replace(speed_m_s=cruise) if math.isnan(leg.speed_m_s) else leg for leg in legs)

    def _terms(self, legs: Sequence[Leg]) -> tuple[Any, ...]:
        ground = self._parameters().ground
        places = (None if leg.p_wb is None else tuple(leg.p_wb) for leg in legs)
        rest = (leg._replace(p_wb=None) for leg in self._with_speeds(legs))
        return ground.mission_acceleration, ground.mission_corridor_m, *places, *rest

    def _flies_already(self, legs: Sequence[Leg]) -> bool:
        """Whether just these are under way, and none of them is reached: who asks again did not hear the answer."""
        flight = self._flight
        if flight is None or flight.replaced or flight.reached or flight.taken != self._system.taken:
            return False
        return flight.terms == self._terms(legs)

    def _advance(self, flight: _Flight, time_ns: int) -> None:
        assert flight.started_ns is not None
        p, t = self._system.subject.progress, (time_ns - flight.started_ns) / NS_PER_S
        while flight.reached < len(flight.legs) and t >= flight.arrivals_s[flight.reached]:
            sequence = flight.legs[flight.reached].sequence
            flight.reached += 1
            if sequence != _GO_TO and not flight.replaced:
                self._system.broadcast("MISSION_ITEM_REACHED", {"seq": sequence})
                self._repeat = [(sequence, time_ns + n * _REACHED_EVERY_NS) for n in range(1, _REACHED_REPEATS)]
                if flight.reached < len(flight.legs):
                    p.current = flight.legs[flight.reached].sequence
        last = flight.legs[-1]
        if flight.reached == len(flight.legs) and t >= flight.arrivals_s[-1] + last.hold_s:
            if last.sequence != _GO_TO:
                self._system.say(INFORMATION, "mission complete")
            self._end(DONE)

    def _tell_again(self, time_ns: int) -> None:
        while self._repeat and self._repeat[0][1] <= time_ns:
            self._system.broadcast("MISSION_ITEM_REACHED", {"seq": self._repeat.pop(0)[0]})

    def _begin(self, legs: Sequence[Leg]) -> None:
        if self._flies_already(legs):
            return
        s = self._system.subject
        self._serial += 1  # a plan that is still being made is no longer wanted
        self._system.ask(Action.SET_MODE, Mode.POSHOLD)
        self._flight = _Flight(tuple(legs), self._terms(legs), taken=self._system.taken, members=s.picture.members(s.body))
        self._plan_at_tick, self._hold_by_tick = s.picture.ticks + _SETTLE_TICKS, s.picture.ticks + _HOLD_TICKS

    def _end(self, state: int) -> None:
        flight, self._flight, self._plan_at_tick = self._flight, None, None
        self.jobs.clear()
        if flight is not None and flight.of_mission and not flight.replaced:
            self._system.subject.progress.state = state
            self._left = flight.legs[flight.reached :] or flight.legs[-1:]

    @property
    def _first(self) -> int:
        return 1 if self._system.subject.identity.mission_has_home else 0

    @property
    def _cruise(self) -> float:
        return self._parameters().ground.mission_speed_m_s if self._speed is None else self._speed

    def _legs(self, first: int) -> tuple[Leg, ...]:
        origin, turns, speed = self._system.subject.origin, self._system.subject.identity.waypoints_turn, math.nan
        legs: list[Leg] = []
        speeds = [item for item in self.items[:first] if item.speed_m_s is not None]  # one that was passed goes on to count
        for item in (*speeds, *flight_order(self.items, first)):
            if item.sequence < self._first:
                continue  # home, to which a jump leads
            if item.speed_m_s is not None:
                speed = item.speed_m_s if item.speed_m_s > 0 else math.nan
            place = item.place(origin)
            if place is not None:
                legs.append(Leg(item.sequence, place, item.yaw if turns else None, item.hold_s, speed))
            elif item.delay_s > 0:
                last = legs.pop() if legs else Leg(item.sequence, None, None, 0.0, speed)
                legs.append(last._replace(hold_s=last.hold_s + item.delay_s))
            if item.command == LOITER_UNLIMITED:
                break
        return tuple(legs)


def _no_speed(speed_m_s: float) -> str:
    return f"a speed of {speed_m_s:g} m/s; it needs {SLOWEST:g} to {FASTEST:g}"
