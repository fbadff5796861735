"""Parameters set in flight: they take effect at once, nothing jumps, and what is wrong is refused in words."""

import numpy as np
import pytest

from firmware_py.core.pipeline import Pipeline
from firmware_py.core.rotations import to_matrix
from firmware_py.core.types import Action, Inputs, ModuleInputs, Outputs, Request, TagObservation
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

PERIOD_NS = 10_000_000
PLACE = np.array([0.1, -0.2, 0.5])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def resting(tick: int, requests: list[Request]) -> Inputs:
    """What a module at rest says, every sensor answering."""
    module = ModuleInputs(answered=True, heard=True, gyro=np.zeros(3), accel=-9.80665 * to_matrix(LEVEL)[2].copy())
    module.pressure_pa = 101325.0 + 9806.65 * PLACE[2]
    module.tags = [TagObservation(5, 7, tick * PERIOD_NS, np.add(PLACE, [0.0, 0.0, -0.105]), LEVEL)]
    module.voltage_v, module.current_a = 12.0, 1.0
    module.leak, module.cabin_temperature_c, module.cabin_pressure_pa = False, 30.0, 101325.0
    return Inputs(tick, tick * PERIOD_NS, [module], requests)


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
