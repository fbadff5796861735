"""A complete flight of a waypoint file: the robot is at each waypoint at the time in the file."""

from pathlib import Path

import numpy as np
import pytest

from firmware_py.core import rotations
from firmware_py.prepare.waypoints import read_mission
from hil.flight import start_of
from hil.scenario import load_scenario
from hil.signals import read_flight
from tests.closed_loop.broken_vehicles import failed, turned_tags
from tests.closed_loop.flights import Fly, Rebuild

POSITION_LIMIT_M, ATTITUDE_LIMIT_RAD = 0.010, 0.0349066
"""Limits at a waypoint: twice the worst tick of three seeds, 4.3 mm; 2 deg."""


@pytest.mark.slow
def test_module_is_at_every_waypoint_of_the_file_at_its_time(fly: Fly, tmp_path: Path) -> None:
    scenario = load_scenario("waypoints")
    result = fly(scenario, 0)
    assert result.passed
    assert result.metrics["position_rmse_m"] >= 0.0005  # below this the estimator would have to leak the truth
    flight = read_flight(tmp_path / "run")
    time_s = (flight.firmware["time_ns"] - start_of(flight)) * 1e-9 - scenario.task.settle_s
    points = read_mission(scenario.task.file_text, scenario.task.file).waypoint
    q_wb = np.array([1.0, 0.0, 0.0, 0.0])
    for point, at_s in zip(points, np.cumsum([p.duration_s for p in points]), strict=True):
        tick = int(np.argmin(np.abs(time_s - at_s)))
        q_wb = np.array(point.quaternion) if len(point.quaternion) else q_wb
        assert np.linalg.norm(flight.p_wb[tick] - point.position_m) <= POSITION_LIMIT_M
        off = rotations.difference(flight.q_wb[tick].copy(), rotations.normalise(q_wb))
        assert np.linalg.norm(off) <= ATTITUDE_LIMIT_RAD


@pytest.mark.slow
def test_tag_glued_on_askew_fails_the_path_too(fly: Fly, rebuild: Rebuild) -> None:
    rebuild(lambda vehicle: turned_tags(vehicle, 2))
    assert {"position_rmse_m", "attitude_rmse_rad"} <= failed(fly(load_scenario("waypoints")))
