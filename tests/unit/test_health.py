"""Health: ages, means and worst cases of the readings of a body's modules."""

import math

import numpy as np
import pytest

from firmware_py.core.failsafes import Failsafes
from firmware_py.core.fence import outside
from firmware_py.core.health import NEVER_S
from firmware_py.core.health_monitor import HealthMonitor
from firmware_py.core.names import Place
from firmware_py.core.paper_estimator import TagOnlyEstimator
from firmware_py.core.rotations import exp
from firmware_py.core.setpoint import rest_at
from firmware_py.core.thruster_state import ThrusterFaults
from firmware_py.core.types import (
    MCU_TIMED_OUT,
    MCU_UNFIT,
    Action,
    BodyPose,
    EscFeedback,
    Inputs,
    Measured,
    Mode,
    ModuleInputs,
    Request,
    Sticks,
    TagObservation,
)
from firmware_py.description.failsafe_parameters import Fence
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from tests.unit.monitor_bench import BODY, ESTIMATE, EVERY, MODCUBE, SINGLE, SIX, START_NS, TICK_NS, ZERO, MonitorBench, here


def test_module_whose_answers_come_for_other_ticks_is_silent_and_late() -> None:
    """Regression: a board that answered 6 ms after SYNC was said not to answer."""
    bench = MonitorBench()
    late, mute = ModuleInputs(heard=True, mcu_state=1, late_ticks=1), ModuleInputs(heard=True)
    for _ in range(21):
        health = bench.step(late, mute)
    assert (health.silent, health.late) == ((1, 3), (1,))
    for _ in range(21):
        health = bench.step(mute, here(mcu_state=1))
    assert (health.silent, health.late) == ((1,), ())
    assert bench.step(here(mcu_state=1), here(mcu_state=1)).late == ()


def test_silence_is_counted_per_module() -> None:
    bench = MonitorBench()
    bench.step(here(), here())
    for _ in range(50):
        health = bench.step(here())
    assert health.silent == (3,) and health.bus_silent_s == 0.0
    assert health.silent_s == pytest.approx(0.5)
    health = bench.wait(0.3)
    assert health.silent == (1, 3) and health.bus_silent_s == pytest.approx(0.3) and health.silent_s == pytest.approx(0.8)
    assert bench.step(here(), here()).silent == ()


def test_e_stop_that_holds_a_module_of_another_body_is_heard_until_that_falls_silent_or_lets_go() -> None:
    """Modules 0 and 2 belong to other bodies, perhaps on another bus: whoever pressed the e-stop there wants everything to stop."""
    bench = MonitorBench()
    stopped, free = here(mcu_state=4), here(mcu_state=1)
    assert bench.step(here(), here(), others=stopped).stopped == (0, 2)
    assert bench.step(here(), here(), others=free).stopped == ()
    bench.step(here(), stopped, others=stopped)
    assert bench.wait(0.1).stopped == (0, 2, 3)
    assert bench.wait(1.0).stopped == (3,), "its own modules are waited for; one that was switched off elsewhere holds nobody back"
    whole = HealthMonitor(BODY, Parameters(), TICK_NS)
    whole.take_over([bench.monitor])
    assert set(whole._stopped_ns) == {0, 2, 3}


def test_module_that_starts_or_is_deaf_or_has_a_fault_is_unfit_until_it_says_otherwise() -> None:
    bench = MonitorBench()
    assert bench.step().unfit == ()
    assert bench.step(here(mcu_state=1), here(mcu_state=5)).unfit == (3,)
    assert bench.step(here(mcu_state=0), here()).unfit == (1, 3), "one that says nothing is as it was"
    whole = MonitorBench()
    whole.monitor.take_over([bench.monitor])
    assert whole.step().unfit == (1, 3)
    assert bench.step(here(mcu_state=3), here(mcu_state=1)).unfit == (1,)
    for state in (1, 2, 4):
        assert bench.step(here(mcu_state=state), here(mcu_state=state)).unfit == ()


