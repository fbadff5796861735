"""The supervisor runs its table: every row, every trigger without a row, refusals in words, e-stop, and activities that end."""

import itertools
from dataclasses import replace

import pytest

from firmware_py.core.failsafes import Level
from firmware_py.core.names import Place
from firmware_py.core.supervisor import Decision, Supervisor
from firmware_py.core.transitions import ROWS, TABLE, Effect, Guard, State, Transition, Trigger
from firmware_py.core.types import CRITICAL, INFORMATION, WARNING, Action, Event, Mode, Request
from tests.unit.healths import BLIND, GOOD, at
from tests.unit.supervisors import DOCK, REQUESTS, STICKS, P, ask, supervisor_in, texts

# ---------------------------------------------------------------- running the table


@pytest.mark.parametrize("r", [r for r in TABLE if r.trigger in REQUESTS], ids=lambda r: f"{r.state.name}-{r.trigger.name}")
def test_every_requested_row_leads_where_it_says(r: Transition) -> None:
    before = Mode.MOTOR_DETECT if r.guard == Guard.IN_MOTOR_DETECT else Mode.POSHOLD
    supervisor = supervisor_in(r.state, before)
    request = REQUESTS[r.trigger]
    health = GOOD._replace(open_joints=(DOCK,)) if r.guard == Guard.JOINT_OPEN else GOOD
    (decision,) = supervisor.step(False, health, [request])
    mode = Mode.AUTO if r.trigger == Trigger.SET_MODE else r.mode if r.mode is not None else before
    assert decision == Decision(r.trigger, r.effect, mode, request.argument)
    assert (supervisor.state, supervisor.mode) == (r.next_state, mode)
    assert supervisor.armed == (r.next_state == State.ARMED)
    changed = (r.next_state, mode) != (r.state, before)
    words = f"{r.state.name} {before.name} -> {r.next_state.name} {mode.name}"
    assert supervisor.events == ([Event(INFORMATION, words)] if changed else [])


NO_ROW = [pair for pair in itertools.product(State, REQUESTS) if pair not in ROWS]


@pytest.mark.parametrize(("state", "trigger"), NO_ROW, ids=lambda value: value.name)
def test_every_trigger_without_a_row_is_refused_in_words(state: State, trigger: Trigger) -> None:
    supervisor = supervisor_in(state)
    assert supervisor.step(False, GOOD, [REQUESTS[trigger]]) == []
    assert supervisor.events == [Event(WARNING, f"{trigger.name} refused: not possible in {state.name}")]
    assert supervisor.state == state


@pytest.mark.parametrize("guard", [guard for guard in Guard if guard != Guard.ALWAYS], ids=lambda guard: guard.name)
def test_guard_that_does_not_hold_says_why_whatever_row_names_it(guard: Guard) -> None:
    """Two guards were obeyed only where an activity ends by itself; in any other row they would have let everything pass."""
    supervisor = supervisor_in()
    supervisor.step(True, BLIND, [])
    assert supervisor._reasons(guard, Mode.POSHOLD, BLIND, DOCK)
    assert not supervisor._reasons(Guard.ALWAYS, Mode.POSHOLD, BLIND, DOCK)


def test_robot_starts_disarmed_and_would_hold_its_place() -> None:
    supervisor = Supervisor(P)
    assert (supervisor.state, supervisor.mode, supervisor.level) == (State.DISARMED, Mode.POSHOLD, Level.NONE)
    assert not supervisor.armed and not supervisor.raises_estop and supervisor.events == []


def test_mode_chosen_while_disarmed_is_armed_in() -> None:
    supervisor = supervisor_in(State.DISARMED)
    ask(supervisor, Action.SET_MODE, Mode.MANUAL, BLIND)
    (decision,) = ask(supervisor, Action.ARM, None, BLIND)
    assert (decision.effect, decision.mode) == (Effect.ENTER_MODE, Mode.MANUAL) and supervisor.armed


