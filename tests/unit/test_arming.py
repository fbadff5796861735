"""Arming checks: each alone, with its text and its boundary; which of them forced arming skips; and what each mode needs."""

import dataclasses
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from firmware_py.core.arming import CHECKS, Question, against_arming, missing
from firmware_py.core.body import axes_without_thrust
from firmware_py.core.failsafes import Failsafes
from firmware_py.core.health import NEVER_S, Health
from firmware_py.core.module_reports import ModuleReports
from firmware_py.core.names import Place
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, DockRequest, Mode, Request
from firmware_py.description.failsafe_parameters import Fence
from firmware_py.description.parameters import Limiter, Parameters
from firmware_py.description.vehicle_file import load_vehicle, vehicle_names
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.healths import BLIND, GOOD, UPRIGHT
from tests.unit.tanks import Tank

P = Parameters()
PLACED = (Mode.POSHOLD, Mode.AUTO, Mode.GUIDED, Mode.DOCK)


def reasons(health: Health = GOOD, mode: Mode = Mode.POSHOLD, forced: bool = False, **more: Any) -> list[str]:
    parameters = more.pop("parameters", P)
    failsafes = more.pop("failsafes", Failsafes(parameters.failsafes))
    return against_arming(Question(health, mode, parameters, failsafes, more.pop("estop_age_ms", NEVER_S)), forced)


def above(value: float) -> float:
    return math.nextafter(value, math.inf)


@pytest.mark.parametrize("mode", Mode, ids=lambda mode: mode.name)
@pytest.mark.parametrize("forced", [False, True])
def test_healthy_robot_may_be_armed_in_every_mode(mode: Mode, forced: bool) -> None:
    assert reasons(mode=mode, forced=forced) == []


HARD: list[tuple[Health, str]] = [
    (GOOD._replace(silent=(1,)), "module 2 does not answer"),
    (GOOD._replace(silent=(1, 4)), "module 2, 5 does not answer"),
    (GOOD._replace(silent=(1,), late=(1,)), "module 2 answers too late, or for another tick"),
    (BLIND, "no pose yet"),
    (GOOD._replace(pilot_age_s=0.5, stick=0.04), "sticks are not neutral"),
    (GOOD._replace(warm=False), "compiled code is not warm yet"),
    (GOOD._replace(tag_age_s=8.1), "no tag for 8.1 s"),
]
SOFT: list[tuple[Health, str]] = [
    (GOOD._replace(tag_age_s=0.6), "pose is 600 ms old, 500 permitted"),
    (GOOD._replace(sigma_m=0.06), "pose sigma 60 mm, 50 permitted"),
    (GOOD._replace(sigma_m=math.nan), "pose sigma nan mm, 50 permitted"),
    (GOOD._replace(nis_ratio=math.nan), "sensors and model disagree: nan of the expected, 5.0 permitted"),
    (GOOD._replace(battery_age_s=NEVER_S), "battery was not heard of lately"),
    (GOOD._replace(cabin_age_s=NEVER_S), "cabin was not heard of lately"),
    (GOOD._replace(nis_ratio=6.0), "sensors and model disagree: 6.0 of the expected, 5.0 permitted"),
    (GOOD._replace(rejected_share=0.91), "tags refused: 91% of them, 80% permitted"),
    (GOOD._replace(unfit=(0, 2)), "module 1, 3 starts, hears no commands, or has a fault"),
    (GOOD._replace(esc_missing=(Place(0, 0), Place(0, 7))), "ESC 1, 8 of module 1 does not answer"),
    (GOOD._replace(esc_unknown=(Place(2, 6), Place(2, 7))), "ESC 7, 8 of module 3 answers, but the vehicle file has no thruster there"),
    (GOOD._replace(lost_axes=1), "the thrusters left cannot make every wrench"),
    (GOOD._replace(without_thrust=("pitch",)), "pitch has no thrust: declare it in passive_dof of the vehicle file, or add thrusters"),
    (GOOD._replace(frame_errors_per_s=21.0), "21 bad frames a second, 20 permitted"),
    (GOOD._replace(bus_load=0.93), "bus is 93% full, 80% permitted"),
    (GOOD._replace(open_joints=(DockRequest(2, 0, 1, 1),)), "modules 2 and 3 do not hold together"),
    (GOOD._replace(open_joints=(DockRequest(2, 0, 1, 1),) * 3), "modules 2 and 3 do not hold together, and 2 more pairs"),
]