@pytest.mark.parametrize("state", MCU_UNFIT)
def test_module_that_says_that_it_obeys_no_commands_counts_as_silent(state: int) -> None:
    bench = MonitorBench()
    bench.step(here(mcu_state=2), here(mcu_state=2))
    deaf_s = [bench.step(here(mcu_state=state), here(mcu_state=2)).silent_s, bench.step(here(), here(mcu_state=2)).silent_s]
    assert 0.0 < deaf_s[0] < deaf_s[1], "frames without a status are as the status before"
    assert bench.monitor.now.bus_silent_s == 0.0 and bench.monitor.now.silent == (), "it answers"
    assert bench.monitor.now.still_s == 0.0, "the other one obeys"
    still_s = [bench.step(here(), here(mcu_state=state)).still_s for _ in range(2)]
    assert still_s == pytest.approx([0.01, 0.02])
    whole = MonitorBench()
    whole.time_ns = bench.time_ns
    whole.monitor.take_over([bench.monitor])
    assert whole.step(here(), here()).silent_s > deaf_s[1]
    assert bench.step(here(mcu_state=2), here(mcu_state=2)).silent_s == 0.0


def test_body_that_falls_silent_is_not_said_to_obey_nothing() -> None:
    """Regression: it heard its commands, and swam on at 0.8 m/s after a fail-safe because its set-point went along."""
    bench = MonitorBench()
    bench.step(here(mcu_state=2), here(mcu_state=2))
    for _ in range(30):
        health = bench.step()
    assert health.silent_s == pytest.approx(0.3) and health.still_s == 0.0
    assert bench.step(here(mcu_state=MCU_TIMED_OUT)).still_s == 0.0, "the other one may obey"
    assert bench.step(here(), here(mcu_state=MCU_TIMED_OUT)).still_s > 0.3


def test_module_that_only_talks_has_not_answered() -> None:
    bench = MonitorBench()
    bench.step(here(), here())
    for _ in range(30):
        health = bench.step(here(), ModuleInputs(heard=True))
    assert health.silent == (3,) and health.silent_s == 0.0


def test_gap_between_pictures_is_told_while_they_come() -> None:
    bench = MonitorBench()

    def see(capture_ns: int) -> float:
        seen = [TagObservation(face, 7, START_NS + capture_ns, ZERO, np.array([1.0, 0, 0, 0])) for face in (0, 5)]
        return bench.step(here(tags=seen), here(tags=seen)).tag_gap_s

    assert math.isnan(bench.step(here(), here()).tag_gap_s) and math.isnan(see(0))
    bench.wait(1.5)
    assert see(1_500_000_000) == 1.5
    assert bench.wait(2.9).tag_gap_s == 1.5
    assert math.isnan(bench.wait(0.2).tag_gap_s)
    assert see(4_600_000_000) == pytest.approx(3.1)


def test_robot_that_just_started_is_not_long_silent() -> None:
    health = MonitorBench().step()
    assert health.silent == (1, 3) and health.silent_s == 0.0 and health.depth_age_s == 0.0


def test_weakest_supply_and_hottest_cabin_count() -> None:
    bench = MonitorBench()
    assert math.isnan(bench.step().voltage_share) and math.isnan(bench.step().cabin_c)
    health = bench.step(here(voltage_v=12.0, cabin_temperature_c=31.0), here(voltage_v=10.8, cabin_temperature_c=40.0))
    assert health.voltage_share == pytest.approx(0.9) and health.cabin_c == 40.0
    for _ in range(40):
        health = bench.step(here(voltage_v=6.0), here())
    assert health.voltage_share == pytest.approx(0.5, abs=0.01), "single readings are smoothed"


def test_supply_that_sags_for_one_reading_is_not_low_and_one_that_stays_low_is_within_a_second() -> None:
    bench = MonitorBench()
    bench.step(here(voltage_v=12.0), here(voltage_v=12.0))
    assert 0.85 < bench.step(here(voltage_v=6.0), here(voltage_v=12.0)).voltage_share < 0.95
    for _ in range(10):
        health = bench.step(here(voltage_v=6.0), here(voltage_v=12.0))
    assert 0.5 < health.voltage_share < 0.56


def test_readings_of_battery_and_cabin_are_as_old_as_the_module_s_that_was_silent_of_them_longest() -> None:
    """A sensor that died an hour ago indicates neither an empty battery nor a hot cabin."""
    bench, well = MonitorBench(), {"voltage_v": 12.0, "cabin_temperature_c": 31.0}
    health = bench.step(here(**well), here())
    assert min(health.battery_age_s, health.cabin_age_s) > NEVER_S
    health = bench.step(here(), here(**well))
    assert health.battery_age_s == health.cabin_age_s == pytest.approx(0.01)
    health = bench.wait(2.0)
    assert health.battery_age_s == health.cabin_age_s == pytest.approx(2.01)
    assert health.voltage_share == 1.0, "no fail-safe ends because its sensor is gone"
    bench.step(here(voltage_v=12.0), here(voltage_v=12.0))
    whole = MonitorBench()
    whole.monitor.take_over([bench.monitor])
    whole.time_ns = bench.time_ns
    health = whole.step()
    assert health.battery_age_s == pytest.approx(0.01) and health.cabin_age_s == pytest.approx(2.03)