def test_requests_of_one_tick_are_taken_in_order() -> None:
    supervisor = supervisor_in(State.DISARMED)
    requests = [REQUESTS[t] for t in (Trigger.TRACK, Trigger.ARM, Trigger.TRACK, Trigger.HOLD)]
    decisions = supervisor.step(False, GOOD, requests)
    assert [d.trigger for d in decisions] == [Trigger.ARM, Trigger.TRACK, Trigger.HOLD]
    assert texts(supervisor) == [
        "TRACK refused: not possible in DISARMED",
        "DISARMED POSHOLD -> ARMED POSHOLD",
        "ARMED POSHOLD -> ARMED AUTO",
        "ARMED AUTO -> ARMED POSHOLD",
    ]


def test_request_that_is_not_the_supervisors_is_passed_over() -> None:
    supervisor = supervisor_in()
    assert ask(supervisor, Action.GROUND_ALIVE) == [] == supervisor.events
    assert ask(supervisor, Action.SET_PARAMETER, ("control.lead_s", 0.1)) == [] == supervisor.events


def test_same_reason_of_several_fail_safes_is_said_once() -> None:
    patient = replace(P, failsafes=replace(P.failsafes, tag_lost_limit=40.0))
    supervisor = supervisor_in(mode=Mode.ALT_HOLD, parameters=patient)
    assert ask(supervisor, Action.SET_MODE, Mode.AUTO, GOOD._replace(tag_age_s=31.0)) == []
    assert texts(supervisor) == ["SET_MODE refused: no tag for 31.0 s"]


def test_force_is_the_word_true_alone() -> None:
    for argument in (False, 1, "yes", None):
        supervisor = supervisor_in(State.DISARMED)
        assert ask(supervisor, Action.ARM, argument, GOOD._replace(esc_missing=(Place(0, 0),))) == []
        assert texts(supervisor) == ["ARM refused: ESC 1 of module 1 does not answer"]
    supervisor = supervisor_in(State.DISARMED)
    assert ask(supervisor, Action.ARM, True, GOOD._replace(esc_missing=(Place(0, 0),))) and supervisor.armed


def test_all_reasons_are_named_at_once() -> None:
    supervisor = supervisor_in(State.DISARMED)
    ask(supervisor, Action.ARM, True, GOOD._replace(silent=(1,), warm=False))
    assert texts(supervisor) == ["FORCED_ARM refused: module 2 does not answer; compiled code is not warm yet"]


def test_mode_that_lacks_what_it_needs_is_refused() -> None:
    supervisor = supervisor_in(mode=Mode.MANUAL)
    assert ask(supervisor, Action.SET_MODE, Mode.POSHOLD, BLIND) == []
    assert texts(supervisor) == ["SET_MODE refused: no pose yet"] and supervisor.mode == Mode.MANUAL


def test_mode_is_refused_while_a_fail_safe_stands_against_it() -> None:
    supervisor = supervisor_in()
    assert ask(supervisor, Action.SET_MODE, Mode.AUTO, GOOD._replace(tag_age_s=2.0)) == []
    assert texts(supervisor) == ["SET_MODE refused: no tag for 2.0 s"]
    assert ask(supervisor, Action.SET_MODE, Mode.MANUAL, GOOD._replace(leak=True))


# ---------------------------------------------------------------- e-stop


@pytest.mark.parametrize("state", [State.DISARMED, State.ARMED])
def test_e_stop_on_the_bus_stops_the_robot_in_this_tick(state: State) -> None:
    supervisor = supervisor_in(state)
    (decision,) = supervisor.step(True, GOOD, [])
    assert decision == Decision(Trigger.ESTOP_FRAME, Effect.STOP, Mode.POSHOLD)
    assert supervisor.state == State.ESTOP and not supervisor.armed and not supervisor.raises_estop
    assert texts(supervisor) == [f"{state.name} POSHOLD -> ESTOP POSHOLD"]
    supervisor.step(True, GOOD, [])
    assert supervisor.events == [], "said once"


def test_e_stop_comes_before_any_request_of_its_tick() -> None:
    supervisor = supervisor_in(State.DISARMED)
    supervisor.step(True, GOOD, [Request(Action.ARM, 0, True)])
    assert supervisor.state == State.ESTOP


