"""`modcube run --hold` and REARM arm each body once; whoever takes it over, disarms or stops it has the last word."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.app.operator import ARM_EVERY_S, FAREWELL_TICKS, REARM_S, Operator, with_ground
from firmware_py.core.transitions import State
from firmware_py.core.types import NEVER_AGE_NS, Action, BodyRecord, Mode, Outputs, Request
from tests.unit.ground_world import Robot

RATE_HZ = 100
SECOND = round(ARM_EVERY_S * RATE_HZ)
MINUTE = round(REARM_S * RATE_HZ)


class Waiting(Robot):
    """A robot whose pose may still be unknown."""

    ready = True
    tag_age_ns = 0

    def _record(self, body: int) -> BodyRecord:
        record = super()._record(body)
        return record._replace(estimate=record.estimate._replace(ready=self.ready, tag_age_ns=self.tag_age_ns))


class Flight:
    """A robot, its operator, and a ground station that makes each request in `asks` once."""

    def __init__(self, modules: int = 1, to_arm: set[int] | None = None, limit_s: float = math.inf) -> None:
        self.robot = Waiting(modules)
        self.said: list[str] = []
        self.operator = Operator(RATE_HZ, set(range(modules)) if to_arm is None else to_arm, limit_s, self.said.append)
        self.asks: list[Request] = []
        side: Any = SimpleNamespace(reboot_asked=False, requests=self._asked)
        self._requests = with_ground(self.operator, side, lambda: self.robot.bodies)
        self.last: Outputs | None = None

    def _asked(self) -> list[Request]:
        asked, self.asks = self.asks, []
        return asked

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            _, self.last = self.robot.step(self._requests(self.robot.tick, self.last))

    def ask(self, action: Action, body: int = 0, argument: object = None) -> None:
        self.asks.append(Request(action, body, argument))
        self.run(1)

    @property
    def arms(self) -> list[int]:
        """Bodies asked to arm, in order."""
        return [request.body for request in self.robot.asked if request.action == Action.ARM]


def test_every_body_is_armed_once() -> None:
    flight = Flight(modules=3)
    flight.run(10 * SECOND)
    assert flight.arms == [0, 1, 2]
    assert flight.robot.state == [State.ARMED] * 3


def test_arming_that_is_refused_is_tried_again_every_second() -> None:
    flight = Flight()
    flight.robot.refuse[Action.ARM] = "no pose"
    flight.run(1 + 3 * SECOND)
    assert flight.arms == [0] * 3
    del flight.robot.refuse[Action.ARM]
    flight.run(SECOND)
    assert flight.robot.state == [State.ARMED]


def test_body_that_a_person_disarmed_stays_disarmed() -> None:
    flight = Flight()
    flight.run(10)
    flight.ask(Action.DISARM)
    flight.run(10 * SECOND)
    assert flight.robot.state == [State.DISARMED]
    assert flight.arms == [0]


def test_body_that_disarmed_by_itself_stays_disarmed() -> None:
    flight = Flight(modules=2)
    flight.run(10)
    flight.robot.state[1] = State.DISARMED
    flight.run(10 * SECOND)
    assert flight.robot.state == [State.ARMED, State.DISARMED]


def test_module_that_was_disarmed_as_part_of_a_body_stays_disarmed_on_its_own() -> None:
    flight = Flight(modules=2)
    flight.robot.dock()
    flight.robot.state = [State.ARMED] * 2
    flight.run(10)
    flight.robot.state = [State.DISARMED] * 2
    flight.robot.bodies = Robot(2).bodies
    flight.run(10 * SECOND)
    assert flight.arms == []


@pytest.mark.parametrize("armed_before", [True, False])
def test_emergency_stop_ends_the_hold_of_every_body(armed_before: bool) -> None:
    """The stop comes from the bus: no ground station asked for it."""
    flight = Flight(modules=2)
    if not armed_before:
        flight.robot.refuse[Action.ARM] = "no pose"
    flight.run(10)
    flight.robot.state = [State.DISARMED, State.ESTOP]
    flight.run(1)
    flight.robot.refuse.clear()
    flight.ask(Action.CLEAR_ESTOP, body=1)
    flight.robot.asked.clear()
    flight.run(10 * SECOND)
    assert flight.robot.state == [State.DISARMED] * 2
    assert flight.arms == []


@pytest.mark.parametrize("action", [Action.DISARM, Action.ESTOP])
def test_ground_station_that_stops_ends_the_hold_before_anything_was_armed(action: Action) -> None:
    flight = Flight(modules=2)
    flight.asks = [Request(action, 1)]  # in the very tick in which the operator would arm
    flight.robot.step([])
    _, flight.last = flight.robot.step([])
    flight.run(10 * SECOND)
    assert flight.arms == []


def test_other_requests_of_a_ground_station_leave_the_hold_alone() -> None:
    flight = Flight()
    flight.ask(Action.GROUND_ALIVE)
    flight.run(10)
    assert flight.robot.state == [State.ARMED]


@pytest.mark.parametrize(("action", "argument"), [(Action.ARM, False), (Action.ARM, True), (Action.MOTOR_TEST, (1, 0.1, 1.0))])
def test_nothing_is_armed_in_the_farewell(action: Action, argument: object) -> None:
    flight = Flight()
    flight.run(10)
    flight.operator.stopping = True
    flight.run(1)
    assert flight.robot.state == [State.DISARMED]
    flight.ask(action, argument=argument)
    flight.run(FAREWELL_TICKS - 2)
    assert flight.operator.is_done(0, flight.last)
    assert flight.robot.state == [State.DISARMED]
    assert action not in [request.action for request in flight.robot.asked[1:]], "the first is the operator's"


def test_stop_is_heard_in_the_farewell() -> None:
    flight = Flight()
    flight.operator.stopping = True
    flight.ask(Action.ESTOP)
    assert flight.robot.state == [State.ESTOP]


def test_body_that_parts_in_the_tick_of_the_stop_is_disarmed_as_both() -> None:
    flight = Flight(modules=2, to_arm=set())
    flight.robot.dock()
    flight.robot.state = [State.ARMED] * 2
    flight.run(2)
    flight.operator.stopping = True
    flight.robot.bodies = Robot(2).bodies
    flight.run(2)
    assert flight.robot.state == [State.DISARMED] * 2


def test_operator_without_orders_arms_nobody() -> None:
    flight = Flight(modules=2, to_arm=set())
    flight.run(10 * SECOND)
    assert flight.arms == []


def test_only_the_bodies_that_were_meant_are_armed() -> None:
    flight = Flight(modules=3, to_arm={1})
    flight.run(10 * SECOND)
    assert flight.arms == [1]


@pytest.mark.slow
@pytest.mark.parametrize(("ticks", "arms"), [(MINUTE - 1, [0]), (MINUTE, [])])
def test_flight_that_was_broken_off_is_taken_up_within_a_minute_or_never(ticks: int, arms: list[int]) -> None:
    """An hour later, the robot may be in somebody's hands when a camera sees its first tag."""
    flight = Flight(limit_s=REARM_S)
    flight.robot.ready = False
    flight.run(ticks - 2)
    flight.robot.ready = True
    flight.run(2 * MINUTE)
    assert flight.arms == arms
    assert flight.said == ([] if arms else ["not armed again: the vehicle could not within 60 s (REARM)"])