def test_cabin_pressure_counts_from_its_first_reading() -> None:
    bench = MonitorBench()
    bench.step(here(cabin_pressure_pa=80e3), here(cabin_pressure_pa=100e3))
    assert bench.step(here(cabin_pressure_pa=81e3), here(cabin_pressure_pa=93e3)).cabin_change_pa == 7e3
    whole = MonitorBench()
    whole.monitor.take_over([bench.monitor])
    assert whole.step(here(), here(cabin_pressure_pa=90e3)).cabin_change_pa == 10e3, "also of a body that is made of others"


def test_cabin_that_was_wet_twice_is_not_dry_at_once_for_a_body_that_is_made_of_others() -> None:
    bench, whole = MonitorBench(), MonitorBench()
    for _ in range(2):
        bench.step(here(leak=True), here())
    whole.monitor.take_over([bench.monitor])
    whole.time_ns = bench.time_ns
    assert whole.step(here(leak=False), here()).leak


def test_leak_of_any_module_counts_until_it_says_dry() -> None:
    bench = MonitorBench()
    assert bench.step(here(leak=True), here(leak=False)).leak and not bench.step(here(leak=False), here()).leak
    assert bench.step(here(), here(leak=True)).leak and bench.step(here(leak=False), here()).leak
    assert not bench.step(here(), here(leak=False)).leak, "one reading alone is none for long"
    bench.step(here(), here(leak=True)), bench.step(here(), here(leak=True))
    assert bench.wait(2.98).leak and bench.step(here(), here(leak=False)).leak, "water in a cabin moves"
    assert not bench.step(here(), here(leak=False)).leak


def test_wet_sensor_that_flickers_is_a_leak_all_the_time() -> None:
    bench = MonitorBench()
    bench.step(here(leak=True))
    assert all(bench.step(here(leak=tick % 290 < 2)).leak for tick in range(3000))


def test_body_that_takes_over_knows_what_its_modules_said_and_when_people_were_heard() -> None:
    """Taken over by a body of module 3 alone, and then by the pair again."""
    whole = MonitorBench()
    sticks = Request(Action.STICKS, 0, Sticks((0.5, 0.0, 0.0)))
    whole.dropped = 1000
    said = {"voltage_v": 11.4, "cabin_temperature_c": 44.0, "pressure_pa": 1.2e5, "esc": [EscFeedback(6, (0.0, 0.0), (0.0, 0.0), (0, 0))]}
    whole.step(here(cabin_pressure_pa=90e3), here(cabin_pressure_pa=100e3), Request(Action.GROUND_ALIVE, 0), sticks)
    whole.step(here(leak=True), here(cabin_pressure_pa=93e3, **said))
    before = whole.wait(0.5)
    alone = MonitorBench(assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [3]))
    alone.monitor.take_over([whole.monitor])
    alone.tick, alone.time_ns, alone.dropped = whole.tick, whole.time_ns, whole.dropped
    after = alone.step()
    assert (after.cabin_change_pa, after.cabin_c, after.leak, after.silent) == (7e3, 44.0, False, (3,))
    assert after.voltage_share == pytest.approx(0.95)
    assert after.silent_s == after.depth_age_s == pytest.approx(0.51)
    assert after.ground_age_s == after.pilot_age_s == pytest.approx(0.52) and after.stick == 0.5
    assert Place(3, 6) not in after.esc_missing and Place(3, 5) in after.esc_missing
    assert after.frame_errors_per_s == pytest.approx(before.frame_errors_per_s, rel=0.02), "no frame counts twice"
    pair = MonitorBench()
    pair.monitor.take_over([whole.monitor, alone.monitor])
    pair.tick, pair.time_ns, pair.dropped = alone.tick, alone.time_ns, alone.dropped
    assert pair.step().leak and pair.step().cabin_change_pa == 7e3