def test_requested_e_stop_is_raised_on_the_bus_until_it_is_cleared() -> None:
    supervisor = supervisor_in()
    ask(supervisor, Action.ESTOP)
    assert supervisor.raises_estop
    for action in (Action.ARM, Action.DISARM, Action.HOLD, Action.SET_MODE):
        ask(supervisor, action, Mode.AUTO if action == Action.SET_MODE else None)
        assert supervisor.raises_estop and supervisor.state == State.ESTOP
    ask(supervisor, Action.CLEAR_ESTOP, None, at(GOOD, 0.2))
    assert not supervisor.raises_estop and supervisor.state == State.DISARMED


def test_requested_e_stop_outlives_a_clear_of_the_same_tick() -> None:
    """Two people act at once, or a radio delivers both requests in one burst: the e-stop wins, and the modules hear of it."""
    supervisor = supervisor_in()
    decisions = supervisor.step(False, GOOD, [Request(Action.ESTOP), Request(Action.CLEAR_ESTOP)])
    assert [decision.trigger for decision in decisions] == [Trigger.ESTOP] and supervisor.raises_estop
    assert texts(supervisor)[-1] == "CLEAR_ESTOP refused: the e-stop is still raised"
    assert ask(supervisor, Action.CLEAR_ESTOP, None, at(GOOD, 0.2)) and not supervisor.raises_estop


def test_robot_that_raised_an_e_stop_itself_is_armed_once_its_modules_have_let_go() -> None:
    """Modules release an e-stop 200 ms after its last frame, and only if the robot is disarmed."""
    supervisor = supervisor_in()
    ask(supervisor, Action.ESTOP)
    ask(supervisor, Action.CLEAR_ESTOP, None, at(GOOD, 1.0))
    almost = at(GOOD, 1.2)
    for health, why in (
        (almost._replace(time_ns=almost.time_ns - 1), "e-stop raised"), (almost._replace(stopped=(1, 3)), "an e-stop holds module 2, 4"),
    ):  # fmt: skip
        assert ask(supervisor, Action.ARM, True, health) == [] and texts(supervisor) == [f"FORCED_ARM refused: {why}"]
        assert not supervisor.may_arm(health)
    assert ask(supervisor, Action.ARM, None, almost) and supervisor.armed


def test_module_that_heard_an_e_stop_which_the_firmware_missed_stops_the_robot() -> None:
    supervisor = supervisor_in()
    stopped = GOOD._replace(stopped=(0,))
    (decision,) = supervisor.step(False, stopped, [])
    assert decision.trigger == Trigger.ESTOP_FRAME and supervisor.state == State.ESTOP and not supervisor.raises_estop
    assert supervisor.events[0] == Event(CRITICAL, "e-stop: module 1 says that it heard one")
    assert supervisor.step(False, stopped, []) == [] and supervisor.events == [], "said once"
    assert ask(supervisor, Action.CLEAR_ESTOP, None, at(stopped, 0.1)) == []
    assert ask(supervisor, Action.CLEAR_ESTOP, None, at(stopped, 0.2)) and supervisor.state == State.DISARMED
    assert supervisor.step(False, stopped, []) == [], "a disarmed robot's modules let go by themselves"


def test_e_stop_that_was_raised_before_the_process_started_is_latched_until_a_person_clears_it() -> None:
    """The modules hold the e-stop, and release it by themselves once they hear that the robot is disarmed; that does not clear it."""
    supervisor = supervisor_in(State.DISARMED)
    stopped = GOOD._replace(stopped=(0,))
    (decision,) = supervisor.step(False, stopped, [Request(Action.ARM)])
    assert decision.trigger == Trigger.ESTOP_FRAME and supervisor.state == State.ESTOP and not supervisor.raises_estop
    let_go = at(GOOD, 1.0)
    assert ask(supervisor, Action.ARM, None, let_go) == [] and ask(supervisor, Action.ARM, True, let_go) == []
    assert ask(supervisor, Action.CLEAR_ESTOP, None, let_go) and supervisor.state == State.DISARMED
    assert ask(supervisor, Action.ARM, None, at(GOOD, 1.3)) and supervisor.armed


