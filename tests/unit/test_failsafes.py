"""Fail-safes: limit, delay, modes, action and end of each, to the nanosecond and the last bit."""

import math
from dataclasses import replace

import pytest

from firmware_py.core.failsafes import ANY, FREE, MOVING, PERMITTED, PILOTED, PLACED, TABLE, Alarm, Failsafes, Level, Row, Watch
from firmware_py.core.health import UNSEEN_S, Health
from firmware_py.core.module_reports import ModuleReports
from firmware_py.core.types import Mode
from firmware_py.description.failsafe_parameters import Failsafes as Parameters
from firmware_py.ground import mission_items
from tests.unit.failsafe_causes import FIELDS, ROWS, WORDS, YES, P, bad, quick, spoilt
from tests.unit.healths import GOOD, UPRIGHT, at

POSE_MODES = {Mode.POSHOLD, Mode.AUTO, Mode.GUIDED, Mode.DOCK}


def alarms_of(parameters: Parameters, health: Health, mode: Mode = Mode.AUTO, forced: bool = False, armed: bool = True) -> list[Alarm]:
    return Failsafes(parameters).step(health, mode, forced, armed)


def test_every_fail_safe_is_tried_here() -> None:
    assert [row.name for row in TABLE] == list(FIELDS) == list(WORDS)


def test_levels_are_numbered_as_the_parameters_say() -> None:
    assert [level.name for level in sorted(Level)] == ["NONE", "WARN", "HOLD", "DEPTH", "SURFACE", "DISARM"]
    assert [int(level) for level in Level] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("name", FIELDS)
def test_healthy_robot_has_no_alarm(name: str) -> None:
    for mode in Mode:
        assert alarms_of(quick(name), GOOD, mode) == []


@pytest.mark.parametrize("name", FIELDS)
def test_alarm_comes_just_beyond_the_limit(name: str) -> None:
    mode = next(m for m in (Mode.AUTO, Mode.MANUAL) if m in ROWS[name].modes)
    (alarm,) = alarms_of(quick(name), bad(name), mode)
    level = Level(getattr(P, f"{name}_action"))
    assert (alarm.name, alarm.level, alarm.begins) == (name, level, True)
    if name not in YES:
        assert alarms_of(quick(name), spoilt(name, getattr(P, f"{name}_limit")), mode) == []


@pytest.mark.parametrize("name", [name for name in FIELDS if name not in YES])
def test_what_is_not_known_is_no_alarm(name: str) -> None:
    assert alarms_of(quick(name), spoilt(name, math.nan), Mode.AUTO) == []
    assert alarms_of(quick(name), spoilt(name, math.nan), Mode.MANUAL) == []


def test_row_that_is_on_is_known_by_its_name_and_no_other_is() -> None:
    failsafes = Failsafes(quick("partner_lost"))
    assert not failsafes.is_on("partner_lost")
    failsafes.step(bad("partner_lost"), Mode.AUTO, False, True)
    assert failsafes.is_on("partner_lost") and not failsafes.is_on("leak")
    delayed = Failsafes(replace(P, partner_lost_delay_s=1.0))
    delayed.step(bad("partner_lost"), Mode.AUTO, False, True)
    assert not delayed.is_on("partner_lost")


def test_depth_is_known_by_pressure_or_by_tags() -> None:
    lost = math.nextafter(P.depth_unknown_limit, math.inf)
    assert alarms_of(quick("depth_unknown"), GOOD._replace(depth_age_s=lost)) == []
    assert alarms_of(quick("depth_unknown"), GOOD._replace(tag_age_s=lost)) == []
    assert alarms_of(quick("depth_unknown"), GOOD._replace(depth_age_s=lost, tag_age_s=lost))


def test_push_counts_only_while_no_tag_tells_what_it_does() -> None:
    pushed = GOOD._replace(push_m_s=3.0)
    assert alarms_of(quick("pushed"), pushed._replace(tag_age_s=UNSEEN_S)) == []
    assert alarms_of(quick("pushed"), pushed._replace(tag_age_s=math.nextafter(UNSEEN_S, math.inf)))