def test_joined_body_knows_of_the_ticks_that_were_missed_before() -> None:
    bench, both = MonitorBench(), MonitorBench()
    bench.step()
    bench.time_ns += 20 * TICK_NS
    missed = bench.step().missed_percent
    both.monitor.take_over([bench.monitor, MonitorBench().monitor])
    both.time_ns = bench.time_ns
    assert both.step().missed_percent == pytest.approx(missed, rel=0.02) == pytest.approx(20.0, rel=0.02)


def test_fence_and_delays_may_change() -> None:
    bench = MonitorBench()
    bench.monitor.retune(Parameters().replace("fence.north_m", 0.25).replace("supervision.answer_ms", 1000.0))
    bench.step(here(), here())
    health = bench.wait(0.5)
    assert health.outside_m == 0.75 and health.silent == ()


def test_esc_that_fails_or_falls_silent_is_missing() -> None:
    bench = MonitorBench()
    assert bench.step().esc_missing == EVERY
    good = [EscFeedback(i, (0.0, 0.0), (0.0, 0.0), (0, 2)) for i in range(0, 8, 2)]
    bad = [*good[:3], EscFeedback(6, (0.0, 0.0), (0.0, 0.0), (1, 3))]
    assert bench.step(here(esc=good), here(esc=bad)).esc_missing == (Place(3, 6), Place(3, 7))
    assert bench.wait(1.0).esc_missing == (Place(3, 6), Place(3, 7))
    assert bench.step().esc_missing == EVERY


def test_esc_that_answers_where_the_vehicle_file_has_no_thruster_is_unknown() -> None:
    """A vehicle of six thrusters by its file, whose MCU reports eight ESCs."""
    bench = MonitorBench(assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [SIX, MODCUBE], [1, 3]))
    last = [EscFeedback(6, (0.0, 0.0), (0.0, 0.0), (3, 0))]
    assert bench.step(here(esc=last), here(esc=last)).esc_unknown == (Place(1, 7),), "a silent ESC is none"
    alone, other = (MonitorBench(assemble([(0, 0, 0)], [0], [vehicle], [module])) for vehicle, module in ((SIX, 1), (MODCUBE, 3)))
    for part in (alone, other):
        part.monitor.take_over([bench.monitor])
        part.time_ns = bench.time_ns
    assert alone.step().esc_unknown == (Place(1, 7),) and other.step().esc_unknown == ()
    assert bench.wait(0.9).esc_unknown == (Place(1, 7),) and bench.wait(0.2).esc_unknown == ()


def test_ground_station_and_pilot_count_once_they_were_heard() -> None:
    bench = MonitorBench()
    health = bench.wait(5.0)
    assert math.isnan(health.ground_age_s) and math.isnan(health.pilot_age_s)
    bench.step(None, None, Request(Action.GROUND_ALIVE), Request(Action.STICKS, 1, Sticks((0.0, -0.4, 0.1), (0.0, 0.2, 0.0))))
    health = bench.wait(0.5)
    assert health.ground_age_s == health.pilot_age_s == pytest.approx(0.5) and health.stick == 0.4


@pytest.mark.parametrize(("keep", "wanted_rad"), [(np.eye(6), 1.3), (np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0]), 0.5)])
def test_body_that_swings_is_off_its_set_point_by_the_rms_about_axes_that_it_can_turn(keep: np.ndarray, wanted_rad: float) -> None:
    bench, turned_rad = MonitorBench(), np.sqrt(2.0) * np.array([0.3, -0.4, 1.2])
    off_deg = []
    for tick in range(1000):
        q_wb = np.asarray(exp(turned_rad * np.sin(2.0 * np.pi * tick / 50)))
        bench.monitor.compare(rest_at(ZERO, exp(ZERO)), ESTIMATE._replace(q_wb=q_wb), keep)
        off_deg.append(bench.step().attitude_off_deg)
    assert off_deg[99] == pytest.approx(math.degrees(wanted_rad) * math.sqrt(1.0 - math.exp(-1.0)), rel=0.02)
    assert off_deg[-1] == pytest.approx(math.degrees(wanted_rad), rel=0.1)
    bench.monitor.compare(rest_at(ZERO, exp(ZERO)), ESTIMATE._replace(ready=False), keep)
    assert bench.step().attitude_off_deg == off_deg[-1], "without an attitude nobody knows better"


