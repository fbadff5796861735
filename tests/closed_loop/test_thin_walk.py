"""The main uses once each, end to end: the vehicle's process, a tuning script, and a dock seen through the bus."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from firmware_py.app.replay import replay
from firmware_py.description.parameters import Parameters
from firmware_py.description.signals import read_signals
from hil.flight import fly_and_judge
from hil.scenario import load_scenario
from hil.signals import read_flight
from tests.closed_loop.processes import free_group, running


@pytest.mark.slow
def test_vehicle_process_arms_holds_and_disarms_when_it_is_asked_to_stop(tmp_path: Path) -> None:
    bus = free_group()
    with running("hil", "plant", "hover", "--bus", bus) as plant:
        plant.wait_for("plant of hover")
        with running("run", "--bus", bus, "--hold", "--stats", "--out", str(tmp_path / "log")) as vehicle:
            vehicle.wait_for("DISARMED", "ARMED POSHOLD")
            rest = vehicle.end()
        plant.end()
    assert "-> DISARMED" in rest
    assert "lateness_p99_ns" in rest
    assert "compute, ticks\n" in rest
    outcome = replay(tmp_path / "log")
    assert (outcome.first, outcome.torn) == (None, "")
    times = read_signals(tmp_path / "log" / "signals.mcap")["/firmware/times"]
    for name in ("lateness_ticks", "compute_ticks"):
        assert np.sum(times[name][-1]) == times["tick"][-1] == outcome.ticks
    assert (tmp_path / "log" / "can.log").stat().st_size > 0


@pytest.mark.slow
def test_tuning_script_betters_one_detuned_axis_on_worlds_that_it_never_saw(tmp_path: Path) -> None:
    start = tmp_path / "detuned.toml"
    start.write_text("[control]\nposition_bandwidth = 0.9\n", encoding="utf-8")
    command = [sys.executable, "tools/tune_gains.py", "tools/objectives/hover.toml", "--trials", "4", "--jobs", "1", "--no-plots"]
    subprocess.run([*command, "--start", str(start), "--out", str(tmp_path)], check=True, capture_output=True)
    result = json.loads((tmp_path / "tuning.json").read_text(encoding="utf-8"))
    assert result["best_value"] < 0.8 * result["start_value"]
    assert result["unseen"]["tuned"]["objective"] < 1.1 * result["unseen"]["shipped"]["objective"] < 0.8 * result["start_value"]
    again = subprocess.run(
        [*command, "--start", str(start), "--out", str(tmp_path)], check=True, capture_output=True, text=True
    )
    assert "trial" not in again.stdout, "four trials were done already"


@pytest.mark.slow
def test_both_conditions_of_a_dock_are_seen_through_real_frames(tmp_path: Path) -> None:
    scenario = load_scenario("dock")
    result = fly_and_judge(scenario, 0, Parameters(), tmp_path, "virtual:thin-walk-dock")
    assert result.passed
    assert result.metrics["docked"] == 1
    flight = read_flight(tmp_path)
    said = [str(text) for text in flight.events["text"]]
    assert any("-> DOCKED" in text for text in said)
    docks = read_signals(tmp_path / "signals.mcap")["/firmware/docks"]
    for condition in ("current_holds", "position_holds"):
        assert docks[condition][-1] and not docks[condition][0]
    assert np.isfinite(result.metrics["position_rmse_m"])