@pytest.mark.parametrize(("health", "words"), HARD, ids=[words for _, words in HARD])
def test_check_that_no_force_passes_over(health: Health, words: str) -> None:
    assert words in reasons(health)
    assert words in "; ".join(reasons(health, forced=True))


@pytest.mark.parametrize(("health", "words"), SOFT, ids=[words for _, words in SOFT])
def test_check_that_force_passes_over(health: Health, words: str) -> None:
    assert reasons(health) == [words]
    assert reasons(health, forced=True) == []


def test_e_stop_is_never_passed_over() -> None:
    for forced in (False, True):
        assert reasons(estop_age_ms=199.999, forced=forced) == ["e-stop raised"]
        assert reasons(estop_age_ms=200.0, forced=forced) == []
        assert reasons(GOOD._replace(stopped=(1,)), estop_age_ms=1e4, forced=forced) == ["an e-stop holds module 2"]


def test_robot_that_has_an_e_stop_box_is_armed_once_the_box_was_heard() -> None:
    boxed = replace(P, supervision=replace(P.supervision, estop_box=1))
    assert reasons(GOOD, parameters=boxed) == ["no e-stop box was heard"]
    assert reasons(GOOD, parameters=boxed, forced=True) == reasons(GOOD) == []
    assert reasons(GOOD._replace(estop_box_age_s=4.0), parameters=boxed) == []


def test_active_fail_safe_hinders_arming_and_force_passes_over_it() -> None:
    failsafes = Failsafes(replace(P.failsafes, leak_delay_s=0.0, cabin_hot_delay_s=0.0))
    wet = GOOD._replace(leak=True, cabin_c=75.0)
    failsafes.step(wet, Mode.POSHOLD, False, False)
    assert reasons(wet, failsafes=failsafes) == ["water in a cabin", "cabin hot: 75 degC"]
    assert reasons(wet, failsafes=failsafes, forced=True) == []


def test_parameters_out_of_range_are_never_passed_over() -> None:
    wrong = replace(P, limiter=replace(Limiter(), force_share=1.5, relay_on_s=0.0))
    for forced in (False, True):
        assert reasons(parameters=wrong, forced=forced) == [
            "parameter limiter.force_share: 1.5 is out of range; permitted: 0.05 to 1",
            "parameter limiter.relay_on_s: 0.0 is out of range; permitted: 1 to 3600 s",
        ]


def test_robot_whose_fence_is_upside_down_is_never_armed() -> None:
    for forced in (False, True):
        words = "fence.top_m is 50, fence.bottom_m 50: the top must be at less depth"
        assert reasons(parameters=replace(P, fence=Fence(top_m=50.0)), forced=forced) == [words]
        assert reasons(parameters=replace(P, fence=Fence(top_m=49.9)), forced=forced) == []


@pytest.mark.parametrize("loop", ["position", "attitude"])
@pytest.mark.parametrize(("bandwidth", "damping", "holds"), [
    (2.5, 0.14, False), (2.5, 0.16, True), (8.0, 0.3, False), (8.0, 0.5, True), (8.0, 3.1, True), (8.0, 3.15, False), (8.0, 5.0, False),
    (5.0, 0.3, True), (5.0, 5.0, True),
])  # fmt: skip
def test_robot_whose_loop_would_swing_is_never_armed(loop: str, bandwidth: float, damping: float, holds: bool) -> None:
    """Flown: 8 rad/s swings at damping ratios of 0.3 and 5, and holds at 0.5 and 3."""
    swinging = P.replace(f"control.{loop}_bandwidth", bandwidth).replace(f"control.{loop}_damping", damping)
    for forced in (False, True):
        found = reasons(parameters=swinging, forced=forced)
        assert len(found) == (not holds) and all(words.startswith(f"control.{loop}_damping is {damping:g}") for words in found)