def test_body_that_swings_is_off_its_place_by_the_rms_along_all_axes_even_those_that_it_cannot_push() -> None:
    bench, away_m = MonitorBench(), np.sqrt(2.0) * np.array([0.3, -0.4, 1.2])
    off_m = []
    for tick in range(1000):
        p_wb = np.array([5.0, 6.0, 7.0]) + away_m * np.sin(2.0 * np.pi * tick / 50)
        bench.monitor.compare(rest_at(np.array([5.0, 6.0, 7.0]), exp(ZERO)), ESTIMATE._replace(p_wb=p_wb), np.zeros((6, 6)))
        off_m.append(bench.step().place_off_m)
    assert off_m[99] == pytest.approx(1.3 * math.sqrt(1.0 - math.exp(-1.0)), rel=0.02)
    assert off_m[-1] == pytest.approx(1.3, rel=0.1)
    bench.monitor.compare(rest_at(ZERO, exp(ZERO)), ESTIMATE._replace(ready=False), np.eye(6))
    assert bench.step().place_off_m == off_m[-1], "without an estimate nobody knows better"


def test_e_stop_box_counts_once_it_was_heard_by_any_part_of_the_body() -> None:
    bench, later = MonitorBench(), MonitorBench()
    assert math.isnan(bench.wait(5.0).estop_box_age_s)
    bench.foreign = {"estop_box": True}
    assert bench.step().estop_box_age_s == 0.0
    bench.foreign = {}
    assert bench.wait(0.5).estop_box_age_s == pytest.approx(0.5)
    later.monitor.take_over([MonitorBench().monitor, bench.monitor])
    later.time_ns = bench.time_ns
    assert later.step().estop_box_age_s == pytest.approx(0.51)
    bench.foreign = {"estop_box": True}
    assert bench.step().estop_box_age_s == 0.0, "whenever it speaks"


def test_bus_load_is_the_share_of_a_second_and_from_the_start_that_of_the_time_since() -> None:
    """Regression: with --hold a robot armed 0.5 s after its start, when a full bus still counted as 40 % full."""
    bench = MonitorBench()
    for busy, waited_s, share in ((0.9, 0.02, 0.9), (0.9, 0.5, 0.9), (0.9, 9.0, 0.9), (0.3, 1.0, 0.3 + 0.6 * math.exp(-1.0))):
        bench.busy_s = busy * 1e-9 * TICK_NS
        assert bench.wait(waited_s).bus_load == pytest.approx(share, rel=0.02)


def test_bad_frames_and_missed_ticks_are_rates() -> None:
    bench = MonitorBench()
    for _ in range(300):
        bench.dropped += 1
        health = bench.step()
    assert health.frame_errors_per_s == pytest.approx(100.0, rel=0.06) and health.missed_percent == 0.0
    for _ in range(100):
        bench.time_ns += TICK_NS
        health = bench.step()
    assert health.missed_percent == pytest.approx(50.0, rel=0.2)


@pytest.mark.parametrize("rate_hz", [50, 100, 200, 400])
def test_pause_of_the_process_counts_as_much_at_every_tick_rate(rate_hz: int) -> None:
    """Regression: missed ticks were counted, so that one pause of 25 ms made a robot hold at 400 Hz, and at 50 Hz one of 180 ms did not."""
    period_ns, faults = 1_000_000_000 // rate_hz, ThrusterFaults(np.ones(16, dtype=bool), (), 0, np.eye(6), np.ones(2))
    monitor, failsafes = HealthMonitor(BODY, Parameters(), period_ns), Failsafes(Parameters().failsafes)
    monitor.believed = modules = [ModuleInputs(answered=True, heard=True)] * 4
    held_ms, time_ns = list[int](), START_NS
    for pause_ms in (40, 80, 120):
        for tick in range(6 * rate_hz):
            time_ns += period_ns + (pause_ms * 1_000_000 if tick == 0 else 0)
            failsafes.step(monitor.step(Inputs(tick, time_ns, modules), ESTIMATE, [], faults), Mode.POSHOLD, forced=False, armed=True)
            held_ms += [pause_ms] if failsafes.is_on("ticks_missed") and pause_ms not in held_ms else []
    assert held_ms == [120]


