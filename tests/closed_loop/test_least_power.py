"""Least-power against least-squares allocation on the Moebius strip, at the scenario's speed: less supply power, same path."""

import dataclasses

import pytest

from firmware_py.description.parameters import CONTROLLERS
from tests.closed_loop.flights import Fly, shortened

LAPS, LAP_S = 1.0, 30.0
"""Laps flown, of the scenario's two in 60 s; both, and more worlds, belong to `make accept`."""


@pytest.mark.slow
def test_least_power_takes_five_percent_less_from_the_supply_on_the_same_path(fly: Fly) -> None:
    scenario = shortened("mobius-1", LAPS * LAP_S, 8.0)
    scenario = dataclasses.replace(scenario, task=dataclasses.replace(scenario.task, turns=LAPS))
    squares = fly(scenario, 0, folder="squares")
    power = fly(scenario, 0, CONTROLLERS["least_power"], "power")
    assert squares.passed and power.passed
    assert power.metrics["supply_power_w"] <= 0.95 * squares.metrics["supply_power_w"]  # electronics included
    assert power.metrics["position_rmse_m"] == pytest.approx(squares.metrics["position_rmse_m"], rel=0.05)
    assert 0.0 < power.metrics["wrench_margin_min"] < 1.0
