"""The supervisor runs its table: every row, every trigger without one, every refusal in its words, and what fail-safes make of the mode."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from firmware_py.core.failsafes import Level
from firmware_py.core.health import Health
from firmware_py.core.setpoint import rest_at
from firmware_py.core.supervisor import CRITICAL, INFORMATION, WARNING, Decision, Supervisor
from firmware_py.core.transitions import ARMED, ROWS, TABLE, TRIGGERS, Effect, Guard, State, Transition, Trigger
from firmware_py.core.types import Action, DockRequest, Event, Mode, Request, Sticks
from firmware_py.description.parameters import Parameters
from tests.unit.healths import BLIND, GOOD, UPRIGHT, at

P = Parameters()
HERE = rest_at(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0, 0.0]))
STICKS = Sticks((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
DOCK = DockRequest(0, 0, 1, 1)


class Path:
    duration_s = 2.0

    def sample(self, t_s: float) -> Any:
        return HERE


PATH = Path()
ARGUMENTS: dict[Action, Any] = {
    Action.SET_MODE: Mode.AUTO, Action.STICKS: STICKS, Action.SET_POINT: HERE, Action.TRACK: PATH, Action.DOCK: DOCK,
    Action.UNDOCK: DOCK, Action.MOTOR_TEST: (0, 0.1, 1.0),
}  # fmt: skip
REQUESTS = {trigger: Request(action, 0, ARGUMENTS.get(action)) for action, trigger in TRIGGERS.items()} | {
    Trigger.FORCED_ARM: Request(Action.ARM, 0, True)
}
"""A request for each trigger that comes by one."""


def supervisor_in(state: State = State.ARMED, mode: Mode = Mode.POSHOLD, parameters: Parameters = P) -> Supervisor:
    supervisor = Supervisor(parameters)
    supervisor.state, supervisor.mode = state, mode
    return supervisor


def ask(supervisor: Supervisor, action: Action, argument: Any = None, health: Health = GOOD) -> list[Decision]:
    return supervisor.step(False, health, [Request(action, 0, argument)])


def texts(supervisor: Supervisor) -> list[str]:
    return [event.text for event in supervisor.events]


# ---------------------------------------------------------------- running the table


@pytest.mark.parametrize("r", [r for r in TABLE if r.trigger in REQUESTS], ids=lambda r: f"{r.state.name}-{r.trigger.name}")
def test_every_requested_row_leads_where_it_says(r: Transition) -> None:
    before = Mode.MOTOR_DETECT if r.guard == Guard.IN_MOTOR_DETECT else Mode.POSHOLD
    supervisor = supervisor_in(r.state, before)
    request = REQUESTS[r.trigger]
    (decision,) = supervisor.step(False, GOOD, [request])
    mode = Mode.AUTO if r.trigger == Trigger.SET_MODE else r.mode if r.mode is not None else before
    assert decision == Decision(r.trigger, r.effect, mode, request.argument)
    assert (supervisor.state, supervisor.mode) == (r.next_state, mode)
    assert supervisor.armed == (r.next_state in ARMED)
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
        assert ask(supervisor, Action.ARM, argument, GOOD._replace(esc_missing=(0,))) == []
        assert texts(supervisor) == ["ARM refused: ESC 1 does not answer"]
    supervisor = supervisor_in(State.DISARMED)
    assert ask(supervisor, Action.ARM, True, GOOD._replace(esc_missing=(0,))) and supervisor.armed


def test_all_reasons_are_named_at_once() -> None:
    supervisor = supervisor_in(State.DISARMED)
    ask(supervisor, Action.ARM, True, GOOD._replace(silent=(1,), warm=False))
    assert texts(supervisor) == ["FORCED_ARM refused: module 1 does not answer; compiled code is not warm yet"]


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
    ask(supervisor, Action.CLEAR_ESTOP)
    assert not supervisor.raises_estop and supervisor.state == State.DISARMED


def test_e_stop_is_cleared_when_the_bus_has_been_quiet() -> None:
    supervisor = supervisor_in()
    supervisor.step(True, GOOD, [Request(Action.ESTOP)])
    almost = at(GOOD, 0.2)
    assert ask(supervisor, Action.CLEAR_ESTOP, None, almost._replace(time_ns=almost.time_ns - 1)) == []
    assert texts(supervisor) == ["CLEAR_ESTOP refused: the e-stop is still raised"] and supervisor.raises_estop
    assert ask(supervisor, Action.CLEAR_ESTOP, None, almost) and supervisor.state == State.DISARMED


def test_robot_does_not_arm_while_an_e_stop_was_just_heard() -> None:
    supervisor = supervisor_in(State.ARMED)
    supervisor.step(True, GOOD, [])
    ask(supervisor, Action.CLEAR_ESTOP, None, at(GOOD, 0.3))
    supervisor.step(False, at(GOOD, 0.3), [Request(Action.ARM, 0, True)])
    assert supervisor.armed


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
    """No test runs before the tick in which one is asked for, and a dock that is over is not the next one."""
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


# ---------------------------------------------------------------- fail-safes


QUICK = replace(
    P,
    failsafes=replace(
        P.failsafes, leak_delay_s=0.0, battery_low_delay_s=0.0, cabin_hot_delay_s=0.0, cabin_hot_action=5, module_silent_delay_s=0.0
    ),
)


def test_fail_safe_that_is_on_is_known_by_its_name() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    assert not supervisor.is_on("leak")
    supervisor.step(False, GOOD._replace(leak=True), [])
    assert supervisor.is_on("leak") and not supervisor.is_on("partner_lost")


def test_leak_brings_the_robot_up() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    (decision,) = supervisor.step(False, GOOD._replace(leak=True), [])
    assert decision == Decision(Trigger.FAILSAFE_SURFACE, Effect.ENTER_MODE, Mode.SURFACE)
    assert (supervisor.mode, supervisor.level) == (Mode.SURFACE, Level.SURFACE)
    assert supervisor.events == [
        Event(CRITICAL, "fail-safe on: water in a cabin"), Event(INFORMATION, "ARMED AUTO -> ARMED SURFACE"),
    ]  # fmt: skip
    assert supervisor.step(False, at(GOOD._replace(leak=True), 1), []) == [] == supervisor.events


def test_pilot_takes_over_and_keeps_it_while_the_leak_lasts() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    wet = GOOD._replace(leak=True)
    supervisor.step(False, wet, [])
    ask(supervisor, Action.SET_MODE, Mode.MANUAL, at(wet, 1))
    assert (supervisor.mode, supervisor.level) == (Mode.MANUAL, Level.NONE)
    assert supervisor.step(False, at(wet._replace(voltage_share=0.85), 2), []) == [], "a warning takes nothing away"
    (decision,) = supervisor.step(False, at(wet._replace(silent_s=1.0), 3), [])
    assert decision.mode == Mode.SURFACE, "but the next fail-safe does, to where the gravest leads"


def test_milder_fail_safe_does_not_undo_a_graver() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    supervisor.step(False, GOOD._replace(leak=True), [])
    assert supervisor.step(False, at(GOOD._replace(leak=True, silent_s=1.0), 1), []) == []
    assert supervisor.events == [Event(WARNING, "fail-safe on: a module is silent for 1.0 s")]
    assert supervisor.mode == Mode.SURFACE


def test_graver_fail_safe_goes_on_from_a_milder() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    supervisor.step(False, GOOD._replace(silent_s=1.0), [])
    assert (supervisor.mode, supervisor.level) == (Mode.POSHOLD, Level.HOLD)
    supervisor.step(False, at(GOOD._replace(silent_s=1.0, leak=True), 1), [])
    assert (supervisor.mode, supervisor.level) == (Mode.SURFACE, Level.SURFACE)


def test_warning_changes_nothing_but_is_said() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    assert supervisor.step(False, GOOD._replace(voltage_share=0.85), []) == []
    assert supervisor.events == [Event(WARNING, "fail-safe on: battery low: 85% of its voltage")]
    supervisor.step(False, at(GOOD, 1), [])
    supervisor.step(False, at(GOOD, 3), [])
    assert supervisor.events == [Event(INFORMATION, "fail-safe over: battery low: 100% of its voltage")]


def test_end_of_a_fail_safe_changes_no_mode() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    supervisor.step(False, GOOD._replace(silent_s=1.0), [])
    supervisor.step(False, at(GOOD, 1), [])
    assert supervisor.step(False, at(GOOD, 4), []) == [] and supervisor.mode == Mode.POSHOLD


def test_end_of_one_fail_safe_does_not_wake_another() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    both = GOOD._replace(leak=True, silent_s=1.0)
    supervisor.step(False, both, [])
    ask(supervisor, Action.SET_MODE, Mode.MANUAL, at(both, 1))
    supervisor.step(False, at(GOOD._replace(leak=True), 2), [])
    assert supervisor.step(False, at(GOOD._replace(leak=True), 5), []) == [] and supervisor.mode == Mode.MANUAL


SPELLS = {
    "no tag": (Mode.GUIDED, "tag_age_s", 1.1, Mode.POSHOLD),
    "module silent": (Mode.GUIDED, "silent_s", 0.6, Mode.POSHOLD),
    "pilot silent": (Mode.MANUAL, "pilot_age_s", 1.1, Mode.POSHOLD),
    "outside the fence": (Mode.GUIDED, "outside_m", 0.1, Mode.POSHOLD),
    "leak": (Mode.ALT_HOLD, "leak", True, Mode.SURFACE),
}
"""A mode, what goes wrong in it, and where its fail-safe leads."""


@pytest.mark.parametrize("spell", SPELLS)
def test_cause_that_was_gone_for_a_moment_acts_again_on_a_robot_that_was_taken_back_meanwhile(spell: str) -> None:
    mode, figure, value, leads_to = SPELLS[spell]
    supervisor = supervisor_in(mode=mode)
    bad = GOOD._replace(**{figure: value})
    for tick in range(60):
        supervisor.step(False, at(bad, 0.01 * tick), [])
    assert supervisor.mode == leads_to
    ask(supervisor, Action.SET_MODE, mode, at(GOOD, 0.6))
    assert (supervisor.mode, supervisor.level) == (mode, Level.NONE)
    said = []
    for tick in range(60):
        supervisor.step(False, at(bad, 0.61 + 0.01 * tick), [])
        said += texts(supervisor)
    assert supervisor.mode == leads_to and said[0].startswith("fail-safe on: ")


def test_cause_that_comes_and_goes_is_said_once_while_it_takes_the_robot_from_nobody() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    said = []
    for tick in range(100):
        supervisor.step(False, at(GOOD._replace(silent_s=1.0 * (tick % 2)), 0.01 * tick), [])
        said += texts(supervisor)
    assert said == ["fail-safe on: a module is silent for 1.0 s", "ARMED AUTO -> ARMED POSHOLD"]


@pytest.mark.parametrize(
    ("figure", "value"),
    [("silent_s", 1.0), ("ground_age_s", 6.0), ("imu_age_s", 1.0), ("lost_axes", 1), ("leak", True), ("outside_m", 9.0)],
)
@pytest.mark.parametrize("base", [GOOD, UPRIGHT, BLIND], ids=["placed", "upright", "blind"])
def test_fail_safe_during_a_motor_test_disarms(base: Health, figure: str, value: float) -> None:
    """The robot may lie on a bench, with hands near its propellers."""
    supervisor = supervisor_in(State.DISARMED)
    ask(supervisor, Action.MOTOR_TEST, (0, 0.1, 10.0), base)
    assert supervisor.armed
    for tick in range(400):
        supervisor.step(False, at(base._replace(**{figure: value}), 0.01 * tick), [])
    ended = (State.ARMED, Mode.MOTOR_DETECT) if figure == "outside_m" else (State.DISARMED, Mode.POSHOLD)
    assert (supervisor.state, supervisor.mode) == ended


@pytest.mark.parametrize("rest", ["e-stop", "ESTOP", "DISARM"])
def test_body_that_comes_to_rest_keeps_no_mode_that_no_person_chose(rest: str) -> None:
    """Armed again it would dock, surface or turn every thruster, without a pose and without being asked."""

    def after(supervisor: Supervisor, health: Health = GOOD) -> Mode:
        supervisor.step(rest == "e-stop", health, [] if rest == "e-stop" else [Request(Action[rest], 0, None)])
        assert not supervisor.armed
        return supervisor.mode

    testing, surfacing = supervisor_in(State.DISARMED), supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    ask(testing, Action.MOTOR_TEST, (0, 0.1, 10.0))
    surfacing.step(False, GOOD._replace(leak=True), [])
    assert surfacing.mode == Mode.SURFACE
    assert [after(each) for each in (testing, surfacing, supervisor_in(mode=Mode.DOCK))] == [Mode.POSHOLD] * 3
    chosen = (Mode.MANUAL, Mode.SURFACE, Mode.MOTOR_DETECT, Mode.GUIDED)
    assert tuple(after(supervisor_in(mode=mode)) for mode in chosen) == chosen


def test_robot_that_detects_its_motors_is_disarmed_where_it_never_saw_a_tag_and_holds_where_it_has_a_pose() -> None:
    on_a_bench = State.DISARMED, Mode.MOTOR_DETECT
    for base, (state, mode) in ((BLIND, on_a_bench), (UPRIGHT, on_a_bench), (GOOD, (State.ARMED, Mode.POSHOLD))):
        supervisor = supervisor_in(State.ARMED, Mode.MOTOR_DETECT)
        supervisor.step(False, base._replace(silent_s=1.0), [])
        assert (supervisor.state, supervisor.mode) == (state, mode)


def test_other_parameters_count_from_the_next_tick_on() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO)
    supervisor.retune(replace(P, failsafes=replace(P.failsafes, module_silent_limit=20.0)))
    assert supervisor.step(False, GOOD._replace(silent_s=10.0), []) == []
    supervisor.retune(P)
    assert supervisor.step(False, at(GOOD._replace(silent_s=10.0), 1), [])[0].mode == Mode.POSHOLD
    ask(supervisor, Action.DISARM, None, at(GOOD, 2))
    supervisor.step(False, at(GOOD, 9), [])
    supervisor.retune(P.replace("supervision.arm_sigma_m", 0.001))
    assert ask(supervisor, Action.ARM, None, at(GOOD, 10)) == []
    assert texts(supervisor) == ["ARM refused: pose sigma 2 mm, 1 permitted"]


def test_sticks_alone_do_not_end_what_a_fail_safe_chose() -> None:
    supervisor = supervisor_in(mode=Mode.AUTO, parameters=QUICK)
    supervisor.step(False, GOOD._replace(leak=True), [])
    ask(supervisor, Action.STICKS, STICKS, at(GOOD._replace(leak=True), 1))
    assert (supervisor.mode, supervisor.level) == (Mode.SURFACE, Level.SURFACE)
    ask(supervisor, Action.DISARM, None, at(GOOD._replace(leak=True), 2))
    assert supervisor.level == Level.NONE


def test_fail_safe_may_disarm() -> None:
    supervisor = supervisor_in(mode=Mode.MANUAL, parameters=QUICK)
    (decision,) = supervisor.step(False, GOOD._replace(cabin_c=90.0), [])
    assert decision == Decision(Trigger.FAILSAFE_DISARM, Effect.STOP, Mode.MANUAL) and not supervisor.armed
    assert supervisor.step(False, at(GOOD._replace(cabin_c=90.0), 1), []) == []


def test_disarmed_robot_says_what_is_wrong_and_stays() -> None:
    supervisor = supervisor_in(State.DISARMED, parameters=QUICK)
    assert supervisor.step(False, GOOD._replace(leak=True), []) == []
    assert texts(supervisor) == ["fail-safe on: water in a cabin"] and supervisor.mode == Mode.POSHOLD


def test_robot_armed_by_force_is_not_taken_away_by_what_was_known() -> None:
    supervisor = supervisor_in(State.DISARMED, parameters=QUICK)
    wet = GOOD._replace(leak=True)
    supervisor.step(False, wet, [])
    (decision,) = ask(supervisor, Action.ARM, True, at(wet, 1))
    assert decision.effect == Effect.ENTER_MODE and supervisor.mode == Mode.POSHOLD
    assert supervisor.step(False, at(wet, 2), []) == []


LADDER = [
    (GOOD._replace(silent_s=1.0), Mode.POSHOLD, []),
    (GOOD._replace(silent_s=1.0, tag_age_s=8.1), Mode.ALT_HOLD, ["FAILSAFE_HOLD refused: no tag for 8.1 s"]),
    (
        GOOD._replace(silent_s=1.0, tag_age_s=8.1, depth_age_s=6.0),
        Mode.SURFACE,
        ["FAILSAFE_HOLD refused: no tag for 8.1 s", "FAILSAFE_DEPTH refused: depth unknown"],
    ),
]


@pytest.mark.parametrize(("health", "mode", "refusals"), LADDER)
def test_fail_safe_holds_as_well_as_can_be(health: Health, mode: Mode, refusals: list[str]) -> None:
    supervisor = supervisor_in(mode=Mode.MANUAL, parameters=QUICK)
    (decision,) = supervisor.step(False, health, [])
    assert decision.mode == supervisor.mode == mode
    assert [text for text in texts(supervisor) if "refused" in text] == refusals


def test_robot_without_tags_holds_then_holds_depth_then_surfaces() -> None:
    """As the issue has it: POSHOLD, then depth and attitude, then up."""
    supervisor = supervisor_in(mode=Mode.AUTO)
    seen = []
    for tenth in range(0, 400):
        health = at(GOOD._replace(tag_age_s=tenth / 10), tenth / 10)
        seen += [(tenth, decision.mode) for decision in supervisor.step(False, health, [])]
    assert seen == [(11, Mode.POSHOLD), (81, Mode.ALT_HOLD), (301, Mode.SURFACE)]


def test_pilots_depth_hold_needs_no_tags() -> None:
    supervisor = supervisor_in(mode=Mode.ALT_HOLD)
    assert supervisor.step(False, GOOD._replace(tag_age_s=100.0, pilot_age_s=0.1), []) == []


def test_depth_hold_of_a_fail_safe_that_a_pilot_takes_is_his() -> None:
    supervisor = supervisor_in(mode=Mode.POSHOLD)
    supervisor.step(False, GOOD._replace(tag_age_s=9.0), [])
    assert (supervisor.mode, supervisor.level) == (Mode.ALT_HOLD, Level.DEPTH)
    ask(supervisor, Action.SET_MODE, Mode.ALT_HOLD, at(GOOD._replace(tag_age_s=10.0), 1))
    assert supervisor.level == Level.NONE
    assert supervisor.step(False, at(GOOD._replace(tag_age_s=40.0), 31), []) == []


# ---------------------------------------------------------------- joined and parted bodies


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
    (State.DISARMED, Mode.POSHOLD, GOOD, True), (State.DISARMED, Mode.POSHOLD, GOOD._replace(esc_missing=(3,)), False),
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
    """Whoever chose it: a robot on its way up is not made to hold its place."""
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