def test_time_without_a_tick_is_silence_of_the_bus_in_the_tick_after_it() -> None:
    bench = MonitorBench()
    assert bench.step(here(), here()).bus_silent_s == 0.0
    assert bench.step(here(), here()).bus_silent_s == 0.0
    bench.time_ns += 3_000_000_000
    both = HealthMonitor(BODY, Parameters(), TICK_NS)
    both.take_over([bench.monitor])
    assert bench.step(here(), here()).bus_silent_s == 3.0
    assert bench.step(here(), here()).bus_silent_s == 0.0
    bench.monitor, bench.time_ns = both, bench.time_ns - 2 * TICK_NS
    assert bench.step(here(), here()).bus_silent_s == 3.0, "nor does a body that joins in that tick lose it"


def test_innovations_and_refusals_are_means_of_a_second() -> None:
    bench = MonitorBench()
    assert bench.step().nis_ratio == pytest.approx(1.0)
    for _ in range(60):
        health = bench.step(nis=30.0)  # type: ignore[arg-type]
    assert health.nis_ratio == pytest.approx(1.0 + 4.0 * (1.0 - math.exp(-1.0)), rel=0.01), "a second of tags"
    for _ in range(240):
        health = bench.step(nis=30.0)  # type: ignore[arg-type]
    assert health.nis_ratio == pytest.approx(5.0, rel=0.02)
    health = bench.wait(1.0, nis=math.nan, nis_dof=0)
    assert health.nis_ratio == pytest.approx(5.0, rel=0.02), "no tag says nothing"
    for n in range(1, 300):
        health = bench.step(rejected=n, nis=math.nan, nis_dof=0)  # type: ignore[arg-type]
    assert 0.98 < health.rejected_share <= 1.0


def test_tags_that_the_papers_estimator_accepts_count_though_it_tells_no_innovations() -> None:
    """A newer tag in a tick without a refusal counts as accepted; no tag in a tick says nothing, as with the other estimator."""
    bench = MonitorBench()
    silence = {"nis": math.nan, "nis_dof": 0}
    for n in range(1, 301):
        bench.step(rejected=n, tag_age_ns=n * TICK_NS, **silence)  # type: ignore[arg-type]
    for n in range(301, 401):
        health = bench.step(rejected=300, tag_age_ns=n * TICK_NS, **silence)  # type: ignore[arg-type]
    assert 0.98 < health.rejected_share <= 1.0
    health = bench.wait(6.0, rejected=300, **silence)
    assert health.rejected_share < 0.01 and health.nis_ratio == 1.0


@pytest.mark.slow
def test_few_flips_in_a_long_flight_of_the_papers_estimator_stay_few() -> None:
    estimator, bench = TagOnlyEstimator(BODY, Parameters().estimation, TICK_NS), MonitorBench()
    flip, worst = exp(np.array([0.8, 0.0, 0.0])), 0.0
    for k in range(1, 3001):
        q_wb = flip if k % 50 == 0 else np.array([1.0, 0.0, 0.0, 0.0])
        pose = BodyPose(k * TICK_NS, np.zeros(3), np.zeros(3), q_wb, 1.0)
        estimate = estimator.step(k * TICK_NS, Measured(None, None, None, [pose]), np.zeros(6))
        worst = max(worst, bench.step(**estimate._asdict()).rejected_share)
    assert estimate.rejected == 60 and 0.01 < worst < 0.05


def test_fence_is_a_box() -> None:
    fence = Fence(north_m=2.0, east_m=1.0, top_m=0.5, bottom_m=3.0)
    inside = np.array([0.0, 0.0, 1.5])
    assert outside(inside, fence) == -1.0
    for axis, value, beyond in ((0, 2.3, 0.3), (0, -2.3, 0.3), (1, 1.2, 0.2), (1, -1.2, 0.2), (2, 0.4, 0.1), (2, 3.4, 0.4)):
        p = inside.copy()
        p[axis] = value
        assert outside(p, fence) == pytest.approx(beyond)


def test_robot_without_a_pose_is_nowhere() -> None:
    health = MonitorBench().step(ready=False, tag_age_ns=1 << 60)  # type: ignore[arg-type]
    assert math.isnan(health.outside_m) and not health.ready and health.tag_age_s > NEVER_S
    health = MonitorBench().step()
    assert health.sigma_m == 0.03 and health.tag_age_s == pytest.approx(0.03)


def test_depth_is_known_from_the_first_that_is_heard() -> None:
    bench = MonitorBench()
    assert not bench.step(here()).depth_heard
    assert bench.step(here(pressure_pa=1.1e5)).depth_heard and bench.step(here()).depth_heard
    whole = MonitorBench()
    whole.monitor.take_over([HealthMonitor(BODY, Parameters(), TICK_NS), bench.monitor])
    assert whole.step().depth_heard


