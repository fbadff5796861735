"""People put their hands near these thrusters: the safety figures of `make accept`, on a few seeds.

Thrusters that die or lie on the spiral, lost frames, e-stops at any tick, missing tags, fuzzed frames (a million in `make accept`).
"""

import dataclasses
import math
from collections.abc import Callable
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_py.core.failsafes import Level
from firmware_py.core.rotations import difference
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Inputs, Mode, Outputs, Request
from firmware_py.description.parameters import Parameters
from hil.bench import Bench, open_bench
from hil.fuzz import fuzz_flight
from hil.plant.fault_spec import Fault
from hil.safety import ICM_20602, command_outlives_frames_ms, flown, fly_to_estop, hover_blind, spiral_through_loss, spiral_with, timed
from hil.scenario import load_scenario

TICK_MS = 10.0


@pytest.mark.slow
@pytest.mark.parametrize("thruster", [0, 5])
def test_dead_thruster_on_the_spiral_is_found_at_once_and_hardly_felt(thruster: int) -> None:
    flight = spiral_with([thruster])
    assert flight.found_s[0] <= 0.5
    assert (flight.blamed, flight.ends_in) == ((), "AUTO")
    assert 0.001 <= flight.rmse_m <= 0.012
    assert flight.peak_m <= 0.060
    assert flight.angle_peak_deg <= 15.0


@pytest.mark.slow
def test_lying_thruster_is_found_by_the_motion_alone() -> None:
    flight = spiral_with([3], "thruster_fake_rpm")
    assert flight.found_s[0] <= 2.0
    assert flight.blamed == ()


@pytest.mark.slow
def test_two_dead_thrusters_that_leave_every_axis_are_flown_with() -> None:
    flight = spiral_with([0, 1])
    assert (flight.blamed, flight.ends_in) == ((), "AUTO")
    assert flight.rmse_m <= 0.025
    assert flight.angle_peak_deg <= 30.0


@pytest.mark.slow
def test_pair_without_which_yaw_is_lost_keeps_the_place_and_surfaces() -> None:
    flight = spiral_with([4, 7])
    assert flight.ends_in == "SURFACE"
    assert flight.rmse_m <= 0.025
    assert flight.peak_m <= 0.060


@pytest.mark.slow
def test_healthy_spiral_blames_no_thruster() -> None:
    flight = spiral_with([], seed=7)
    assert (flight.blamed, flight.ends_in) == ((), "AUTO")


@pytest.mark.slow
def test_module_that_turns_over_while_nobody_drives_it_is_armed_and_comes_to_rest() -> None:
    """This module does not float upright; by the time it came to rest it would show no tag."""
    turning = np.linalg.norm(flown(timed("hover-blind", 3.0, 2.0), 41).firmware["nu"][:, 3:], axis=1)
    assert turning[:110].max() > 1.0
    assert turning[-50:].max() < 0.1


@pytest.mark.slow
def test_spiral_is_flown_through_thirty_percent_of_lost_frames() -> None:
    assert spiral_through_loss(0, 0.3) <= 0.008


@pytest.mark.slow
def test_command_ends_a_tenth_of_a_second_after_the_last_frame() -> None:
    assert 50.0 <= command_outlives_frames_ms() <= 100.0 + TICK_MS


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_after_an_e_stop_nothing_turns_whatever_else_happens(seed: int) -> None:
    flight = fly_to_estop(seed)
    assert flight.violations == 0
    assert flight.ticks > 10
    assert flight.was_armed