@pytest.mark.slow
def test_flight_that_may_not_be_taken_up_is_tried_for_a_minute() -> None:
    flight = Flight(limit_s=REARM_S)
    flight.robot.refuse[Action.ARM] = "leak"
    flight.run(2 * MINUTE)
    assert len(flight.arms) == MINUTE // SECOND
    assert len(flight.said) == 1


@pytest.mark.slow
def test_order_to_hold_stays_without_limit() -> None:
    flight = Flight()
    flight.robot.ready = False
    flight.run(2 * MINUTE)
    flight.robot.ready, flight.robot.tag_age_ns = True, NEVER_AGE_NS
    flight.run(MINUTE)
    assert flight.arms == [], "it stands upright, and does not know where"
    flight.robot.tag_age_ns = 0
    flight.run(2)
    assert flight.arms == [0]
    assert flight.said == []


TAKES = [(Action.SET_MODE, Mode.MANUAL), (Action.ARM, False), (Action.MOTOR_TEST, (1, 0.1, 1.0))]


@pytest.mark.parametrize(("action", "argument"), TAKES)
@pytest.mark.parametrize("limit_s", [math.inf, REARM_S])
def test_body_that_a_person_takes_over_is_the_persons_to_arm_and_the_others_are_not(
    action: Action, argument: object, limit_s: float
) -> None:
    flight = Flight(modules=2, limit_s=limit_s)
    flight.robot.refuse[Action.ARM] = "no pose"
    flight.asks = [Request(action, 1, argument)]  # in the very tick in which the operator would arm
    flight.run(10)
    flight.robot.refuse.clear()
    flight.robot.asked.clear()
    flight.run(2 * SECOND)
    assert flight.arms == [0]
    assert flight.robot.state == [State.ARMED, State.DISARMED]


def test_modules_of_a_body_that_a_person_takes_over_are_the_persons_when_it_parts() -> None:
    flight = Flight(modules=2)
    flight.robot.dock()
    flight.robot.refuse[Action.ARM] = "no pose"
    flight.ask(Action.SET_MODE, argument=Mode.MANUAL)
    flight.robot.refuse.clear()
    flight.robot.bodies = Robot(2).bodies
    flight.run(2 * SECOND)
    assert flight.arms == []


def test_signal_that_comes_while_a_reboot_is_looked_for_ends_the_run() -> None:
    flight = Flight(to_arm=set())

    class Signalled:
        requests = staticmethod(flight._asked)

        @property
        def reboot_asked(self) -> bool:
            flight.operator.stop()  # Python calls the handler of a signal between any two steps of the tick
            return False

    side: Any = Signalled()
    flight._requests = with_ground(flight.operator, side, lambda: flight.robot.bodies)
    flight.run(1)
    assert flight.operator.stopping