def test_nearer_body_is_the_worse_one() -> None:
    assert alarms_of(quick("collision"), GOOD._replace(collision_s=0.1))
    assert alarms_of(quick("collision"), GOOD._replace(collision_s=0.3)) == []


def test_body_that_holds_a_place_on_the_fence_is_not_outside() -> None:
    """It moves about that place by millimetres, and an item of a mission may lie a little beyond."""
    assert alarms_of(quick("fence"), GOOD._replace(outside_m=0.005 + mission_items.ON_FENCE_M), Mode.AUTO) == []
    assert alarms_of(quick("fence"), GOOD._replace(outside_m=0.1), Mode.AUTO)


COUNTS = {
    "depth_unknown": POSE_MODES | {Mode.ALT_HOLD},
    "tag_gone": POSE_MODES,
    "estimator": POSE_MODES | {Mode.ALT_HOLD, Mode.STABILIZE},
    "rejected": POSE_MODES | {Mode.ALT_HOLD, Mode.STABILIZE},
    "tag_lost": POSE_MODES,
    "attitude_lost": set(Mode) - {Mode.MANUAL, Mode.MOTOR_DETECT},
    "place_lost": POSE_MODES,
    "pushed": POSE_MODES - {Mode.DOCK},
    "tag_late": POSE_MODES - {Mode.POSHOLD},
    "fence": POSE_MODES - {Mode.POSHOLD},
    "collision": {Mode.POSHOLD, Mode.AUTO, Mode.GUIDED, Mode.ALT_HOLD, Mode.STABILIZE, Mode.MANUAL, Mode.SURFACE},
    "ground_lost": set(Mode) - {Mode.AUTO, Mode.SURFACE},
    "pilot_lost": {Mode.MANUAL, Mode.STABILIZE, Mode.ALT_HOLD},
}


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("mode", Mode, ids=lambda mode: mode.name)
def test_fail_safe_counts_in_its_modes_alone(name: str, mode: Mode) -> None:
    assert bool(alarms_of(quick(name), bad(name), mode)) == (mode in COUNTS.get(name, set(Mode)))


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("mode", Mode, ids=lambda mode: mode.name)
def test_mode_that_a_fail_safe_chose_is_watched_for_tags_that_stay_away_and_for_the_fence(name: str, mode: Mode) -> None:
    expected = mode in COUNTS.get(name, set(Mode)) or (name in ("tag_gone", "fence") and mode == Mode.ALT_HOLD)
    assert bool(alarms_of(quick(name), bad(name), mode, forced=True)) == expected


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("mode", Mode, ids=lambda mode: mode.name)
def test_pilot_is_only_told_of_what_he_may_judge_himself(name: str, mode: Mode) -> None:
    """That the estimate contradicts the tags, in modes that use it; that another body is in his way."""
    only_warns = mode in {
        "estimator": (Mode.ALT_HOLD, Mode.STABILIZE), "rejected": (Mode.ALT_HOLD, Mode.STABILIZE),
        "collision": (Mode.ALT_HOLD, Mode.STABILIZE, Mode.MANUAL, Mode.SURFACE),
    }.get(name, ())  # fmt: skip
    for action in Level:
        wanted = replace(quick(name), **{f"{name}_action": int(action)})
        for alarm in alarms_of(wanted, bad(name), mode):
            assert alarm.level == (min(action, Level.WARN) if only_warns else action)


@pytest.mark.parametrize("name", FIELDS)
def test_disarmed_robot_minds_only_what_is_wrong_with_itself(name: str) -> None:
    for mode in (Mode.AUTO, Mode.MANUAL, Mode.POSHOLD):
        assert bool(alarms_of(quick(name), bad(name), mode, armed=False)) == (name not in COUNTS)