@pytest.mark.slow
def test_stop_that_was_raised_before_the_start_stands_though_the_first_answers_of_the_modules_are_lost() -> None:
    """A module releases its stop at the first DISARMED command, so none may be sent before the stop is known."""
    silence = Fault(kind="frame_loss", value=1.0, at_s=0.0, until_s=0.035, direction="from_plant")

    def press(bench: Bench) -> None:
        for mcu in bench.nodes.mcus.values():
            mcu.estop(-1_000_000_000)

    states: list[list[State]] = []
    fly("dock", 1.0, silence, press, lambda bench, outputs: states.append([State(record.state) for record in outputs.records]))
    assert states[0] == [State.DISARMED] * 2, "nothing has been heard yet"
    assert states[10:] == [[State.ESTOP] * 2] * (len(states) - 10)


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["both", "from_plant"])
def test_docked_module_that_falls_silent_is_carried_in_place_by_the_other(direction: str) -> None:
    """When the mean IMU lost one module's share, the change of its bias used to drive the pair 25 mm off."""
    silence = Fault(kind="frame_loss", value=1.0, at_s=6.0, module=2, direction=direction)
    off_m: list[float] = []

    def watch(bench: Bench, outputs: Outputs) -> None:
        (record,) = outputs.records
        if outputs.tick > 600:
            assert (record.state, record.mode) == (State.ARMED, Mode.POSHOLD)
            off_m.append(float(np.linalg.norm(bench.nodes.world.body_truth(0).p_wb - record.setpoint.p_wb)))

    fly("mobius-2", 18.0, silence, lambda bench: None, watch)
    assert 0.001 < np.sqrt(np.mean(np.square(off_m))) < 0.005
    assert max(off_m) < 0.010


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "offset_pa"), [("faults", -30_000.0), ("faults", 0.0), ("mobius-2", -10_000.0), ("mobius-2", 0.0)])
def test_robot_without_tags_surfaces_though_it_believes_to_be_there_and_rests_there(scenario: str, offset_pa: float) -> None:
    """A pressure sensor that reads too shallow kept it down. Up there, a healthy robot used to lift itself half out of the water."""
    depth_m: list[float] = []
    current_a: list[float] = []

    def lie(bench: Bench) -> None:
        step, asked = bench.firmware.pipeline.step, {250: Mode.ALT_HOLD, 600: Mode.SURFACE}

        def told(inputs: Inputs) -> Outputs:
            for module in inputs.modules:
                module.pressure_pa = None if module.pressure_pa is None else module.pressure_pa + offset_pa
            if inputs.tick in asked:
                inputs.requests = [Request(Action.SET_MODE, 0, asked[inputs.tick])]
            return step(inputs)

        bench.firmware.pipeline.step = told  # type: ignore[method-assign]

    def watch(bench: Bench, outputs: Outputs) -> None:
        truth = bench.nodes.world.truth(0)
        depth_m.append(float(truth.p_wm[2]))
        current_a.append(truth.current_a)

    fly(scenario, 45.0, Fault(kind="tag_absent", at_s=0.0), lie, watch)
    assert depth_m[600] > 0.8
    assert max(depth_m[-300:]) < 0.2 and np.ptp(depth_m[-300:]) < 0.02
    assert 0.5 < np.mean(current_a[-300:]) < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("action", [Level.WARN, Level.DISARM])
def test_robot_that_swings_as_all_frames_are_late_is_told_of_or_disarmed(action: Level) -> None:
    off_deg: list[float] = []
    told: list[tuple[int, str]] = []

    def watch(bench: Bench, outputs: Outputs) -> None:
        (record,) = outputs.records
        off_deg.append(math.degrees(np.linalg.norm(difference(record.setpoint.q_wb, bench.nodes.world.body_truth(0).q_wb))))
        told.extend((outputs.tick, event.text) for event in outputs.events if "attitude not held" in event.text)
        assert record.state == (State.ARMED if outputs.tick >= 300 and (action == Level.WARN or not told) else State.DISARMED)

    late = Fault(kind="frame_delay", value=130.0, at_s=5.0)
    fly("faults", 25.0, late, lambda bench: None, watch, Parameters().replace("failsafes.attitude_lost_action", int(action)))
    at, text = told[0]
    assert text.startswith("fail-safe on") and np.sqrt(np.mean(np.square(off_deg[at - 300 : at]))) > 25.0 and max(off_deg[300:500]) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize(("force_n", "is_told"), [(20.0, True), (6.0, False)])
