"""Bodies of several modules fly their paths with the gains of a single one; all seeds belong to `make accept`."""

import dataclasses

import pytest

from hil.force_metrics import force_names
from hil.metrics import SHOWN
from hil.scenario import load_scenario
from tests.closed_loop.flights import Fly, shortened

ATTITUDE_LIMIT_RAD = 0.0436332
"""2.5 deg."""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "ideal", "limit_m"), [("mobius-1", True, 0.0055), ("mobius-2", False, 0.007), ("mobius-4", False, 0.007)])
def test_moebius_strip_is_flown_by_one_two_and_four_modules(fly: Fly, name: str, ideal: bool, limit_m: float) -> None:
    scenario = load_scenario(name)
    metrics = fly(scenario.with_ideal_sensors() if ideal else scenario, 0).metrics
    assert 0.001 <= metrics["position_rmse_m"] <= limit_m
    assert metrics["attitude_rmse_rad"] <= ATTITUDE_LIMIT_RAD


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 8])
def test_healthy_robot_that_turns_over_in_a_current_keeps_all_its_thrusters(fly: Fly, seed: int) -> None:
    """The righting arm is off by 3 and 4 mm, and the current meets the robot from all sides; neither motion is a thruster's fault."""
    assert fly(load_scenario("mobius-1").with_ideal_sensors(), seed).metrics["warnings"] == 0.0


@pytest.mark.slow
def test_random_shape_of_modules_flies_a_closed_curve(fly: Fly) -> None:
    assert 0.001 <= fly(load_scenario("polycube"), 0).metrics["position_rmse_m"] <= 0.015


@pytest.mark.slow
def test_force_of_two_docked_modules_is_tracked_as_well_as_that_of_one_without_interference(fly: Fly) -> None:
    scenario = shortened("force-tracking", 40.0)
    half = tuple(dataclasses.replace(jets, until_s=scenario.task.settle_s + 0.5 * scenario.task.duration_s) for jets in scenario.fault)
    result = fly(dataclasses.replace(scenario, fault=half), 0)
    assert result.passed
    assert set(result.metrics) - set(SHOWN) == set(force_names([1, 2]))