def test_e_stop_that_only_a_module_has_heard_is_latched_after_another_was_cleared_once_that_is_let_go() -> None:
    supervisor = supervisor_in(State.DISARMED)
    stopped = GOOD._replace(stopped=(0,))
    supervisor.step(False, stopped, [])
    assert ask(supervisor, Action.CLEAR_ESTOP, None, at(stopped, 0.2)) and supervisor.state == State.DISARMED
    for health in (at(stopped, 0.21), at(stopped, 9.0)):
        assert supervisor.step(False, health, []) == [], "its modules may take their time"
    whole = Supervisor(P)
    whole.take_over([supervisor, supervisor_in(State.DISARMED)])
    assert whole.step(False, at(stopped, 9.01), []) == [], "also in the body that they became part of"
    assert supervisor.step(False, at(GOOD, 9.01), []) == []
    whole = Supervisor(P)
    whole.take_over([supervisor])
    for robot in (supervisor, whole):
        robot.step(False, at(stopped._replace(stopped=(2, 5)), 9.02), [])
        assert texts(robot) == ["e-stop: module 3, 6 says that it heard one", "DISARMED POSHOLD -> ESTOP POSHOLD"]
        assert robot.state == State.ESTOP and ask(robot, Action.ARM, True, at(GOOD, 10.0)) == []


def test_modules_that_hear_an_e_stop_of_the_robots_own_when_it_is_cleared_do_not_raise_it_again() -> None:
    supervisor = supervisor_in()
    supervisor.step(False, GOOD, [Request(Action.ESTOP)])
    supervisor.step(False, at(GOOD, 0.2), [Request(Action.CLEAR_ESTOP)])
    for health in (at(GOOD, 0.21), at(GOOD._replace(stopped=(0,)), 0.22), at(GOOD._replace(stopped=(0,)), 0.41), at(GOOD, 0.42)):
        assert supervisor.step(False, health, []) == [] and supervisor.state == State.DISARMED


def test_e_stop_is_cleared_when_the_bus_has_been_quiet() -> None:
    supervisor = supervisor_in()
    supervisor.step(True, GOOD, [Request(Action.ESTOP)])
    almost = at(GOOD, 0.2)
    assert ask(supervisor, Action.CLEAR_ESTOP, None, almost._replace(time_ns=almost.time_ns - 1)) == []
    assert texts(supervisor) == ["CLEAR_ESTOP refused: the e-stop is still raised"] and supervisor.raises_estop
    assert ask(supervisor, Action.CLEAR_ESTOP, None, almost) and supervisor.state == State.DISARMED


@pytest.mark.parametrize("forced", [False, True])
def test_robot_does_not_arm_while_an_e_stop_was_just_heard(forced: bool) -> None:
    """Neither before the e-stop is cleared, nor by a request that clears it in the same tick."""
    supervisor, both = supervisor_in(State.ARMED), [Request(Action.CLEAR_ESTOP), Request(Action.ARM, 0, forced)]
    supervisor.step(True, GOOD, [])
    almost = at(GOOD, 0.2)
    for health in (GOOD, almost._replace(time_ns=almost.time_ns - 1)):
        assert supervisor.step(False, health, both) == [] and supervisor.state == State.ESTOP
        refused = "FORCED_ARM" if forced else "ARM"
        assert texts(supervisor) == ["CLEAR_ESTOP refused: the e-stop is still raised", f"{refused} refused: not possible in ESTOP"]
    assert len(supervisor.step(False, almost, both)) == 2 and supervisor.armed


# ---------------------------------------------------------------- endings


def test_motor_test_that_armed_the_robot_disarms_it() -> None:
    supervisor = supervisor_in(State.DISARMED)
    ask(supervisor, Action.MOTOR_TEST, (0, 0.1, 1.0))
    assert (supervisor.state, supervisor.mode) == (State.ARMED, Mode.MOTOR_DETECT)
    ask(supervisor, Action.STICKS, STICKS)
    ask(supervisor, Action.MOTOR_TEST, (1, 0.1, 1.0))
    (decision,) = supervisor.step(False, GOOD, [], [Trigger.TEST_OVER])
    assert decision == Decision(Trigger.TEST_OVER, Effect.STOP, Mode.POSHOLD)
    assert (supervisor.state, supervisor.mode) == (State.DISARMED, Mode.POSHOLD)
    assert supervisor.step(False, GOOD, [], [Trigger.TEST_OVER]) == [] == supervisor.events
    supervisor.step(False, GOOD, [Request(Action.SET_MODE, 0, Mode.MOTOR_DETECT), Request(Action.ARM)])
    assert supervisor.step(False, GOOD, [], [Trigger.TEST_OVER]) == [] and supervisor.armed