def test_robot_that_is_pushed_off_its_place_is_told_of_until_it_is_back(force_n: float, is_told: bool) -> None:
    off_m: list[float] = []
    told: list[tuple[int, str]] = []

    def watch(bench: Bench, outputs: Outputs) -> None:
        (record,) = outputs.records
        off_m.append(float(np.linalg.norm(record.setpoint.p_wb - bench.nodes.world.body_truth(0).p_wb)))
        told.extend((outputs.tick, event.text) for event in outputs.events if "fail-safe" in event.text)

    fly("faults", 25.0, Fault(kind="push", value=force_n, at_s=5.0, until_s=11.0), lambda bench: None, watch)
    if not is_told:
        assert told == [] and 0.02 < max(off_m[300:]) < 0.3
        return
    (begins, text), (ends, last) = told
    assert text.startswith("fail-safe on: place not held: ") and text.endswith(" m off") and last == "fail-safe over: place not held"
    assert min(off_m[begins - 250 : begins]) > 0.5 and max(off_m[300:490]) < 0.05
    assert max(off_m[ends - 150 :]) < 0.5 and off_m[-1] < 0.02


@pytest.mark.slow
def test_robot_that_is_pushed_off_its_place_holds_where_it_is_if_told_to() -> None:
    place: list[np.ndarray] = []
    truth: list[np.ndarray] = []
    told: list[int] = []

    def watch(bench: Bench, outputs: Outputs) -> None:
        place.append(outputs.records[0].setpoint.p_wb.copy())
        truth.append(bench.nodes.world.body_truth(0).p_wb.copy())
        told.extend(len(place) - 1 for event in outputs.events if event.text.startswith("fail-safe on: place not held"))

    push = Fault(kind="push", value=20.0, at_s=5.0, until_s=11.0)
    fly("faults", 25.0, push, lambda bench: None, watch, Parameters().replace("failsafes.place_lost_action", int(Level.HOLD)))
    (at,) = told
    assert 800 < at < 1100 and np.ptp(place[300:at], axis=0).max() < 0.01
    assert np.linalg.norm(place[at] - place[at - 1]) > 1.0 and np.linalg.norm(place[at] - truth[at]) < 0.1
    assert np.ptp(place[at + 200 :], axis=0).max() < 0.01 and np.linalg.norm(truth[-1] - place[-1]) < 0.02


def fly(
    scenario: str, seconds: float, fault: Fault, prepare: Callable[[Bench], None], watch: Callable[[Bench, Outputs], None],
    parameters: Parameters | None = None,
) -> None:  # fmt: skip
    """Flies the bodies of a scenario, which arm at 3 s and hold; `watch` is called once a tick."""

    def requests(time_ns: int, last: Outputs | None) -> list[Request]:
        return [Request(Action.ARM, record.body) for record in last.records] if last and time_ns == 3_000_000_000 else []

    with ExitStack() as stack:
        world = dataclasses.replace(load_scenario(scenario), fault=(fault,))
        bench = open_bench(stack, world, 1, parameters or Parameters(), "virtual:one-fault")
        prepare(bench)
        script = SimpleNamespace(ticks=round(100 * seconds), is_over=lambda time_ns: False, requests=requests)
        bench.script = script
        bench.fly([lambda received, sent, inputs, outputs: watch(bench, outputs)])


@pytest.mark.slow
def test_hover_without_tags_drifts_no_farther_than_it_says_and_less_with_a_quieter_imu() -> None:
    """The drift itself is a figure of `make accept`: gusts that move all the water carry even a perfect filter (tools/accept_safety.py)."""
    shipped, quiet = ([hover_blind(seed, imu) for seed in range(6)] for imu in (None, ICM_20602))
    assert max(flight.error_m for flight in [*shipped, *quiet]) <= 0.25
    assert np.abs([flight.normalised for flight in [*shipped, *quiet]]).max() <= 3.0
    assert np.mean([flight.error_m for flight in quiet]) < 0.9 * np.mean([flight.error_m for flight in shipped])


@pytest.mark.slow
def test_fuzzed_frames_raise_nothing_and_command_nothing_beyond_the_limits() -> None:
    result = fuzz_flight(40_000, seed=3)
    assert result.beyond == 0
    assert result.accepted + sum(result.dropped.values()) == result.frames
    assert result.armed_ticks > 0.1 * result.ticks, "the fuzz is to reach a robot that is armed"
    assert all(count > 50 for count in result.dropped.values())