@pytest.mark.parametrize("loop", ["position", "attitude"])
@pytest.mark.parametrize(("bandwidth", "slew", "holds"), [(10.0, 20.0, False), (10.0, 50.0, True), (5.0, 20.0, False), (5.0, 25.0, True)])
def test_robot_whose_thrusters_are_slower_than_its_gains_is_never_armed(loop: str, bandwidth: float, slew: float, holds: bool) -> None:
    """Flown: at 10 rad/s a hover is lost with 20 N/s and holds with 30."""
    sluggish = replace(P, limiter=Limiter(slew_n_per_s=slew)).replace(f"control.{loop}_bandwidth", bandwidth)
    for forced in (False, True):
        found = reasons(parameters=sluggish, forced=forced)
        assert len(found) == (not holds) and all(words.startswith(f"limiter.slew_n_per_s is {slew:g}") for words in found)
        assert all(words.endswith(f"at least {5.0 * bandwidth:g} N/s permitted") for words in found)


def test_robot_that_could_not_notice_a_joint_without_current_is_never_armed() -> None:
    words = "the hysteresis must be smaller, or no current would tell that a joint opens"
    for threshold_ma, hysteresis_ma, holds in ((70.0, 70.0, False), (70.0, 69.0, True), (10.0, 15.0, False)):
        deaf = replace(P, docking=replace(P.docking, current_threshold_ma=threshold_ma, current_hysteresis_ma=hysteresis_ma))
        for forced in (False, True):
            found = reasons(parameters=deaf, forced=forced)
            assert len(found) == (not holds) and all(reason.endswith(words) for reason in found)


def test_checks_are_named_and_their_order_is_that_of_the_reasons() -> None:
    assert [check.name for check in CHECKS if not check.may_be_skipped] == [
        "e-stop clear", "modules answer", "mode has what it needs", "sticks neutral", "parameters valid", "compiled code warm",
    ]  # fmt: skip
    assert [check.name for check in CHECKS if check.may_be_skipped] == [
        "e-stop box heard", "pose fresh", "pose sure", "pose consistent", "battery and cabin known",
        "modules fit", "every ESC answers", "no ESC without a thruster", "every axis has thrust", "no fail-safe on",
        "few bad frames", "bus not full", "topology as configured",
    ]  # fmt: skip
    both = GOOD._replace(silent=(2,), tag_age_s=0.7)
    assert reasons(both) == ["module 3 does not answer", "pose is 700 ms old, 500 permitted"]


BOUNDARIES = [
    ("tag_age_s", 0.5), ("sigma_m", 0.05), ("nis_ratio", 5.0), ("rejected_share", 0.8), ("frame_errors_per_s", 20.0), ("bus_load", 0.8),
    ("cabin_age_s", 2.0),
]  # fmt: skip


@pytest.mark.parametrize(("field", "limit"), BOUNDARIES)
def test_check_fails_just_beyond_its_limit(field: str, limit: float) -> None:
    there, beyond = GOOD._replace(**{field: limit}), GOOD._replace(**{field: above(limit)})
    assert len(reasons(beyond)) == len(reasons(there)) + 1


def test_lost_pose_is_said_once() -> None:
    """The reasons do not also say that the pose is old or uncertain."""
    assert reasons(GOOD._replace(tag_age_s=8.0)) == ["pose is 8000 ms old, 500 permitted"]
    assert reasons(GOOD._replace(tag_age_s=above(8.0), sigma_m=9.0)) == ["no tag for 8.0 s"]


def test_same_words_of_a_check_and_a_fail_safe_are_said_once() -> None:
    failsafes = Failsafes(replace(P.failsafes, axis_lost_delay_s=0.0))
    lame = GOOD._replace(lost_axes=1)
    failsafes.step(lame, Mode.POSHOLD, False, False)
    assert reasons(lame, failsafes=failsafes) == ["the thrusters left cannot make every wrench"]


