"""One module holds its place in the tank, closed loop over real frames."""

from pathlib import Path

import numpy as np
import pytest

from firmware_py.description.parameters import Parameters
from hil.bench import fly_scenario
from hil.metrics import rotation_vectors
from hil.signals import read_flight
from tests.closed_loop.flights import Fly, shortened

HOVER_S = 20.0
"""Duration flown, of the scenario's 60 s; the full length belongs to `make accept`."""
SINGLE_SEED_LIMIT_M = 0.005


@pytest.mark.slow
def test_module_in_still_water_with_ideal_sensors_keeps_its_place_within_half_a_millimetre(fly: Fly) -> None:
    result = fly(shortened("hover", HOVER_S).with_calm_world().with_ideal_sensors())
    assert result.passed
    assert result.metrics["position_rmse_m"] <= 0.0005  # 0.18 mm measured; the tag's frame has steps of 0.5 mm
    assert result.metrics["attitude_rmse_rad"] <= 0.003  # encoding one tag attitude costs 0.0031 rad RMS: can_dbc/README.md


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_module_with_real_sensors_in_a_gusty_current_keeps_its_place_within_five_millimetres(
    fly: Fly, seed: int
) -> None:
    result = fly(shortened("hover", HOVER_S), seed)
    assert result.passed
    assert 0.0005 <= result.metrics["position_rmse_m"] <= SINGLE_SEED_LIMIT_M  # below 0.5 mm the estimator would have to leak the truth
    assert result.metrics["ticks"] == pytest.approx(100 * HOVER_S, abs=1)
    assert result.metrics["unmatched_ticks"] == 0


@pytest.mark.slow
def test_estimate_of_a_hovering_module_is_as_good_as_it_says(fly: Fly) -> None:
    metrics = fly(shortened("hover", HOVER_S), 2).metrics
    assert 0.7 <= metrics["nis_mean"] <= 1.4
    assert metrics["sigma3_share"] >= 0.95
    assert metrics["estimate_position_rmse_m"] <= 0.003


def errors_in_sigmas(folder: Path, seed: int, rate_hz: int) -> np.ndarray:
    """(k, 6) errors of the estimated pose in a settled hover, in the estimator's own sigmas."""
    folder.mkdir()
    scenario = shortened("hover", 10.0, settle_s=5.0)
    fly_scenario(scenario, seed, Parameters(), folder, f"virtual:{folder.name}", rate_hz)
    flight = read_flight(folder)
    error = np.hstack([flight.firmware["p_wb"] - flight.p_wb, rotation_vectors(flight.firmware["q_wb"], flight.q_wb)])
    sigmas = np.hstack([flight.firmware["sigma_p"], flight.firmware["sigma_q"]])
    return (error / sigmas)[flight.time_s > scenario.task.settle_s]


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [50, 100, 200, 400])
def test_estimate_is_as_good_as_it_says_at_every_tick_rate(rate_hz: int, tmp_path: Path) -> None:
    """Uses several seeds, because the mean tag error of a flight is a single draw that turns the whole flight alike (seed 3)."""
    off = np.vstack([errors_in_sigmas(tmp_path / f"{rate_hz}-{seed}", seed, rate_hz) for seed in range(4)])
    assert 0.5 <= np.mean(np.square(off)) <= 1.2
    assert np.mean(np.abs(off) <= 3.0) >= 0.985