@pytest.mark.parametrize("name", FIELDS)
def test_alarm_waits_for_its_delay_to_the_nanosecond(name: str) -> None:
    one = replace(P, **{f"{row.name}_action": 0 for row in TABLE if row.name != name}, **{f"{name}_delay_s": 0.5})
    mode = next(m for m in (Mode.AUTO, Mode.MANUAL) if m in ROWS[name].modes)
    failsafes, begin = Failsafes(one), bad(name)
    assert failsafes.step(begin, mode, False, True) == []
    assert failsafes.step(begin._replace(time_ns=begin.time_ns + 499_999_999), mode, False, True) == []
    (alarm,) = failsafes.step(begin._replace(time_ns=begin.time_ns + 500_000_000), mode, False, True)
    assert alarm.begins
    assert failsafes.step(at(begin, 0.6), mode, False, True) == [], "said once"


def test_cause_that_comes_and_goes_starts_anew() -> None:
    failsafes = Failsafes(replace(P, leak_delay_s=1.0))
    wet = GOOD._replace(leak=True)
    failsafes.step(wet, Mode.AUTO, False, True)
    failsafes.step(at(GOOD, 0.9), Mode.AUTO, False, True)
    assert failsafes.step(at(wet, 1.1), Mode.AUTO, False, True) == []
    assert failsafes.step(at(wet, 2.0), Mode.AUTO, False, True) == []
    assert failsafes.step(at(wet, 2.1), Mode.AUTO, False, True)


def test_alarm_ends_when_its_cause_is_gone_for_a_while() -> None:
    failsafes = Failsafes(quick("cabin_hot"))
    failsafes.step(GOOD._replace(cabin_c=80.0), Mode.AUTO, False, True)
    assert failsafes.level == Level.SURFACE
    assert failsafes.step(at(GOOD, 1.0), Mode.AUTO, False, True) == []
    again = Alarm("cabin_hot", "cabin hot: 80 degC", Level.SURFACE, True, again=True)
    assert failsafes.step(at(GOOD._replace(cabin_c=80.0), 2.0), Mode.AUTO, False, True) == [again]
    assert failsafes.step(at(GOOD._replace(cabin_c=80.0), 2.5), Mode.AUTO, False, True) == []
    assert failsafes.step(at(GOOD, 3.0), Mode.AUTO, False, True) == []
    late = at(GOOD, 5.0)
    assert failsafes.step(late._replace(time_ns=late.time_ns - 1), Mode.AUTO, False, True) == []
    (alarm,) = failsafes.step(late, Mode.AUTO, False, True)
    assert alarm == Alarm("cabin_hot", "cabin hot", Level.SURFACE, False)
    assert failsafes.level == Level.NONE
    assert failsafes.step(at(GOOD, 6.0), Mode.AUTO, False, True) == [], "said once"


def test_latched_alarm_ends_by_disarming_alone() -> None:
    failsafes = Failsafes(quick("leak"))
    failsafes.step(GOOD._replace(leak=True), Mode.AUTO, False, True)
    for second in range(1, 60):
        assert failsafes.step(at(GOOD, second), Mode.AUTO, False, True) == []
    assert failsafes.level == Level.SURFACE
    (alarm,) = failsafes.step(at(GOOD, 60), Mode.AUTO, False, False)
    assert not alarm.begins and failsafes.level == Level.NONE


def test_latched_alarm_stays_while_its_cause_does() -> None:
    failsafes, wet = Failsafes(quick("leak")), GOOD._replace(leak=True)
    failsafes.step(wet, Mode.AUTO, False, True)
    assert failsafes.step(at(wet, 60), Mode.AUTO, False, False) == []
    assert failsafes.level == Level.SURFACE


def test_parameters_say_which_alarms_are_latched() -> None:
    latched = {name for name in FIELDS if Watch(ROWS[name], P).latched}
    assert latched == {
        "leak", "foreign_sync", "battery_critical", "cabin_pressure", "axis_lost",
    }  # fmt: skip


