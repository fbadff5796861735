"""Flight of missions: turns items into legs, requests a plan for them, and follows the body along it.

Planning takes a second and happens elsewhere: a PlanJob goes out, a Plan comes back, and the body tracks it. A request that gives the body
another task before then ends the flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from firmware_py.core.types import INFORMATION, NOTICE, WARNING, Action, Event, Mode
from firmware_py.description.parameters import Parameters
from firmware_py.ground.mission_items import FASTEST, SLOWEST, SPEED_DEFAULT, SPEED_STAYS, Item, MissionError, beyond_fence
from firmware_py.ground.mission_legs import GO_TO, Flight, Leg, at_another_speed, legs_from
from firmware_py.ground.plan_jobs import Plan, PlanJobs
from firmware_py.ground.reached_items import ReachedItems
from firmware_py.ground.subject import ACTIVE, DONE, NO_MISSION, PAUSED, READY
from firmware_py.ground.system import NS_PER_S, System
from firmware_py.ground.telemetry import mission_current

_SETTLE_TICKS = 3
"""Ticks from the request of a hold to reading where the body is held."""
_HOLD_TICKS = 100
"""Ticks from the request of a hold until it must be in force; ticks queued while the loop took the request count too."""
_LATE_FOR_HOLD_S = 1.0
"""Delay beyond which a body that comes to its hold has the rest of the mission planned anew from there, the hold first."""
_ANOTHER = "the body is another one"
_PRESENT = -1
"""DO_SET_MISSION_CURRENT's number for the current item."""


