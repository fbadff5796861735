"""The supervisor's tables: where each transition leads, what each mode needs, and the numbers stored in logs."""

import pytest

from firmware_py.core.transitions import DOCKING, MODE_TABLE, MODES, ROWS, TABLE, Effect, Guard, Need, State, Trigger
from firmware_py.core.types import Mode


def test_numbers_are_those_of_the_logs() -> None:
    """A log from last year must keep its meaning."""
    assert {state.name: int(state) for state in State} == {"DISARMED": 0, "ARMED": 1, "ESTOP": 2}
    assert [trigger.name for trigger in sorted(Trigger)] == [
        "ESTOP_FRAME", "ESTOP", "CLEAR_ESTOP", "DISARM", "ARM", "FORCED_ARM", "SET_MODE", "HOLD", "TRACK", "DOCK", "UNDOCK",
        "SET_POINT", "STICKS", "MOTOR_TEST", "TEST_OVER", "DOCK_OVER", "FAILSAFE_HOLD", "FAILSAFE_DEPTH", "FAILSAFE_SURFACE",
        "FAILSAFE_DISARM",
    ]  # fmt: skip
    assert [int(trigger) for trigger in Trigger] == list(range(20))
    assert [int(guard) for guard in Guard] == list(range(11))
    assert [int(effect) for effect in Effect] == list(range(9))
    assert [int(need) for need in Need] == list(range(4))
    assert {Trigger.DOCK, Trigger.UNDOCK} == DOCKING


def row(state: State, trigger: Trigger) -> tuple[Guard, Effect, State, Mode | None]:
    return ROWS[state, trigger][2:]


def test_table_has_one_row_for_a_state_and_a_trigger() -> None:
    assert len(ROWS) == len(TABLE) == 37


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_e_stop_comes_through_from_everywhere(state: State) -> None:
    effect = Effect.NOTHING if state == State.ESTOP else Effect.STOP
    for trigger in (Trigger.ESTOP_FRAME, Trigger.ESTOP):
        assert row(state, trigger) == (Guard.ALWAYS, effect, State.ESTOP, None)


def test_stopped_robot_is_left_by_clearing_alone() -> None:
    leads = {r.trigger: r for r in TABLE if r.state == State.ESTOP}
    assert set(leads) == {
        Trigger.ESTOP_FRAME, Trigger.ESTOP, Trigger.CLEAR_ESTOP, Trigger.DISARM, Trigger.SET_POINT, Trigger.STICKS,
    }  # fmt: skip
    assert {t for t, r in leads.items() if r.next_state != State.ESTOP} == {Trigger.CLEAR_ESTOP}
    assert row(State.ESTOP, Trigger.CLEAR_ESTOP) == (Guard.ESTOP_QUIET, Effect.NOTHING, State.DISARMED, None)
    assert row(State.ESTOP, Trigger.DISARM) == (Guard.ALWAYS, Effect.NOTHING, State.ESTOP, None)


def test_thrusters_turn_only_after_arming() -> None:
    arming = {r.trigger: r[2:] for r in TABLE if r.state != State.ARMED and r.next_state == State.ARMED}
    assert arming == {
        Trigger.ARM: (Guard.ARMING_CHECKS, Effect.ENTER_MODE, State.ARMED, None),
        Trigger.FORCED_ARM: (Guard.FORCED_CHECKS, Effect.ENTER_MODE, State.ARMED, None),
        Trigger.MOTOR_TEST: (Guard.FORCED_CHECKS, Effect.TEST_MOTOR, State.ARMED, Mode.MOTOR_DETECT),
    }


def test_armed_robot_can_be_disarmed_at_any_time() -> None:
    for trigger in (Trigger.DISARM, Trigger.FAILSAFE_DISARM):
        assert row(State.ARMED, trigger) == (Guard.ALWAYS, Effect.STOP, State.DISARMED, None)
    assert row(State.ARMED, Trigger.TEST_OVER) == (Guard.TESTING, Effect.STOP, State.DISARMED, Mode.POSHOLD)
    disarming = {r.trigger for r in TABLE if r.state == State.ARMED and r.next_state == State.DISARMED}
    assert disarming == {Trigger.DISARM, Trigger.FAILSAFE_DISARM, Trigger.TEST_OVER}