def test_depth_counts_as_unknown_while_there_is_no_estimate_to_use_it() -> None:
    """A robot without IMU and tags went on by its last estimate for eighteen seconds, and rose by two and a half metres."""
    bench = MonitorBench()
    bench.step()
    health = bench.wait(6.0, one=here(pressure_pa=2e5), ready=False)
    assert health.depth_age_s == 0.0 and health.depth_unknown_s == pytest.approx(6.0)
    joined = HealthMonitor(SINGLE, Parameters(), TICK_NS)
    joined.take_over([bench.monitor])
    bench.monitor = joined
    assert bench.step(one=here(pressure_pa=2e5), ready=False).depth_unknown_s == pytest.approx(6.01)
    assert bench.step(one=here(pressure_pa=2e5)).depth_unknown_s == 0.0


def test_imu_is_as_old_as_its_last_sample_that_was_believed() -> None:
    bench, well = MonitorBench(), here(gyro=ZERO, accel=ZERO)
    assert bench.wait(0.5, one=well).imu_age_s == 0.0
    assert bench.wait(0.3, one=here(gyro=ZERO), three=here(accel=ZERO)).imu_age_s == pytest.approx(0.3), "half an IMU is none"
    assert bench.step(None, well).imu_age_s == 0.0


def test_sensors_of_a_body_of_several_are_as_old_as_those_of_the_module_where_they_are_oldest() -> None:
    """A pressure sensor that was never heard may not be there; an IMU is in every module."""
    bench, imu = MonitorBench(), {"gyro": ZERO, "accel": ZERO}
    bench.step()
    health = bench.wait(0.5, one=here(pressure_pa=1.1e5, **imu), three=here(**imu))
    assert health.sensor_age_s == 0.0
    assert bench.wait(0.5, one=here(**imu), three=here(**imu)).sensor_age_s == pytest.approx(0.5)
    bench.step(here(pressure_pa=1.1e5, **imu), here(**imu))
    health = bench.wait(0.7, one=here(pressure_pa=1.1e5, **imu), three=here(pressure_pa=1.1e5))
    assert health.sensor_age_s == pytest.approx(0.7) and health.imu_age_s == health.depth_age_s == 0.0
    part = HealthMonitor(SINGLE, Parameters(), TICK_NS)
    part.take_over([bench.monitor])
    bench.monitor = part
    assert math.isnan(bench.step().sensor_age_s), "a module alone has its own ages"


def test_module_that_leaves_without_an_imu_of_its_own_is_known_to_have_none() -> None:
    bench = MonitorBench()
    bench.step()
    bench.wait(0.7, one=here(gyro=ZERO, accel=ZERO), three=here())
    part = HealthMonitor(assemble([(0, 0, 0)], [0], [MODCUBE], [3]), Parameters(), TICK_NS)
    part.take_over([bench.monitor])
    bench.monitor = part
    assert bench.step().imu_age_s == pytest.approx(0.71)


def test_robot_that_stands_by_gravity_alone_is_nowhere_but_ready() -> None:
    health = MonitorBench().step(tag_age_ns=1 << 60)  # type: ignore[arg-type]
    assert health.ready and not health.placed and math.isnan(health.outside_m)
    assert MonitorBench().step().placed and not MonitorBench().step(ready=False).placed  # type: ignore[arg-type]


@pytest.mark.parametrize("foreign", ["foreign_sync", "foreign_command"])
def test_frame_of_somebody_else_is_remembered_for_a_second(foreign: str) -> None:
    bench = MonitorBench()
    assert not getattr(bench.step(), foreign)
    bench.foreign = {foreign: True}
    assert getattr(bench.step(), foreign)
    bench.foreign = {}
    assert [getattr(bench.step(), foreign) for _ in range(101)] == [True] * 100 + [False]


@pytest.mark.parametrize("foreign", ["foreign_sync", "foreign_command"])
def test_joined_body_remembers_a_frame_of_somebody_else_that_one_of_its_parts_heard(foreign: str) -> None:
    one, other, both = MonitorBench(), MonitorBench(), MonitorBench()
    other.foreign = {foreign: True}
    for bench in (one, other):
        bench.step()
    both.monitor.take_over([one.monitor, other.monitor])
    assert getattr(both.step(), foreign)