class MissionFlight:
    """The mission of one body."""

    def __init__(self, system: System, parameters: Callable[[], Parameters]) -> None:
        self._system, self._parameters = system, parameters
        self.items: tuple[Item, ...] = ()
        self.jobs = PlanJobs(parameters)
        self._flight: Flight | None = None
        self._remaining_legs: tuple[Leg, ...] = ()
        """Legs left of a paused mission: jumps already made are not repeated."""
        self._started_at_item: int | None = None
        """Item from which the mission was last started; None while a jump restarts it, perhaps from the same item."""
        self._reached = ReachedItems(system)

    # ------------------------------------------------------------ requests

    def replace(self, items: tuple[Item, ...]) -> None:
        """Takes a new mission, ready to be started. A flight of the old one goes on; one still being planned is cancelled."""
        if self._flight is not None and self._flight.of_mission and not self._flight.arrivals_s:
            self._end_before_it_began("its mission was replaced")
        self.amend(items)
        self._reached.forget()
        p = self._system.subject.progress
        p.total, p.current = max(len(items) - self._first, 0), min(self._first, max(len(items) - 1, 0))
        p.state = READY if items else NO_MISSION
        if self._flight is not None and self._flight.of_mission and not self._flight.replaced:
            self._flight.replaced = True
            self._system.say(NOTICE, "the mission under way flies on, until it is paused or another is started")

    def amend(self, items: tuple[Item, ...]) -> None:
        """Changes items of the mission while it is not flown; it resumes at its current item."""
        self.items, self._remaining_legs = items, ()

    def check_fence(self, item: Item) -> tuple[int, str]:
        """Checks `item` against the present fence. Returns a MAV_MISSION_RESULT, 0 if it can be flown, and why it cannot."""
        place = item.place(self._system.subject.origin) if item.sequence >= self._first else None
        return (0, "") if place is None else beyond_fence(place, self._parameters().fence)

    @property
    def awaited(self) -> int:
        """Serial number of the job whose plan is awaited; 0: none."""
        return self._flight.serial if self._flight is not None and not self._flight.arrivals_s else 0

    @property
    def flies(self) -> bool:
        """Whether the present mission is under way."""
        return self._system.subject.progress.state == ACTIVE

    def start(self, first: int | None) -> str:
        """Starts the mission at item `first`; with None resumes it where it stopped. One already started there flies on, unless it is late:
        the answer to the first request may have been lost.

        Returns why not, or an empty text.
        """
        s = self._system.subject
        self._end_if_taken()
        if not self.items:
            return "there is none"
        if not s.armed:
            return "the vehicle is disarmed"
        if self._flight is not None and (self._flight.is_late or self._system.task_changes != self._flight.task_changes):
            self._end(PAUSED)  # the body does not get to its place; or has another task, and the next tick would end the flight
        wanted = first
        if wanted is None:
            wanted = s.progress.current if s.progress.state == PAUSED else 0
        wanted = max(wanted, self._first)
        if s.progress.state == ACTIVE and (first is None or wanted == self._started_at_item):
            return ""
        left = self._remaining_legs if first is None and s.progress.state == PAUSED else ()
        try:
            legs = left or legs_from(self.items, wanted, s.origin, s.identity)
        except MissionError as error:
            return str(error)
        if not legs:
            return "nothing is left to fly"
        self._reached.forget(legs[0].sequence)
        s.progress.state, s.progress.current, self._started_at_item = ACTIVE, legs[0].sequence, wanted
        if not self._flies_already(legs):
            self._begin(legs)
        return ""

    def jump(self, index: int) -> str:
        """Continues at item `index` (-1: the current one) and broadcasts MISSION_CURRENT. Returns why not, or an empty text."""
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
            self._started_at_item = None
            return self.start(index)
        p.current, p.state, self._remaining_legs = index, PAUSED, ()
        return ""

    def set_speed(self, speed_m_s: float) -> str:
        """Sets the speed from here on, up to the mission's next change of speed: a flight under way is planned anew from where the body is.

        Args:
            speed_m_s: -1: unchanged; -2: the parameter's.

        Returns why not, or an empty text.
        """
        if speed_m_s == SPEED_STAYS:
            return ""
        wanted = None if speed_m_s == SPEED_DEFAULT else speed_m_s
        if wanted is not None and not SLOWEST <= wanted <= FASTEST:
            return _no_speed(wanted)
        self._end_if_taken()
        self.jobs.speed_m_s, self._remaining_legs = wanted, at_another_speed(self._remaining_legs)
        flight = self._flight
        if flight is not None and self._is_on_its_way(flight):
            legs = at_another_speed(flight.left(self._flown_s(flight)))
            if self.jobs.inputs(legs)[-len(legs) :] != flight.plan_inputs[-len(legs) :]:
                self._system.say(NOTICE, f"{self.jobs.cruise_m_s:g} m/s: the way from here is planned anew")
                self._begin(legs, flight.replaced)
        return ""

    def go_to(self, latitude_deg: float, longitude_deg: float, altitude_m: float, yaw: float, speed_m_s: float) -> str:
        """Flies to one place inside the fence; a speed of 0 or less means that of missions. Returns why not, or an empty text."""
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
        legs = (Leg(GO_TO, place, turned, 0.0, speed_m_s if speed_m_s > 0 else math.nan),)
        if not self._flies_already(legs):
            self._begin(legs)
        return ""

    # ------------------------------------------------------------ events

    def planned(self, plan: Plan) -> None:
        """Takes a finished plan and requests tracking, unless the body has been given another task meanwhile."""
        self._end_if_taken()
        if self._flight is None or plan.serial != self._flight.serial:
            return
        if plan.trajectory is None:
            self._system.say(WARNING, f"mission refused: {plan.reason}")
            self._end(PAUSED)
            return
        self._flight.arrivals_s = plan.arrivals_s
        self._system.ask(Action.TRACK, plan.trajectory)

    def lose_body(self) -> None:
        """Ends the flight of a body that has docked into another: it does not fly on when it is undocked."""
        if self._flight is not None and self._flight.started_ns is None:
            self._end_before_it_began(_ANOTHER)
        elif self._flight is not None:
            self._end(PAUSED)

    def hear(self, event: Event) -> None:
        """Takes an event; a refusal of TRACK ends the flight that waits for it."""
        if event.text.startswith("TRACK refused") and self._flight is not None and self._flight.started_ns is None:
            self._end(PAUSED)

    def step(self, time_ns: int) -> None:
        """Follows the body along its legs."""
        self._end_if_taken()
        self._ask_for_plan()
        flight, s = self._flight, self._system.subject
        if flight is not None and flight.arrivals_s:
            tracking = s.armed and s.picture.mode(s.body) == Mode.AUTO
            if tracking and flight.started_ns is None:
                flight.started_ns = time_ns
            if tracking:
                if flight.task_changes != self._system.task_changes:  # no request so far has given the body another task
                    flight.task_changes, flight.changed_tick = self._system.task_changes, s.picture.ticks
                self._advance(flight, time_ns)
            elif flight.started_ns is not None:
                self._end(PAUSED)
        self._reached.tell_again(time_ns)

    def _end_if_taken(self) -> None:
        """Ends a flight that has not begun if the body no longer waits for it."""
        flight = self._flight
        if flight is None or flight.started_ns is not None:
            return
        reason = self._reason_to_abandon(flight)
        if not reason:
            return
        self._end_before_it_began(reason)
        if reason == _ANOTHER and flight.arrivals_s:  # it has been asked to track a plan that was made for the body before it
            self._system.ask(Action.SET_MODE, Mode.POSHOLD)

    def _end_before_it_began(self, reason: str) -> None:
        self._system.say(WARNING, f"flight ended before it began: {reason}")
        self._end(PAUSED)

    def _reason_to_abandon(self, flight: Flight) -> str:
        """Returns why the body no longer waits for a flight; empty while it does."""
        s = self._system.subject
        mode = s.picture.mode(s.body)
        flight.hold_reached = flight.hold_reached or mode == Mode.POSHOLD
        if not s.armed:
            return "the vehicle is disarmed"
        if self._system.task_changes != flight.task_changes:
            return "paused, or something else was asked for"
        if s.picture.members(s.body) != flight.members:
            return _ANOTHER
        if mode == Mode.POSHOLD or (mode == Mode.AUTO and flight.arrivals_s):
            return ""
        return f"the mode is {mode.name}" if flight.hold_reached or s.picture.ticks > flight.begun_tick + _HOLD_TICKS else ""

    def _ask_for_plan(self) -> None:
        flight, s = self._flight, self._system.subject
        if flight is None or flight.serial or not flight.hold_reached or s.picture.ticks < flight.begun_tick + _SETTLE_TICKS:
            return
        flight.plan_inputs = self.jobs.inputs(flight.legs)
        flight.serial = self.jobs.add(s.body, s.record.setpoint, flight.legs)

    def _flies_already(self, legs: Sequence[Leg]) -> bool:
        """Whether exactly these legs are under way and none is reached: a client repeats its request if the answer was lost."""
        flight = self._flight
        if flight is None or flight.replaced or flight.reached or flight.task_changes != self._system.task_changes:
            return False
        return flight.plan_inputs == self.jobs.inputs(legs)

    def _advance(self, flight: Flight, time_ns: int) -> None:
        assert flight.started_ns is not None
        t_s = (time_ns - flight.started_ns) / NS_PER_S
        while flight.reached < len(flight.legs) and t_s >= flight.arrivals_s[flight.reached]:
            leg = flight.legs[flight.reached]
            away_m = self._away_m(leg)
            if not away_m <= leg.acceptance_m:
                self._tell_if_late(flight, t_s, away_m)
                return
            rest = flight.legs[flight.reached :]
            if leg.hold_s > 0 and len(rest) > 1 and t_s - flight.arrivals_s[flight.reached] > _LATE_FOR_HOLD_S:
                if self._is_on_its_way(flight):
                    self._begin(rest, flight.replaced)  # a part of the hold, which runs on the plan's clock, is over
                return
            flight.reach(t_s)
            self._tell_reached(flight, leg.sequence, time_ns)
        last = flight.legs[-1]
        if flight.reached == len(flight.legs) and t_s >= flight.reached_s + last.hold_s:
            if last.sequence != GO_TO:
                self._system.say(INFORMATION, "mission complete")
            self._end(DONE)

    def _away_m(self, leg: Leg) -> float:
        """Distance between the body and the leg's place, 0 if it has none; NaN without an estimate."""
        s = self._system.subject
        return 0.0 if leg.p_wb is None else s.picture.distance(s.body, leg.p_wb)

    def _tell_reached(self, flight: Flight, sequence: int, time_ns: int) -> None:
        if sequence == GO_TO or flight.replaced:
            return
        self._reached.tell(sequence, time_ns)
        if flight.reached < len(flight.legs):
            self._system.subject.progress.current = flight.legs[flight.reached].sequence

    def _tell_if_late(self, flight: Flight, t_s: float, away_m: float) -> None:
        if flight.becomes_late(t_s) and not flight.replaced:
            sequence = flight.legs[flight.reached].sequence
            what = "flight" if sequence == GO_TO else f"mission item {sequence}"
            where = "its pose is unknown" if math.isnan(away_m) else f"{away_m:.2f} m from its place"
            self._system.say(WARNING, f"{what} is late: {where}")

    def _begin(self, legs: Sequence[Leg], replaced: bool = False) -> None:
        s = self._system.subject
        self._system.ask(Action.SET_MODE, Mode.POSHOLD)
        changes, members = self._system.task_changes, s.picture.members(s.body)
        inputs, tick = self.jobs.inputs(legs), s.picture.ticks
        self._flight = Flight(tuple(legs), inputs, tick, task_changes=changes, members=members, replaced=replaced)

    def _end(self, state: int) -> None:
        flight, self._flight = self._flight, None
        self.jobs.waiting.clear()
        if flight is not None and flight.of_mission and not flight.replaced:
            s = self._system.subject
            self._remaining_legs, s.progress.state = flight.left(self._flown_s(flight)), state
            if state == PAUSED:
                s.progress.current = self._remaining_legs[0].sequence

    def _flown_s(self, flight: Flight) -> float:
        """Time since the body began to follow the flight's plan; 0 before."""
        return 0.0 if flight.started_ns is None else (self._system.subject.picture.time_ns - flight.started_ns) / NS_PER_S

    def _is_on_its_way(self, flight: Flight) -> bool:
        """Whether the body has the flight for its task, and nothing that was asked for in the last ticks may yet give it another."""
        s = self._system.subject
        if self._system.task_changes != flight.task_changes:
            return False
        tracks = s.armed and s.picture.mode(s.body) == Mode.AUTO and s.picture.ticks >= flight.changed_tick + _SETTLE_TICKS
        return flight.started_ns is None or tracks

    @property
    def _first(self) -> int:
        return self._system.subject.identity.first_item


def _no_speed(speed_m_s: float) -> str:
    return f"a speed of {speed_m_s:g} m/s; it needs {SLOWEST:g} to {FASTEST:g}"
