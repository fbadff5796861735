"""The supervisor of a joined or parted body takes over from those of the previous bodies."""

import pytest

from firmware_py.core.failsafes import Level
from firmware_py.core.health import Health
from firmware_py.core.names import Place
from firmware_py.core.supervisor import Supervisor
from firmware_py.core.transitions import State
from firmware_py.core.types import CRITICAL, INFORMATION, WARNING, Action, Mode, Request
from tests.unit.healths import BLIND, GOOD, UPRIGHT, at
from tests.unit.supervisors import QUICK, P, ask, supervisor_in, texts


@pytest.mark.parametrize(
    ("states", "expected"),
    [
        ((State.ARMED, State.ARMED), State.ARMED), ((State.ARMED, State.DISARMED), State.DISARMED),
        ((State.ESTOP, State.ARMED), State.ESTOP), ((State.DISARMED, State.ESTOP), State.ESTOP), ((State.ARMED,), State.ARMED),
    ],
)  # fmt: skip
def test_joined_robot_is_armed_when_all_were_and_stopped_when_one_was(states: tuple[State, ...], expected: State) -> None:
    joined = Supervisor(P)
    joined.take_over([supervisor_in(state) for state in states])
    assert (joined.state, joined.mode, joined.level) == (expected, Mode.POSHOLD, Level.NONE)


@pytest.mark.parametrize("mode", [Mode.SURFACE, Mode.ALT_HOLD])
def test_robot_that_a_fail_safe_took_stays_in_its_mode_when_it_joins_or_parts(mode: Mode) -> None:
    taken, other, body = supervisor_in(mode=mode), supervisor_in(mode=Mode.DOCK), Supervisor(P)
    taken.level = Level.SURFACE if mode == Mode.SURFACE else Level.DEPTH
    body.take_over([other, taken])
    assert (body.mode, body.level) == (mode, taken.level)


def test_robot_that_joins_holds_its_place_whatever_it_did_before() -> None:
    joined = Supervisor(P)
    joined.take_over([supervisor_in(mode=Mode.AUTO), supervisor_in(mode=Mode.DOCK)])
    assert joined.mode == Mode.POSHOLD


@pytest.mark.parametrize("mode", [Mode.MANUAL, Mode.STABILIZE, Mode.ALT_HOLD])
def test_robot_that_a_pilot_steers_is_steered_by_him_when_it_joins_or_parts(mode: Mode) -> None:
    for before in ([supervisor_in(mode=mode)], [supervisor_in(mode=Mode.DOCK), supervisor_in(mode=mode)]):
        body = Supervisor(P)
        body.take_over(before)
        assert (body.mode, body.level) == (mode, Level.NONE)


@pytest.mark.parametrize(("state", "mode", "health", "may"), [
    (State.DISARMED, Mode.POSHOLD, GOOD, True), (State.DISARMED, Mode.POSHOLD, GOOD._replace(esc_missing=(Place(0, 3),)), False),
    (State.DISARMED, Mode.POSHOLD, BLIND, False), (State.DISARMED, Mode.MANUAL, BLIND, True),
    (State.DISARMED, Mode.POSHOLD, UPRIGHT, False), (State.DISARMED, Mode.ALT_HOLD, UPRIGHT, True),
    (State.ARMED, Mode.POSHOLD, GOOD, False), (State.ESTOP, Mode.POSHOLD, GOOD, False),
])  # fmt: skip
def test_robot_that_may_arm_is_disarmed_and_passes_every_check_of_its_mode(state: State, mode: Mode, health: Health, may: bool) -> None:
    supervisor = supervisor_in(state, mode)
    assert supervisor.may_arm(health) is may
    assert supervisor.state == state
    assert supervisor.events == []


def test_severities_are_those_of_syslog() -> None:
    assert (CRITICAL, WARNING, INFORMATION) == (2, 4, 6)


def test_graver_fail_safe_of_two_bodies_that_join_decides_whichever_comes_first() -> None:
    held, deep, surfacing = supervisor_in(mode=Mode.POSHOLD), supervisor_in(mode=Mode.ALT_HOLD), supervisor_in(mode=Mode.SURFACE)
    held.level, deep.level = Level.HOLD, Level.DEPTH
    for pair, mode, level in (((held, deep), Mode.ALT_HOLD, Level.DEPTH), ((deep, surfacing), Mode.SURFACE, Level.NONE)):
        for before in (pair, pair[::-1]):
            joined = Supervisor(P)
            joined.take_over(before)
            assert (joined.mode, joined.level) == (mode, level)