def test_fail_safe_that_does_nothing_is_not_watched() -> None:
    assert alarms_of(replace(quick("leak"), leak_action=0), GOOD._replace(leak=True)) == []


def test_gravest_action_counts() -> None:
    failsafes = Failsafes(replace(P, battery_low_delay_s=0.0, leak_delay_s=0.0))
    assert failsafes.level == Level.NONE
    failsafes.step(GOOD._replace(voltage_share=0.85), Mode.AUTO, False, True)
    assert failsafes.level == Level.WARN
    alarms = failsafes.step(at(GOOD._replace(voltage_share=0.85, leak=True, foreign_sync=True), 1), Mode.AUTO, False, True)
    assert [alarm.name for alarm in alarms] == ["leak", "foreign_sync"], "gravest first"
    assert failsafes.level == Level.SURFACE


def test_only_what_is_more_than_a_warning_hinders_arming() -> None:
    failsafes = Failsafes(replace(P, battery_low_delay_s=0.0, cabin_hot_delay_s=0.0, module_silent_delay_s=0.0))
    health = GOOD._replace(voltage_share=0.85, cabin_c=81.0, silent_s=0.7)
    assert failsafes.active(health) == []
    failsafes.step(health, Mode.AUTO, False, False)
    assert failsafes.active(health) == ["cabin hot: 81 degC", "a module is silent for 0.7 s"]


@pytest.mark.parametrize("name", FIELDS)
def test_every_alarm_has_its_words(name: str) -> None:
    assert Watch(ROWS[name], P).words(bad(name)) == WORDS[name]


@pytest.mark.parametrize("name", FIELDS)
def test_alarm_that_is_over_says_what_has_cleared_and_no_figure(name: str) -> None:
    """It said "fail-safe over: no IMU for 0.0 s"."""
    failsafes = Failsafes(quick(name))
    mode = min(ROWS[name].modes)
    (on,) = failsafes.step(bad(name), mode, False, True)
    failsafes.step(at(GOOD, 1.0), mode, False, False)
    (over,) = failsafes.step(at(GOOD, 9.0), mode, False, False)
    assert not over.begins and on.words.startswith(over.words) and not any(sign in over.words for sign in "0123456789{}")


@pytest.mark.parametrize(
    ("health", "armed", "says"),
    [
        (GOOD, True, "no tag"),
        (GOOD._replace(tag_age_s=9.0), True, "no tag for 9.0 s, which does not count in MANUAL"),
        (GOOD._replace(tag_age_s=9.0), False, "no tag for 9.0 s, which does not count while disarmed"),
        (GOOD._replace(tag_age_s=P.tag_lost_limit), True, "no tag"),
    ],
)
def test_fail_safe_that_ends_while_its_cause_lasts_says_that_it_does(health: Health, armed: bool, says: str) -> None:
    """It used to tell a pilot that "no tag" was over while there still was none."""
    failsafes = Failsafes(quick("tag_lost"))
    failsafes.step(GOOD._replace(tag_age_s=9.0), Mode.POSHOLD, False, True)
    failsafes.step(at(health, 1.0), Mode.MANUAL, False, armed)
    assert failsafes.step(at(health, 9.0), Mode.MANUAL, False, armed) == [Alarm("tag_lost", says, Level(P.tag_lost_action), False)]


def test_what_was_never_heard_of_has_no_age_in_seconds() -> None:
    assert Watch(ROWS["tag_gone"], P).words(UPRIGHT) == "no tag"


# ---------------------------------------------------------------- modes that are refused while a cause lasts