def test_disarmed_robot_takes_a_mode_a_point_and_sticks_and_does_nothing() -> None:
    quiet = (Guard.ALWAYS, Effect.NOTHING, State.DISARMED, None)
    for trigger in (Trigger.CLEAR_ESTOP, Trigger.DISARM, Trigger.SET_MODE):
        assert row(State.DISARMED, trigger) == quiet
    rest = {r.trigger for r in TABLE if r.state == State.DISARMED}
    assert rest == {
        Trigger.ESTOP_FRAME, Trigger.ESTOP, Trigger.CLEAR_ESTOP, Trigger.DISARM, Trigger.ARM, Trigger.FORCED_ARM,
        Trigger.SET_MODE, Trigger.UNDOCK, Trigger.SET_POINT, Trigger.STICKS, Trigger.MOTOR_TEST,
    }  # fmt: skip
    assert row(State.DISARMED, Trigger.UNDOCK) == (Guard.JOINT_OPEN, Effect.NOTHING, State.DISARMED, None)


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_points_and_sticks_are_heard_in_every_state(state: State) -> None:
    assert row(state, Trigger.SET_POINT) == (Guard.ALWAYS, Effect.TAKE_POINT, state, None)
    assert row(state, Trigger.STICKS) == (Guard.ALWAYS, Effect.TAKE_STICKS, state, None)


def test_armed_robot_changes_its_mode_by_these_rows() -> None:
    a, permitted, needs = State.ARMED, Guard.MODE_PERMITTED, Guard.MODE_NEEDS
    assert row(a, Trigger.SET_MODE) == (permitted, Effect.ENTER_MODE, a, None)
    assert row(a, Trigger.HOLD) == (permitted, Effect.HOLD_AT, a, Mode.POSHOLD)
    assert row(a, Trigger.TRACK) == (permitted, Effect.FOLLOW, a, Mode.AUTO)
    assert row(a, Trigger.DOCK) == (permitted, Effect.ENTER_MODE, a, Mode.DOCK)
    assert row(a, Trigger.UNDOCK) == (Guard.PARTING_PERMITTED, Effect.ENTER_MODE, a, Mode.DOCK)
    assert row(a, Trigger.DOCK_OVER) == (Guard.IN_DOCK, Effect.ENTER_MODE, a, Mode.POSHOLD)
    assert row(a, Trigger.FAILSAFE_HOLD) == (needs, Effect.ENTER_LEVEL, a, Mode.POSHOLD)
    assert row(a, Trigger.FAILSAFE_DEPTH) == (needs, Effect.ENTER_LEVEL, a, Mode.ALT_HOLD)
    assert row(a, Trigger.FAILSAFE_SURFACE) == (Guard.ALWAYS, Effect.ENTER_MODE, a, Mode.SURFACE)
    assert row(a, Trigger.MOTOR_TEST) == (Guard.IN_MOTOR_DETECT, Effect.TEST_MOTOR, a, None)
    for trigger in (Trigger.CLEAR_ESTOP, Trigger.ARM, Trigger.FORCED_ARM):
        assert row(a, trigger) == (Guard.ALWAYS, Effect.NOTHING, a, None)


def test_modes_need_and_allow_what_the_table_says() -> None:
    assert [r.mode for r in MODE_TABLE] == list(MODES) and set(MODES) == set(Mode)
    assert {mode for mode, r in MODES.items() if r.by_pilot} == {Mode.MANUAL, Mode.STABILIZE, Mode.ALT_HOLD}
    assert {mode for mode, r in MODES.items() if not r.on_request} == {Mode.DOCK}
    for mode in (Mode.POSHOLD, Mode.AUTO, Mode.GUIDED, Mode.DOCK):
        assert MODES[mode].needs == {Need.ATTITUDE, Need.POSITION}
    assert MODES[Mode.MANUAL].needs == {Need.PILOT}
    assert MODES[Mode.STABILIZE].needs == {Need.ATTITUDE, Need.PILOT}
    assert MODES[Mode.ALT_HOLD].needs == {Need.ATTITUDE, Need.DEPTH}
    assert MODES[Mode.SURFACE].needs == MODES[Mode.MOTOR_DETECT].needs == frozenset()
