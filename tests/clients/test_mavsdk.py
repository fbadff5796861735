"""MAVSDK 4 flies the robot in its tank, as any program would."""

import json
import subprocess
from typing import Any

import pytest

from tests.clients.bench_process import CLIENT_PYTHON, ROOT, flying_bench, free_port
from tests.figures import figure

pytestmark = [pytest.mark.clients, pytest.mark.slow]

SESSION_S = 420
MISSION_RMSE_MM = 10.0


@pytest.fixture(scope="module")
def session() -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """The output of each step of the session, and the errors of the flight."""
    port = free_port()
    with flying_bench(f"udpout:127.0.0.1:{port}") as bench:
        command = [str(CLIENT_PYTHON), str(ROOT / "tests/clients/mavsdk_session.py"), f"udpin://127.0.0.1:{port}"]
        run = subprocess.run(command, capture_output=True, text=True, timeout=SESSION_S)
        assert run.returncode == 0, run.stdout + run.stderr
        lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
        return {line["step"]: line for line in lines}, bench.land()


def test_mavsdk_connects_and_sees_telemetry(session: tuple[dict[str, Any], dict[str, Any]]) -> None:
    telemetry = session[0]["telemetry"]
    assert telemetry["home"] == pytest.approx(30.2084)
    assert not telemetry["in_air"]


def test_mavsdk_reads_every_parameter_and_sets_one(session: tuple[dict[str, Any], dict[str, Any]]) -> None:
    from firmware_py.description.parameters import registry

    parameters = session[0]["parameters"]
    assert (parameters["floats"], parameters["ints"]) == (sum(bool(limits.mavlink) for _, limits in registry()), 0)
    assert parameters["after"] == pytest.approx(parameters["before"] + 0.1)


def test_mavsdk_takes_a_mission_up_and_down(session: tuple[dict[str, Any], dict[str, Any]]) -> None:
    mission = session[0]["mission"]
    assert mission["up"] == mission["down"] == 8
    assert mission["altitude"] == pytest.approx(-0.38)


def test_mission_of_eight_waypoints_is_flown_within_10_mm(session: tuple[dict[str, Any], dict[str, Any]]) -> None:
    steps, errors = session
    assert steps["flown"]["progress"] == list(range(9))
    assert steps["flown"]["ned"] == pytest.approx([0.0, 0.0, 0.38], abs=0.03)
    assert errors["AUTO"]["path_m"] > 1.5
    figure("mission of 8 waypoints by MAVSDK: position RMSE", errors["AUTO"]["rmse_mm"], "mm")
    assert errors["AUTO"]["rmse_mm"] <= MISSION_RMSE_MM


def test_mavsdk_steers_by_hand_and_by_setpoints(session: tuple[dict[str, Any], dict[str, Any]]) -> None:
    steps, _ = session
    assert steps["manual"]["moved"][0] > 0.05
    assert abs(steps["manual"]["moved"][1]) < 0.03 and abs(steps["manual"]["moved"][2]) < 0.03
    assert {"armed", "hold", "offboard", "disarmed"} <= steps.keys()