def test_pilot_may_take_over_from_every_fail_safe_but_disarming() -> None:
    for level in (Level.NONE, Level.WARN, Level.HOLD, Level.DEPTH, Level.SURFACE):
        assert {Mode.MANUAL, Mode.STABILIZE, Mode.ALT_HOLD} <= PERMITTED[level]
    assert PERMITTED[Level.DISARM] == frozenset()
    assert PERMITTED[Level.NONE] == PERMITTED[Level.WARN] == frozenset(Mode)
    extra = {Mode.POSHOLD, Mode.SURFACE, Mode.MOTOR_DETECT}
    assert PERMITTED[Level.HOLD] - PILOTED == extra
    assert PERMITTED[Level.DEPTH] - PILOTED == PERMITTED[Level.SURFACE] - PILOTED == {Mode.SURFACE}
    assert PLACED == POSE_MODES and POSE_MODES - {Mode.POSHOLD} == MOVING and POSE_MODES - {Mode.DOCK} == FREE and set(Mode) == ANY


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("mode", Mode, ids=lambda mode: mode.name)
def test_mode_is_refused_while_a_fail_safe_would_leave_it_at_once(name: str, mode: Mode) -> None:
    failsafes = Failsafes(quick(name))
    level = Level(getattr(P, f"{name}_action"))
    refused = mode in COUNTS.get(name, set(Mode)) and mode not in PERMITTED[level]
    words = [Watch(ROWS[name], P).words(bad(name))]
    assert failsafes.reasons_against(mode, bad(name)) == (words if refused else [])
    assert failsafes.reasons_against(mode, GOOD) == []
    if name not in YES:
        assert failsafes.reasons_against(mode, spoilt(name, getattr(P, f"{name}_limit"))) == []


def test_mode_is_permitted_as_soon_as_the_cause_is_gone_unless_it_is_latched() -> None:
    for name, stays in (("leak", True), ("cabin_hot", False)):
        failsafes = Failsafes(quick(name))
        failsafes.step(bad(name), Mode.AUTO, False, True)
        assert bool(failsafes.reasons_against(Mode.AUTO, at(GOOD, 0.1))) is stays


def test_row_needs_neither_limit_nor_mode() -> None:
    row = Row("leak", "", lambda health: health.leak)
    assert not row.below and row.modes == ANY and row.forced_modes == frozenset()


def test_cause_that_comes_back_is_reported_again_when_it_has_lasted_its_delay() -> None:
    failsafes = Failsafes(replace(quick("leak"), leak_delay_s=0.5, leak_latched=1))
    wet = GOOD._replace(leak=True)
    assert failsafes.step(wet, Mode.AUTO, False, True) == []
    (first,) = failsafes.step(at(wet, 0.5), Mode.AUTO, False, True)
    assert first.begins and not first.again
    for seconds, health in ((60.0, GOOD), (61.0, wet), (61.49, wet)):
        assert failsafes.step(at(health, seconds), Mode.AUTO, False, True) == []
    assert failsafes.step(at(wet, 61.5), Mode.AUTO, False, True) == [first._replace(again=True)]
    assert failsafes.step(at(wet, 90.0), Mode.AUTO, False, True) == []


# ---------------------------------------------------------------- other parameters, other bodies


def test_other_limits_count_from_the_next_tick_on_and_what_is_on_stays_on() -> None:
    failsafes = Failsafes(quick("cabin_hot"))
    failsafes.step(GOOD._replace(cabin_c=71.0), Mode.AUTO, False, True)
    failsafes.retune(replace(quick("cabin_hot"), cabin_hot_limit=90.0, clear_s=1.0))
    assert failsafes.level == Level.SURFACE
    failsafes.step(at(GOOD._replace(cabin_c=89.0), 1.0), Mode.AUTO, False, True)
    (alarm,) = failsafes.step(at(GOOD._replace(cabin_c=89.0), 2.0), Mode.AUTO, False, True)
    assert not alarm.begins
    failsafes.retune(replace(quick("cabin_hot"), cabin_hot_limit=80.0))
    assert failsafes.step(at(GOOD._replace(cabin_c=89.0), 3.0), Mode.AUTO, False, True)[0].begins


