"""Parameters set in flight take effect at once without a jump; wrong values are refused with a reason."""

import numpy as np
import pytest

from firmware_py.core.pipeline import Pipeline
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.module_at_rest import PERIOD_NS, resting
from tests.unit.tanks import RING, FaultyTank, Tank, single


@pytest.fixture
def flying() -> Pipeline:
    pipeline = Pipeline([assemble_vehicle(load_vehicle("modcube"))], Parameters(), PERIOD_NS)
    for tick in range(1, 120):
        step(pipeline, tick, [Request(Action.ARM, 0, True)] if tick == 60 else [])
    return pipeline


def step(pipeline: Pipeline, tick: int, requests: list[Request]) -> Outputs:
    return pipeline.step(resting(tick, requests))


def test_gain_set_in_flight_is_used_from_that_tick_on_without_a_jump(flying: Pipeline) -> None:
    before = step(flying, 120, []).records[0].commanded_n
    outputs = step(flying, 121, [Request(Action.SET_PARAMETER, 0, ("control.position_bandwidth", 1.5))])
    assert flying.parameters.control.position_bandwidth == 1.5
    assert np.max(np.abs(outputs.records[0].commanded_n - before)) < 0.2


def test_value_out_of_range_is_refused_in_words_and_changes_nothing(flying: Pipeline) -> None:
    outputs = step(flying, 120, [Request(Action.SET_PARAMETER, 0, ("control.position_bandwidth", 99.0))])
    assert flying.parameters.control.position_bandwidth == Parameters().control.position_bandwidth
    assert any("out of range" in event.text for event in outputs.events)


def fence_after(pipeline: Pipeline, tick: int, *wanted: tuple[str, float]) -> tuple[float, float, list[str]]:
    """Top and bottom of the fence after a tick with these requests, and what was said."""
    outputs = step(pipeline, tick, [Request(Action.SET_PARAMETER, 0, (f"fence.{side}_m", value)) for side, value in wanted])
    fence = pipeline.parameters.fence
    return fence.top_m, fence.bottom_m, [event.text for event in outputs.events]


def test_fence_that_arming_would_refuse_is_refused_in_flight(flying: Pipeline) -> None:
    """A robot told to hold its place went 4 m down instead, to the bottom of a fence whose top was below it."""
    words = "fence.top_m is 60, fence.bottom_m 50: the top must be at less depth"
    assert fence_after(flying, 120, ("top", 60.0)) == (-1.0, 50.0, [f"parameter fence.top_m stays while a vehicle is armed: {words}"])
    assert fence_after(flying, 121, ("top", 49.9)) == (49.9, 50.0, [])


def test_fence_is_moved_in_flight_by_way_of_one_that_is_valid(flying: Pipeline) -> None:
    assert fence_after(flying, 120, ("bottom", 100.0), ("top", 60.0)) == (60.0, 100.0, [])
    *fence, said = fence_after(flying, 121, ("bottom", 3.0), ("top", 0.0))
    assert fence == [0.0, 100.0] and len(said) == 1, "the bottom would have been above the top"
    assert fence_after(flying, 122, ("bottom", 3.0)) == (0.0, 3.0, [])


def test_disarmed_robot_takes_a_file_of_parameters_in_any_order_and_is_not_armed_before_its_end() -> None:
    pipeline = Pipeline([assemble_vehicle(load_vehicle("modcube"))], Parameters(), PERIOD_NS)
    for tick in range(1, 60):
        step(pipeline, tick, [])
    assert fence_after(pipeline, 60, ("top", 60.0)) == (60.0, 50.0, [])
    outputs = step(pipeline, 61, [Request(Action.ARM, 0, True)])
    assert "the top must be at less depth" in outputs.events[0].text and outputs.records[0].state == State.DISARMED
    assert fence_after(pipeline, 62, ("bottom", 100.0)) == (60.0, 100.0, [])
    assert step(pipeline, 63, [Request(Action.ARM, 0, True)]).records[0].state == State.ARMED


def test_fence_stays_while_any_robot_of_the_fleet_is_armed() -> None:
    tank = Tank([single(0), single(1)])
    tank.run(0.5)
    tank.run(0.1, Request(Action.ARM, 1))
    assert [record.state for record in tank.outputs[-1].records] == [State.DISARMED, State.ARMED]
    outputs = tank.run(0.01, Request(Action.SET_PARAMETER, 0, ("fence.top_m", 60.0)))
    assert tank.pipeline.parameters.fence.top_m == -1.0 and len(outputs.events) == 1


def test_limits_set_in_flight_are_those_of_every_stage_from_that_tick_on(flying: Pipeline) -> None:
    """A stage that kept the values it was built with would continue with the old limits."""
    pipeline = flying.formation.pipelines[0]
    wanted = {
        "limiter.force_share": 0.2, "limiter.slew_n_per_s": 20.0, "fence.east_m": 0.1, "failsafes.ground_lost_limit": 0.5,
        "failsafes.leak_action": 5, "supervision.arm_sigma_m": 0.5, "steering.speed_m_s": 0.07, "faults.dead_count": 9,
    }  # fmt: skip
    requests = [Request(Action.SET_PARAMETER, 0, pair) for pair in wanted.items()]
    outputs = step(flying, 120, [*requests, Request(Action.GROUND_ALIVE, 0)])
    assert [event.text for event in outputs.events] == []
    assert pipeline.health.now.outside_m == pytest.approx(0.1, abs=0.01)
    full_n = pipeline.body.thrusters.f_max
    forces, _ = pipeline.limiter.step(10.0 * full_n, True, np.array([12.0]))
    assert np.all(forces <= 0.2 * full_n + 1e-9) and np.all(np.abs(forces - outputs.records[0].commanded_n) <= 0.2 + 1e-9)
    said = []
    for tick in range(121, 175):
        said += [event.text for event in step(flying, tick, []).events]
    assert any("ground station silent for 0.5 s" in text for text in said)
    for tick in range(175, 230):
        wet = resting(tick, [])
        wet.modules[0].leak = True
        outputs = flying.step(wet)
    assert outputs.records[0].state == State.DISARMED, "the leak disarms now"


def test_share_of_a_thruster_test_may_be_set_in_flight(flying: Pipeline) -> None:
    pipeline = flying.formation.pipelines[0]
    step(flying, 120, [Request(Action.SET_PARAMETER, 0, ("steering.test_share", 0.1))])
    pipeline.motor_test.start((2, 1.0, 1.0), 0)
    np.testing.assert_allclose(pipeline.motor_test.step(0)[2], 0.1 * pipeline.body.thrusters.f_max[2])


def test_whole_numbers_set_in_flight_are_flown_with(flying: Pipeline) -> None:
    wanted = {"control.attitude_bandwidth": 2, "control.position_bandwidth": 3}
    outputs = step(flying, 120, [Request(Action.SET_PARAMETER, 0, pair) for pair in wanted.items()])
    outputs = step(flying, 121, [])
    assert flying.parameters.control.attitude_bandwidth == 2.0
    assert np.isfinite(outputs.records[0].commanded_n).all()


def test_of_several_values_of_a_parameter_in_a_tick_the_last_counts() -> None:
    tank = FaultyTank(RING[:2])
    tank.run(0.1)
    tank.run(0.01, *(Request(Action.SET_PARAMETER, 0, ("failsafes.leak_action", value)) for value in (4, 1, 4)))
    assert tank.pipeline.parameters.failsafes.leak_action == 4