def test_robot_that_a_person_lets_surface_goes_on_when_it_parts() -> None:
    surfacing, part = supervisor_in(mode=Mode.SURFACE), Supervisor(P)
    part.take_over([surfacing])
    assert (part.mode, part.level) == (Mode.SURFACE, Level.NONE)


def test_joined_robot_keeps_e_stop_and_fail_safe() -> None:
    a, b, joined = supervisor_in(), supervisor_in(mode=Mode.AUTO, parameters=QUICK), Supervisor(P)
    a.step(True, GOOD, [])
    b.step(False, GOOD._replace(leak=True), [])
    b.step(True, at(GOOD, 0.1), [Request(Action.ESTOP)])
    b.level = Level.SURFACE
    joined.take_over([a, b])
    assert joined.raises_estop and joined.level == Level.SURFACE and joined.state == State.ESTOP
    assert ask(joined, Action.CLEAR_ESTOP, None, at(GOOD, 0.29)) == []
    assert ask(joined, Action.CLEAR_ESTOP, None, at(GOOD, 0.31))
    calm = Supervisor(P)
    calm.take_over([supervisor_in(), supervisor_in()])
    assert not calm.raises_estop


def test_milder_fail_safe_does_not_end_surfacing() -> None:
    """Whoever chose SURFACE: a robot on its way up is not made to hold its place."""
    health = GOOD._replace(silent_s=0.6)
    supervisor = supervisor_in(mode=Mode.SURFACE)
    supervisor.step(False, health, [])
    assert (supervisor.mode, supervisor.level) == (Mode.SURFACE, Level.NONE)
    assert texts(supervisor) == ["fail-safe on: a module is silent for 0.6 s"]
    supervisor = supervisor_in(mode=Mode.SURFACE)
    supervisor.step(False, GOOD._replace(bus_silent_s=2.1), [])
    assert supervisor.state == State.DISARMED


def test_fail_safe_of_a_body_that_is_taken_over_is_on_already() -> None:
    before, after = supervisor_in(mode=Mode.AUTO, parameters=QUICK), supervisor_in(State.DISARMED)
    before.step(False, GOOD._replace(leak=True), [])
    after.take_over([before])
    assert (after.mode, after.level) == (Mode.SURFACE, Level.SURFACE) and after.is_on("leak")
    assert after.step(False, at(GOOD._replace(leak=True), 1), []) == [] == after.events


def test_motor_test_of_one_body_becomes_no_flight_when_it_is_docked_to() -> None:
    tested = supervisor_in(State.DISARMED)
    assert ask(tested, Action.MOTOR_TEST, (0, 0.1, 1.0)) and tested.armed
    for before in ([tested, supervisor_in(mode=Mode.DOCK)], [supervisor_in(mode=Mode.DOCK), tested], [tested]):
        joined = Supervisor(P)
        joined.take_over(before)
        assert (joined.state, joined.mode) == (State.DISARMED, Mode.POSHOLD)
    stopped = supervisor_in(State.DISARMED)
    ask(stopped, Action.MOTOR_TEST, (0, 0.1, 1.0))
    stopped.step(True, GOOD, [])
    joined = Supervisor(P)
    joined.take_over([stopped, supervisor_in()])
    assert joined.state == State.ESTOP


def test_motor_detect_goes_on_in_the_parts_of_a_body_but_not_in_what_is_joined() -> None:
    """Nothing holds a body in MOTOR_DETECT: what has docked to one in flight would sink with it."""
    detecting, pilot = supervisor_in(mode=Mode.MOTOR_DETECT), supervisor_in(mode=Mode.STABILIZE)
    for before, mode in (
        ([detecting], Mode.MOTOR_DETECT), ([detecting, supervisor_in(mode=Mode.DOCK)], Mode.POSHOLD), ([detecting, pilot], Mode.STABILIZE),
        ([pilot, detecting], Mode.STABILIZE),
    ):  # fmt: skip
        after = Supervisor(P)
        after.take_over(before)
        assert (after.state, after.mode) == (State.ARMED, mode)
