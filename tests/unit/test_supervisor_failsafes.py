"""Fail-safes and the mode: which one acts, what is permitted meanwhile, what recurs, and what is reported."""

from dataclasses import replace

import pytest

from firmware_py.core.failsafes import Level
from firmware_py.core.health import Health
from firmware_py.core.module_reports import ModuleReports
from firmware_py.core.supervisor import Decision, Supervisor
from firmware_py.core.transitions import Effect, State, Trigger
from firmware_py.core.types import CRITICAL, INFORMATION, WARNING, Action, Event, Mode, Request
from tests.unit.healths import BLIND, GOOD, UPRIGHT, at
from tests.unit.supervisors import DOCK, QUICK, STICKS, P, ask, supervisor_in, texts


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


@pytest.mark.parametrize(
    ("bad", "against"),
    [
        (
            GOOD._replace(open_joints=(DOCK,)),
            {Action.DOCK: "a docked partner is lost", Action.UNDOCK: ""},
        ),
        (
            GOOD._replace(open_joints=(DOCK._replace(module=2),)),
            {Action.DOCK: "a docked partner is lost", Action.UNDOCK: "a docked partner is lost"},
        ),
        (GOOD._replace(leak=True), {Action.DOCK: "water in a cabin", Action.UNDOCK: "water in a cabin"}),
        (BLIND, {Action.DOCK: "no pose yet", Action.UNDOCK: "no pose yet"}),
    ],
)
def test_lost_partner_keeps_from_docking_and_not_from_letting_it_go(bad: Health, against: dict[Action, str]) -> None:
    for action, why in against.items():
        supervisor = supervisor_in(mode=Mode.POSHOLD, parameters=QUICK)
        decisions = ask(supervisor, action, DOCK, bad)
        refusals = [text for text in texts(supervisor) if text.startswith(f"{action.name} refused: {why}")]
        assert len(refusals) == 1 if why else decisions[0].mode == Mode.DOCK


def test_fail_safe_that_spreads_to_another_module_takes_the_robot_again() -> None:
    supervisor, reports = supervisor_in(mode=Mode.AUTO, parameters=QUICK), ModuleReports([0, 1])
    wet = GOOD._replace(leak=True, reports=reports)
    reports.leak[0] = True
    supervisor.step(False, wet, [])
    ask(supervisor, Action.SET_MODE, Mode.MANUAL, at(wet, 1))
    reports.leak[1] = True
    assert [decision.trigger for decision in supervisor.step(False, at(wet, 2), [])] == [Trigger.FAILSAFE_SURFACE]
    assert texts(supervisor) == ["fail-safe on: water in a cabin (module 1, 2)", "ARMED MANUAL -> ARMED SURFACE"]
    assert supervisor.step(False, at(wet, 3), []) == [] == supervisor.events


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
    assert supervisor.events == [Event(INFORMATION, "fail-safe over: battery low")]


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
"""A mode, the health figure that goes wrong in it and its value, and the mode that the fail-safe enters."""


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
    """Armed again in such a mode, it would dock, surface or turn every thruster, unasked and without a pose."""

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
    """As the issue specifies: POSHOLD, then depth and attitude, then up."""
    supervisor = supervisor_in(mode=Mode.AUTO)
    seen = []
    for tenth in range(0, 400):
        health = at(GOOD._replace(tag_age_s=tenth / 10), tenth / 10)
        seen += [(tenth, decision.mode) for decision in supervisor.step(False, health, [])]
    assert seen == [(11, Mode.POSHOLD), (81, Mode.ALT_HOLD), (301, Mode.SURFACE)]


def test_pilots_depth_hold_needs_no_tags() -> None:
    supervisor = supervisor_in(mode=Mode.ALT_HOLD)
    assert supervisor.step(False, GOOD._replace(tag_age_s=100.0, pilot_age_s=0.1), []) == []


@pytest.mark.parametrize(("figure", "value"), [("imu_age_s", 0.6), ("pilot_age_s", 1.1)])
def test_pilots_depth_hold_without_tags_is_his_again_when_the_fail_safe_that_kept_it_is_over(figure: str, value: float) -> None:
    """A moment without IMU or sticks once surfaced the robot 22 s later, with its pilot steering. Other fail-safes may warn meanwhile."""
    supervisor = supervisor_in(mode=Mode.ALT_HOLD)
    for tenth in range(300):
        health = (UPRIGHT._replace(**{figure: value}) if tenth < 3 else UPRIGHT)._replace(dead=(3,))
        supervisor.step(False, at(health, tenth / 10), [])
        assert supervisor.level == (Level.HOLD if tenth < 23 else Level.NONE)
    whole = supervisor_in()
    whole.take_over([supervisor])
    for robot in (supervisor, whole):
        modes = []
        for tenth in range(300, 530):
            robot.step(False, at(UPRIGHT._replace(**{figure: value}), tenth / 10), [])
            modes.append(robot.mode)
        assert modes == [Mode.ALT_HOLD] * 221 + [Mode.SURFACE] * 9, "what does not end brings it up"


def test_depth_hold_of_a_fail_safe_that_a_pilot_takes_is_his() -> None:
    supervisor = supervisor_in(mode=Mode.POSHOLD)
    supervisor.step(False, GOOD._replace(tag_age_s=9.0), [])
    assert (supervisor.mode, supervisor.level) == (Mode.ALT_HOLD, Level.DEPTH)
    ask(supervisor, Action.SET_MODE, Mode.ALT_HOLD, at(GOOD._replace(tag_age_s=10.0), 1))
    assert supervisor.level == Level.NONE
    assert supervisor.step(False, at(GOOD._replace(tag_age_s=40.0), 31), []) == []


@pytest.mark.parametrize("mode", [Mode.ALT_HOLD, Mode.STABILIZE])
def test_pilot_keeps_control_of_a_robot_that_refuses_its_tags_but_it_holds_no_place_then(mode: Mode) -> None:
    supervisor, bad = supervisor_in(mode=mode), GOOD._replace(rejected_share=0.99)
    said = []
    for tick in range(500):
        supervisor.step(False, bad._replace(time_ns=GOOD.time_ns + 10_000_000 * tick), [])
        said += texts(supervisor)
    assert said == ["fail-safe on: tags refused: 99% of them"]
    assert supervisor.mode == mode and supervisor.level == Level.NONE and not supervisor.events
    ask(supervisor, Action.SET_MODE, Mode.POSHOLD, bad._replace(time_ns=GOOD.time_ns + 5_000_000_000))
    assert supervisor.mode == mode, "refused while the cause lasts"


def test_warning_to_a_pilot_becomes_an_action_when_another_fail_safe_takes_the_mode_from_him() -> None:
    """The pilot falls silent after four seconds; the robot holds its place by tags that it refuses for no longer than the delay."""
    supervisor, bad = supervisor_in(mode=Mode.ALT_HOLD), GOOD._replace(rejected_share=0.99)
    modes = []
    for tick in range(800):
        silence_s = 0.01 * max(tick - 300, 0)
        health = bad._replace(time_ns=GOOD.time_ns + 10_000_000 * tick, pilot_age_s=silence_s)
        supervisor.step(False, health, [])
        modes.append(supervisor.mode)
    held = modes.count(Mode.POSHOLD)
    assert modes[400] == Mode.ALT_HOLD and modes[402] == Mode.POSHOLD and modes[-1] == Mode.ALT_HOLD
    assert 200 <= held <= 202, "the delay of two seconds"
    assert supervisor.level == Level.DEPTH
