"""Docks flown whole, one seed of each scenario; hundreds of seeds belong to `make accept`."""


import pytest

from hil.scenario import load_scenario
from tests.closed_loop.flights import Fly
from tools import near_miss

LARGEST_JUMP_N = 1.0
"""Of a thruster's command in the tick in which two bodies become one."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dock-undock-dock", "dock-third", "dock-vertical"])
def test_modules_dock_and_no_command_jumps(fly: Fly, name: str) -> None:
    metrics = fly(load_scenario(name), 3).metrics
    assert metrics["docked"] == 1.0
    assert metrics["tries"] >= 1.0
    assert metrics["false_declarations"] == 0.0
    assert 0.0 < metrics["join_jump_n"] <= LARGEST_JUMP_N


@pytest.mark.slow
def test_docked_pair_flies_the_moebius_strip_as_one_and_parts_again(fly: Fly) -> None:
    result = fly(load_scenario("dock-mobius"), 0)
    assert result.passed
    assert 0.001 <= result.metrics["docked_rmse_m"] <= 0.007


@pytest.mark.slow
def test_lower_module_that_nobody_sees_is_refused_and_nothing_moves(fly: Fly) -> None:
    result = fly(load_scenario("dock-vertical-blind"), 0)
    assert result.passed
    assert result.metrics["docked"] == 0.0


@pytest.mark.slow
def test_module_that_passes_close_by_with_magnets_on_is_not_believed_docked(fly: Fly) -> None:
    metrics = fly(load_scenario("dock-near-miss"), 0).metrics
    assert metrics["false_declarations"] == 0.0
    assert metrics["docked"] == 1.0  # they are apart, as wanted


@pytest.mark.slow
def test_detector_needs_both_conditions() -> None:
    """Through real frames: each condition alone would have believed in docks that were none; together they believe in none."""
    found = near_miss.count(range(90))
    assert found["misses"] > 40
    assert found["current"] >= 3
    assert found["position"] >= 3
    assert found["declared"] == 0