def test_motor_test_of_a_robot_armed_by_hand_leaves_it_armed() -> None:
    supervisor = supervisor_in(State.ARMED, Mode.MOTOR_DETECT)
    ask(supervisor, Action.MOTOR_TEST, (0, 0.1, 1.0))
    assert supervisor.step(False, GOOD, [], [Trigger.TEST_OVER]) == [] == supervisor.events and supervisor.armed


def test_mode_taken_during_a_motor_test_ends_it_without_disarming() -> None:
    supervisor = supervisor_in(State.DISARMED)
    ask(supervisor, Action.MOTOR_TEST, (0, 0.1, 1.0))
    ask(supervisor, Action.SET_MODE, Mode.POSHOLD)
    assert supervisor.step(False, GOOD, [], [Trigger.TEST_OVER]) == [] and supervisor.armed


@pytest.mark.parametrize(("action", "argument"), [(Action.SET_MODE, Mode.MANUAL), (Action.HOLD, None), (Action.TRACK, None)])
def test_motor_test_is_no_way_round_the_arming_checks(action: Action, argument: object) -> None:
    """A motor test skips the checks that may be skipped, as a forced ARM does, but nobody asked to fly the robot in that condition."""
    bad = GOOD._replace(frame_errors_per_s=1e6)
    supervisor = supervisor_in(State.DISARMED)
    assert ask(supervisor, Action.MOTOR_TEST, (0, 0.1, 1.0), bad) and supervisor.armed
    assert ask(supervisor, action, argument, bad) == []
    assert "bad frames" in texts(supervisor)[0]
    supervisor.step(False, bad, [], [Trigger.TEST_OVER])
    assert not supervisor.armed


def test_disarming_ends_a_motor_test() -> None:
    supervisor = supervisor_in(State.DISARMED)
    ask(supervisor, Action.MOTOR_TEST, (0, 0.1, 1.0))
    ask(supervisor, Action.DISARM)
    ask(supervisor, Action.ARM)
    assert supervisor.step(False, GOOD, [], [Trigger.TEST_OVER]) == [] and supervisor.armed


def test_motor_test_in_another_mode_is_refused() -> None:
    supervisor = supervisor_in(State.ARMED, Mode.AUTO)
    assert ask(supervisor, Action.MOTOR_TEST, (0, 0.1, 1.0)) == []
    assert texts(supervisor) == ["MOTOR_TEST refused: the mode is not MOTOR_DETECT"]


def test_what_has_ended_ends_before_what_is_asked_for_begins() -> None:
    """TEST_OVER is given while no test runs, so also in the tick that starts one; DOCK_OVER of a past dock must not end the next."""
    supervisor = supervisor_in(State.DISARMED)
    supervisor.step(False, GOOD, [Request(Action.MOTOR_TEST, 0, (0, 0.1, 1.0))], [Trigger.TEST_OVER])
    assert supervisor.armed and supervisor.mode == Mode.MOTOR_DETECT
    docking = supervisor_in(State.ARMED, Mode.DOCK)
    docking.step(False, GOOD, [Request(Action.UNDOCK, 0, DOCK)], [Trigger.DOCK_OVER])
    assert docking.mode == Mode.DOCK


def test_dock_that_has_given_up_leaves_the_robot_holding() -> None:
    supervisor = supervisor_in(State.ARMED, Mode.DOCK)
    (decision,) = supervisor.step(False, GOOD, [], [Trigger.DOCK_OVER])
    assert decision == Decision(Trigger.DOCK_OVER, Effect.ENTER_MODE, Mode.POSHOLD)
    assert supervisor.step(False, GOOD, [], [Trigger.DOCK_OVER]) == [] == supervisor.events
