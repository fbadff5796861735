"""Parameters set in flight take effect at once without a jump; wrong values are refused with a reason."""

import numpy as np
import pytest

from firmware_py.core.pipeline import Pipeline
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.module_at_rest import PERIOD_NS, resting
from tests.unit.tanks import RING, FaultyTank


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
