"""The metrics of a flight: known errors give known values, and nothing is left out."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.runtime.recorder import Recorder
from hil.checks import Flown, Limit, check_metrics, judge, write_result
from hil.flight import judge_logs, passive_in, ticks_of
from hil.force_metrics import force_metrics
from hil.metrics import Poses, flight_metrics, nis_mean, passive_words, rate_rms, rotation_vectors, shown, warnings
from hil.scenario import load_scenario
from hil.signals import Flight, read_flight
from hil.truth_log import TruthRecorder
from tests.unit.flights import MARGIN, POWER_W, START_NS, write_flight, write_pair

LIMITS = (Limit("position_rmse_m", high=0.005), Limit("nis_mean", 0.7, 1.4))


def spiral_of(folder: Path, duration_s: float = 5.0, **errors: object) -> Flight:
    write_flight(folder, duration_s=duration_s, **errors)  # type: ignore[arg-type]
    return read_flight(folder).between(START_NS, START_NS + round(duration_s * 1e9))


def test_robot_beside_its_path_shows_that_distance(tmp_path: Path) -> None:
    metrics = flight_metrics(spiral_of(tmp_path, offset_m=(0.003, 0.0, -0.004), noise=0.0))
    assert metrics["position_rmse_m"] == pytest.approx(0.005, abs=1e-12)
    assert metrics["position_max_m"] == pytest.approx(0.005, abs=1e-12)
    assert metrics["attitude_rmse_rad"] == pytest.approx(0.0, abs=1e-12)
    assert metrics["estimate_position_rmse_m"] == pytest.approx(0.0, abs=1e-12)


def test_robot_is_measured_by_the_task_and_not_by_what_it_wants_itself(tmp_path: Path) -> None:
    flight = spiral_of(tmp_path, noise=0.0)
    quarter = np.tile([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], (501, 1))
    metrics = flight_metrics(flight, wanted=Poses(flight.firmware["setpoint_p_wb"] + [0.0, 0.3, 0.0], quarter))
    assert metrics["position_rmse_m"] == metrics["position_max_m"] == pytest.approx(0.3, abs=1e-12)
    assert metrics["attitude_rmse_rad"] == pytest.approx(math.pi / 2, abs=1e-9)
    assert metrics["estimate_position_rmse_m"] == pytest.approx(0.0, abs=1e-12)


def test_estimate_beside_the_truth_shows_that_distance_and_angle_and_leaves_three_sigma(tmp_path: Path) -> None:
    flight = spiral_of(tmp_path, noise=0.0)
    flight.firmware["p_wb"][:, 0] += 0.0025  # its sigma is 0.8 mm
    flight.firmware["q_wb"][:] = [math.cos(0.005), 0.0, 0.0, math.sin(0.005)]
    flight.firmware["sigma_q"][:, 2] = 0.0034
    metrics = flight_metrics(flight)
    assert metrics["estimate_position_rmse_m"] == pytest.approx(0.0025, abs=1e-12)
    assert metrics["estimate_attitude_rmse_rad"] == pytest.approx(0.01, abs=1e-9)
    assert (metrics["sigma3_share_x"], metrics["sigma3_share_yaw"], metrics["sigma3_share"]) == (0.0, 1.0, 0.0)


def test_thrust_is_rooted_and_refused_tags_are_counted(tmp_path: Path) -> None:
    flight = spiral_of(tmp_path, noise=0.0)
    flight.firmware["commanded_n"][:] = np.where(np.arange(501) % 2 == 0, 3.0, 1.0)[:, None]
    flight.firmware["rejected"][:] = np.repeat([7, 9, 2], 167)  # a joined body starts its count again
    metrics = flight_metrics(flight)
    assert metrics["thrust_rms_n"] == pytest.approx(math.sqrt((251 * 9 + 250) / 501))
    assert metrics["tags_rejected"] == 2


def test_power_is_that_of_all_modules_whichever_body_they_are_in(tmp_path: Path) -> None:
    write_pair(tmp_path, ticks=100, joined_from=40, known_from=60, offset_m=(0.0, 0.0, 0.0))
    assert flight_metrics(read_flight(tmp_path))["supply_power_w"] == pytest.approx(2 * POWER_W)


def test_flight_without_a_tick_has_no_figures(tmp_path: Path) -> None:
    metrics = flight_metrics(spiral_of(tmp_path).between(0, 0))
    assert "position_rmse_m" in metrics and all(math.isnan(value) for value in metrics.values())


def test_tilted_robot_shows_its_angle(tmp_path: Path) -> None:
    metrics = flight_metrics(spiral_of(tmp_path, tilt_rad=(0.03, 0.0, -0.04), noise=0.0))
    assert metrics["attitude_rmse_rad"] == pytest.approx(0.05, abs=1e-9)
    assert metrics["attitude_max_rad"] == pytest.approx(0.05, abs=1e-9)


def test_rotation_that_is_left_to_buoyancy_is_shown_by_itself_and_is_no_attitude_error(tmp_path: Path) -> None:
    flight = dataclasses.replace(spiral_of(tmp_path, tilt_rad=(0.03, 0.2, 0.0), noise=0.0), passive=(4,))
    metrics = flight_metrics(flight)
    assert metrics["attitude_rmse_rad"] == metrics["attitude_max_rad"] == pytest.approx(0.03, abs=1e-9)
    assert metrics["passive_pitch_max_rad"] == pytest.approx(0.2, abs=1e-9)
    assert not {"passive_roll_max_rad", "passive_yaw_max_rad"} & set(metrics)
    assert flight.between(START_NS, START_NS).passive == (4,)
    assert passive_words(flight) == "\nwithout passive pitch"
    assert "not in the attitude errors" in shown("passive_pitch_max_rad").label


@pytest.mark.parametrize(("vehicle", "passive"), [("bluerov2", (4,)), ("girona500", (3,)), ("modcube", ())])
def test_judged_flight_leaves_out_the_rotation_that_its_vehicle_declares_passive(vehicle: str, passive: tuple[int, ...]) -> None:
    assert passive_in(load_scenario("spiral").with_vehicle(vehicle)) == passive


def test_every_tick_of_the_trajectory_counts(tmp_path: Path) -> None:
    metrics = flight_metrics(spiral_of(tmp_path), wall_s=0.1)
    assert metrics["ticks"] == 501
    assert metrics["unmatched_ticks"] == 0
    assert metrics["duration_s"] == pytest.approx(5.0)
    assert metrics["real_time_factor"] == pytest.approx(50.1)
    assert metrics["deadline_misses"] == 0
    assert (metrics["supply_power_w"], metrics["wrench_margin_min"]) == (POWER_W, MARGIN)


@pytest.mark.slow
def test_honest_filter_is_consistent_in_all_six_axes(tmp_path: Path) -> None:
    metrics = flight_metrics(spiral_of(tmp_path, duration_s=20.0))
    assert 0.85 < metrics["nis_mean"] < 1.15
    assert all(metrics[f"sigma3_share_{axis}"] > 0.97 for axis in ("x", "y", "z", "roll", "pitch", "yaw"))
    assert metrics["sigma3_share"] == min(v for k, v in metrics.items() if k.startswith("sigma3_share_"))


def test_rate_of_a_sine_is_its_frequency_times_its_rms_and_thrusters_that_fell_silent_do_not_count() -> None:
    time = np.arange(2000) * 0.001
    force = np.stack([3.0 * np.sin(2.0 * np.pi * 5.0 * time), np.full(2000, np.nan)], axis=1)
    assert rate_rms(force, 0.001) == pytest.approx(3.0 / math.sqrt(2.0) * 2.0 * np.pi * 5.0, rel=1e-3)
    assert math.isnan(rate_rms(force[:1], 0.001))


def test_one_bad_tick_is_seen_in_the_worst_error(tmp_path: Path) -> None:
    flight = spiral_of(tmp_path, noise=0.0)
    flight.truth["p_wb"][100, 2] += 0.5
    metrics = flight_metrics(flight)
    assert metrics["position_max_m"] == pytest.approx(0.5)
    assert metrics["position_rmse_m"] == pytest.approx(0.5 / math.sqrt(501))
    assert metrics["sigma3_share_z"] == pytest.approx(500 / 501)


def test_filter_without_tags_has_no_consistency_and_fails_its_check() -> None:
    value = nis_mean(np.array([np.nan, np.nan]), np.array([0, 0]))
    assert math.isnan(value)
    assert not check_metrics({"nis_mean": value}, LIMITS[1:])[0].passed


def test_consistency_weighs_every_update_alike() -> None:
    assert nis_mean(np.array([6.0, np.nan, 18.0]), np.array([6, 0, 12])) == pytest.approx(24 / 18)


def test_attitude_error_agrees_with_scipy() -> None:
    rng = np.random.default_rng(5)
    a, b = (Rotation.from_quat(rng.normal(size=(200, 4))) for _ in range(2))
    scalar_first = [np.roll(r.as_quat(), 1, axis=1) for r in (a, b)]
    np.testing.assert_allclose(rotation_vectors(*scalar_first), (b.inv() * a).as_rotvec(), atol=1e-12)


def test_attitude_error_is_the_short_way_round() -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0]])
    assert np.linalg.norm(rotation_vectors(-q, q)) == 0.0
    tiny = np.array([[1.0, 5e-14, 0.0, 0.0]])
    np.testing.assert_allclose(rotation_vectors(tiny, q), [[1e-13, 0.0, 0.0]], rtol=1e-6)


def test_run_passes_only_when_every_check_does() -> None:
    good = {"position_rmse_m": 0.005, "nis_mean": 1.0}
    assert judge("spiral", 3, good, LIMITS).passed
    assert not judge("spiral", 3, good | {"nis_mean": 1.41}, LIMITS).passed
    assert not judge("spiral", 3, {"nis_mean": 1.0}, LIMITS).passed
    assert not judge("spiral", 3, good, ()).passed


def test_result_file_has_the_agreed_shape(tmp_path: Path) -> None:
    metrics = {"position_rmse_m": 0.0026, "nis_mean": math.nan, "ticks": 4001.0}
    result = judge("spiral", 3, metrics, LIMITS, ("1.0 s: leak",))
    flown = Flown("0.1.0", "paper", ("modcube",))
    path = write_result(result._replace(unusual=("paper", "ideal"), flown=flown), tmp_path)
    assert json.loads(path.read_text()) == {
        "scenario": "spiral",
        "seed": 3,
        "version": "0.1.0",
        "controller": "paper",
        "vehicles": ["modcube"],
        "unusual": ["paper", "ideal"],
        "passed": False,
        "metrics": {"position_rmse_m": 0.0026, "nis_mean": None, "ticks": 4001},
        "checks": [
            {"name": "position_rmse_m", "value": 0.0026, "limit": "<= 0.005", "passed": True},
            {"name": "nis_mean", "value": None, "limit": "0.7 to 1.4", "passed": False},
        ],
        "warnings": ["1.0 s: leak"],
    }


def test_missing_truth_is_said_and_not_passed_over(tmp_path: Path) -> None:
    with TruthRecorder(tmp_path, (8,)):
        Recorder(tmp_path).close()
    with pytest.raises(ValueError, match="no truth of the first body"):
        read_flight(tmp_path)
    with pytest.raises(OSError):
        read_flight(tmp_path / "elsewhere")


def test_every_warning_counts_but_waiting_for_the_first_tags() -> None:
    texts = np.array(["ARM refused: no pose yet", "armed", "thruster 1 of module 1 does not push as it says: left out", "leak"])
    assert warnings(np.array([4, 6, 4, 2]), texts) == 2
    assert warnings(np.zeros(0, np.int64), np.zeros(0, str)) == 0


def test_truth_is_told_of_the_body_that_the_firmware_steers(tmp_path: Path) -> None:
    """Faces lock and open before the firmware knows it: motion of the other modules is no error of the body that it steers."""
    times = {"joined_from": 40, "known_from": 60, "parted_from": 120, "parted_known_from": 150}
    write_pair(tmp_path, ticks=200, offset_m=(0.003, 0.0, -0.004), **times)
    flight = read_flight(tmp_path)
    off_m = np.linalg.norm(flight.p_wb - flight.firmware["setpoint_p_wb"], axis=1)
    np.testing.assert_allclose(off_m, 0.005, atol=1e-9)
    turned = rotation_vectors(flight.q_wb, flight.firmware["setpoint_q_wb"])
    np.testing.assert_allclose(turned, np.full((200, 3), -0.01), atol=1e-9)


def test_force_of_a_robot_that_never_pushed_has_no_difference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("force-tracking")
    time_ns = np.arange(1, 8501) * 10_000_000
    still = {"tick": np.arange(1, 8501), "time_ns": time_ns, "wrench_wanted": np.zeros((8500, 6)), "load": np.zeros((8500, 6))}
    logs = {f"/{side}/body{leader}": still for side in ("firmware", "plant") for leader in (0, 1)}
    monkeypatch.setattr("hil.force_metrics.read_signals", lambda path: logs)
    assert np.isnan(force_metrics(scenario, tmp_path, 0)["force_difference_off"])


@pytest.mark.parametrize(("settle_s", "duration_s", "ticks"), [(3.0, 4.0, 401), (3.0, 0.1, 11), (3.005, 4.0, 400), (3.005, 4.005, 401)])
def test_task_has_a_tick_at_either_end(settle_s: float, duration_s: float, ticks: int) -> None:
    scenario = load_scenario("hover")
    scenario = dataclasses.replace(scenario, task=dataclasses.replace(scenario.task, settle_s=settle_s, duration_s=duration_s))
    assert ticks_of(scenario, 10_000_000) == ticks


def test_ticks_that_a_log_may_lack_are_a_whole_number(tmp_path: Path) -> None:
    write_flight(tmp_path, duration_s=2.0)
    scenario = load_scenario("hover")
    task = dataclasses.replace(scenario.task, settle_s=0.0, duration_s=1.5)
    result = judge_logs(dataclasses.replace(scenario, task=task), 0, tmp_path, lost_share=0.0133)
    assert [check.limit for check in result.checks if check.name == "unmatched_ticks"] == ["<= 2"]