def test_other_action_is_acted_on_anew_and_one_that_is_switched_off_is_over() -> None:
    hot = GOOD._replace(cabin_c=80.0)
    failsafes = Failsafes(replace(quick("cabin_hot"), cabin_hot_action=int(Level.WARN)))
    failsafes.step(hot, Mode.AUTO, False, True)
    failsafes.retune(quick("cabin_hot"))
    (alarm,) = failsafes.step(at(hot, 1.0), Mode.AUTO, False, True)
    assert (alarm.begins, alarm.again, alarm.level) == (True, True, Level.SURFACE)
    failsafes.retune(quick("cabin_hot"))
    assert failsafes.step(at(hot, 2.0), Mode.AUTO, False, True) == [], "the same action"
    failsafes.retune(quick("leak"))
    assert failsafes.level == Level.NONE and not failsafes.is_on("cabin_hot")


def test_graver_action_is_carried_out_at_once_by_a_fail_safe_that_is_on() -> None:
    hot, delayed = GOOD._replace(cabin_c=80.0), replace(quick("cabin_hot"), cabin_hot_delay_s=1.0)
    failsafes = Failsafes(replace(delayed, cabin_hot_action=int(Level.WARN)))
    for seconds in (0.0, 1.0):
        failsafes.step(at(hot, seconds), Mode.AUTO, False, True)
    failsafes.retune(delayed)
    assert [alarm.level for alarm in failsafes.step(at(hot, 1.1), Mode.AUTO, False, True)] == [Level.SURFACE]


def warned_in_alt_hold() -> Failsafes:
    """Fail-safe `estimator`, delay 1 s, on since one second in ALT_HOLD, where it only warns."""
    failsafes = Failsafes(replace(quick("estimator"), estimator_delay_s=1.0))
    for seconds in (0.0, 1.0):
        failsafes.step(at(bad("estimator"), seconds), Mode.ALT_HOLD, False, True)
    assert failsafes.is_on("estimator") and failsafes.level == Level.WARN
    return failsafes


def test_fail_safe_that_only_warned_waits_its_delay_in_a_mode_where_it_acts() -> None:
    after = Failsafes(replace(quick("estimator"), estimator_delay_s=1.0))
    after.take_over([warned_in_alt_hold()])
    assert after.level == Level.WARN, "a body that takes over starts from the action in the mode before"
    for failsafes in (warned_in_alt_hold(), after):
        assert failsafes.step(at(bad("estimator"), 1.1), Mode.POSHOLD, False, True) == []
        assert failsafes.step(at(bad("estimator"), 2.0), Mode.POSHOLD, False, True) == []
        (alarm,) = failsafes.step(at(bad("estimator"), 2.1), Mode.POSHOLD, False, True)
        assert alarm.level == Level(P.estimator_action) > Level.WARN


def test_body_that_takes_over_goes_on_with_every_fail_safe_and_its_time() -> None:
    leaky, weak, after = (Failsafes(P) for _ in range(3))
    wet, low = GOOD._replace(leak=True), GOOD._replace(voltage_share=0.79)
    for seconds in (0.0, 0.5):
        leaky.step(at(wet, seconds), Mode.AUTO, False, True)
        weak.step(at(low, seconds), Mode.AUTO, False, True)
    after.take_over([weak, leaky])
    assert after.is_on("leak") and after.level == Level.SURFACE
    assert after.active(GOOD) == ["water in a cabin"]
    both = low._replace(leak=True)
    assert after.step(at(both, 1.0), Mode.AUTO, False, True) == [], "told already"
    assert [alarm.name for alarm in after.step(at(both, 4.99), Mode.AUTO, False, True)] == []
    assert [alarm.name for alarm in after.step(at(both, 5.0), Mode.AUTO, False, True)] == ["battery_critical", "battery_low"]


def leaking(seconds: float, *modules: int) -> Health:
    """A body of modules 0, 1 and 2 with water in the cabins of `modules`."""
    reports = ModuleReports([0, 1, 2])
    reports.leak |= dict.fromkeys(modules, True)
    return at(GOOD._replace(leak=bool(modules), reports=reports), seconds)