def test_fail_safe_whose_cause_is_gone_says_what_the_cause_was() -> None:
    failsafes = Failsafes(replace(P.failsafes, cabin_pressure_delay_s=0.0))
    failsafes.step(GOOD._replace(cabin_change_pa=25000.0), Mode.POSHOLD, False, True)
    alarms = failsafes.step(GOOD._replace(cabin_change_pa=25000.0), Mode.POSHOLD, False, True)
    assert alarms == []
    assert reasons(GOOD, failsafes=failsafes) == ["cabin pressure off by 25000 Pa"]


def test_sticks_count_while_they_are_fresh_and_beyond_the_dead_zone() -> None:
    dead = P.steering.stick_dead
    assert reasons(GOOD._replace(pilot_age_s=0.5, stick=dead)) == []
    assert reasons(GOOD._replace(pilot_age_s=0.5, stick=above(dead))) == ["sticks are not neutral"]
    assert reasons(GOOD._replace(pilot_age_s=above(0.5), stick=1.0)) == []
    assert reasons(GOOD._replace(pilot_age_s=math.nan, stick=1.0)) == []


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode not in PLACED], ids=lambda mode: mode.name)
def test_mode_without_a_place_asks_for_no_good_pose(mode: Mode) -> None:
    assert reasons(GOOD._replace(tag_age_s=4.0, sigma_m=9.0, nis_ratio=50.0), mode) == []


@pytest.mark.parametrize("mode", PLACED, ids=lambda mode: mode.name)
def test_mode_with_a_place_asks_for_a_good_pose(mode: Mode) -> None:
    assert len(reasons(GOOD._replace(tag_age_s=4.0, sigma_m=9.0, nis_ratio=50.0), mode)) == 3


def test_limits_are_those_of_the_parameters() -> None:
    loose = P.replace("supervision.arm_sigma_m", 0.6).replace("supervision.tag_fresh_ms", 2000.0)
    assert reasons(GOOD._replace(sigma_m=0.6, tag_age_s=2.0), parameters=loose) == []
    assert reasons(GOOD._replace(sigma_m=2.0, tag_age_s=2.5), parameters=loose) == [
        "pose is 2500 ms old, 2000 permitted", "pose sigma 2000 mm, 600 permitted",
    ]  # fmt: skip


def test_robot_that_never_had_a_pose_hears_that_once() -> None:
    assert reasons(BLIND) == ["no pose yet"]


@pytest.mark.parametrize(
    ("health", "why"), [(BLIND, "no pose yet"), (UPRIGHT, "no pose yet"), (GOOD._replace(tag_age_s=30.0), "no tag for 30.0 s")]
)
def test_robot_whose_tags_come_too_seldom_to_tell_its_place_says_so(health: Health, why: str) -> None:
    assert missing(Mode.POSHOLD, health._replace(tag_gap_s=1.5), P) == [f"{why}: tags come 1.50 s apart, 1.00 s permitted to tell a place"]
    assert missing(Mode.POSHOLD, health._replace(tag_gap_s=1.0), P) == [why]


# ---------------------------------------------------------------- what each mode needs


@pytest.mark.parametrize("mode", Mode, ids=lambda mode: mode.name)
def test_mode_needs_what_it_steers_by(mode: Mode) -> None:
    blind = BLIND._replace(depth_age_s=6.0)
    expected = {
        Mode.STABILIZE: ["no pose yet"], Mode.ALT_HOLD: ["no pose yet", "depth unknown"],
        **{key: ["no pose yet"] for key in PLACED},
    }  # fmt: skip
    assert missing(mode, blind, P) == expected.get(mode, [])
    assert missing(mode, UPRIGHT, P) == (["no pose yet"] if mode in PLACED else [])
    deaf = UPRIGHT._replace(depth_heard=False, depth_age_s=1.0)
    assert missing(mode, deaf, P) == (["no pose yet"] if mode in PLACED else ["depth unknown"] if mode == Mode.ALT_HOLD else [])
    lost = GOOD._replace(tag_age_s=above(8.0), depth_age_s=above(5.0))
    expected = {Mode.ALT_HOLD: ["depth unknown"], **{key: ["no tag for 8.0 s"] for key in PLACED}}
    assert missing(mode, lost, P) == expected.get(mode, [])
    nearly = GOOD._replace(tag_age_s=8.0, depth_age_s=5.0)
    assert missing(mode, nearly, P) == []