LEAK = replace(quick("leak"), leak_delay_s=1.0, leak_latched=0)


def told_of(failsafes: Failsafes, *healths: Health) -> list[str]:
    alarms = [alarm for health in healths for alarm in failsafes.step(health, Mode.AUTO, False, True)]
    return [alarm.words for alarm in alarms if alarm.begins and not alarm.again]


def test_fail_safe_that_spreads_to_a_module_is_told_once_it_has_been_there_for_the_delay() -> None:
    failsafes = Failsafes(LEAK)
    assert told_of(failsafes, leaking(0.0, 0), leaking(1.0, 0)) == ["water in a cabin (module 1)"]
    assert told_of(failsafes, leaking(1.5, 0, 1), leaking(2.5 - 1e-9, 0, 1)) == []
    assert told_of(failsafes, leaking(2.5, 0, 1), leaking(9.0, 0, 1)) == ["water in a cabin (module 1, 2)"]
    assert told_of(failsafes, leaking(10.0, 0, 1, 2), leaking(10.5, 0, 1), leaking(10.9, 0, 1, 2), leaking(11.8, 0, 1, 2)) == []
    assert told_of(failsafes, leaking(11.9, 0, 2)) == ["water in a cabin (module 1, 3)"]


def test_modules_that_answer_late_are_named() -> None:
    late = leaking(0.0)._replace(late=(0, 2))
    assert told_of(Failsafes(quick("module_late")), late) == ["a module answers too late, or for another tick (module 1, 3)"]


def test_fail_safe_that_ended_names_its_modules_anew() -> None:
    failsafes = Failsafes(LEAK)
    assert told_of(failsafes, leaking(0.0, 0), leaking(1.0, 0), leaking(2.0), leaking(2.0 + P.clear_s)) == ["water in a cabin (module 1)"]
    assert told_of(failsafes, leaking(20.0, 1), leaking(21.0, 1)) == ["water in a cabin (module 2)"]
    assert told_of(failsafes, leaking(22.0, 0, 1), leaking(23.0, 0, 1)) == ["water in a cabin (module 1, 2)"]


def test_body_that_takes_over_names_no_module_again() -> None:
    before, after = Failsafes(LEAK), Failsafes(LEAK)
    assert told_of(before, leaking(0.0, 0), leaking(1.0, 0))
    after.take_over([before])
    assert told_of(after, leaking(2.0, 0), leaking(4.0, 0)) == []
    assert told_of(after, leaking(5.0, 0, 1), leaking(6.0, 0, 1)) == ["water in a cabin (module 1, 2)"]


def test_fail_safe_that_never_began_has_nothing_to_say() -> None:
    assert Watch(ROWS["leak"], P).reason(GOOD) == ""


def test_body_made_of_calm_ones_is_calm() -> None:
    after = Failsafes(quick("leak"))
    after.take_over([Failsafes(quick("leak")), Failsafes(quick("leak"))])
    assert after.level == Level.NONE
    (alarm,) = after.step(GOOD._replace(leak=True), Mode.AUTO, False, True)
    assert alarm.begins and not alarm.again


def test_fail_safe_that_was_switched_off_begins_anew_when_it_is_switched_on_again() -> None:
    off = replace(P, battery_critical_action=0, module_silent_action=0)
    failsafes, low = Failsafes(P), GOOD._replace(voltage_share=0.7, silent_s=1.0)
    for seconds in (0.0, 0.6):
        failsafes.step(at(low, seconds), Mode.POSHOLD, False, True)
    assert failsafes.is_on("module_silent")
    failsafes.retune(off)
    failsafes.step(at(GOOD, 1.0), Mode.POSHOLD, False, True)
    failsafes.retune(P)
    assert failsafes.level == Level.NONE
    low = low._replace(silent_s=0.0)
    assert failsafes.step(at(low, 100.0), Mode.POSHOLD, False, True) == [], "its delay counts from now"