@pytest.mark.parametrize("mode", Mode, ids=lambda mode: mode.name)
def test_sticks_steer_while_the_pilot_is_there(mode: Mode) -> None:
    gone = ["pilot input lost"] if mode in (Mode.MANUAL, Mode.STABILIZE) else []
    assert missing(mode, GOOD._replace(pilot_age_s=above(1.0)), P) == gone
    assert missing(mode, GOOD._replace(pilot_age_s=math.nan), P) == [], "whoever was never heard is waited for, with neutral sticks"
    assert missing(mode, GOOD._replace(pilot_age_s=1.0), P) == []


def tank_of(name: str, **changes: Any) -> Tank:
    """A vehicle whose pose is known; those without tags get a BlueROV2's."""
    vehicle = load_vehicle(name)
    tank = Tank([assemble_vehicle(dataclasses.replace(vehicle, tag=vehicle.tag or load_vehicle("bluerov2").tag, **changes))])
    tank.run(3.0)
    return tank


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bluerov2", "girona500", "modcube"])
def test_shipped_vehicle_that_declares_its_passive_axis_is_armed(name: str) -> None:
    assert tank_of(name).run(0.1, Request(Action.ARM)).records[0].state == State.ARMED


@pytest.mark.slow
@pytest.mark.parametrize(("name", "axis"), [("bluerov2", "pitch"), ("girona500", "roll")])
def test_vehicle_with_an_axis_that_nothing_pushes_or_rights_is_not_armed(name: str, axis: str) -> None:
    tank = tank_of(name, passive_dof=())
    outputs = tank.run(0.1, Request(Action.ARM))
    assert outputs.records[0].state == State.DISARMED
    assert tank.pipeline.formation.pipelines[0].health.now.without_thrust == (axis,)
    assert any(f"{axis} has no thrust: declare it" in event.text for made in tank.outputs for event in made.events)


@pytest.mark.parametrize("name", vehicle_names())
def test_no_shipped_vehicle_lacks_thrust(name: str) -> None:
    body = assemble_vehicle(load_vehicle(name))
    assert axes_without_thrust(body.thrusters.matrix, body.passive) == ()


def test_modules_whose_battery_and_cabin_are_unknown_are_named_in_a_body_of_several() -> None:
    """Regression: of four docked modules it was said that the battery was not heard of, and not which."""
    reports = ModuleReports([0, 2, 5])
    permitted_ns = round(P.failsafes.battery_unknown_limit * 1e9)
    reports.battery_ns |= {0: GOOD.time_ns, 2: GOOD.time_ns - permitted_ns - 1, 5: GOOD.time_ns - permitted_ns}
    reports.cabin_ns |= {0: GOOD.time_ns}
    found = reasons(GOOD._replace(battery_age_s=NEVER_S, cabin_age_s=NEVER_S, reports=reports))
    assert found == ["battery of module 3 was not heard of lately", "cabin of module 3, 6 was not heard of lately"]


def test_every_axis_that_lacks_thrust_is_named_once_and_only_those() -> None:
    matrix = np.zeros((6, 3))
    matrix[0] = [1.0, 1.0, 0.0]
    matrix[5] = [0.1, -0.1, 0.0]
    matrix[2, 2] = 1.0
    assert axes_without_thrust(matrix, ()) == (1, 3, 4)
    assert axes_without_thrust(matrix, (3, 4)) == (1,)
    assert axes_without_thrust(matrix, (1, 3, 4)) == ()
