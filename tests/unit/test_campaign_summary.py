"""The summary of many trials, in campaign.json and on the console."""

import io
import math

import numpy as np
import pytest
from rich.console import Console

from hil.campaign_summary import Trial, median_interval, summarise
from hil.console import campaign_progress, print_campaign
from tests.unit.campaigns import trial

TRIALS = [trial(0, 0.003), trial(1, 0.011, "position_rmse_m"), trial(2, 0.004), trial(3, 0.005)]


def test_seeds_that_failed_are_the_worst_however_near_they_flew() -> None:
    assert summarise("dock", [trial(0, 0.9), trial(1, 0.001, "jammed"), trial(2, 0.5)])["worst_seeds"] == [1, 0, 2]
    no_figure = {**trial(3, 0.0, "armed_share"), "metrics": {"position_rmse_m": None}}
    assert summarise("dock", [trial(0, 0.9), trial(1, 0.7, "jammed"), no_figure])["worst_seeds"] == [3, 1, 0]


def test_summary_counts_outcomes_and_names_the_worst_seeds_first() -> None:
    summary = summarise("spiral", TRIALS)
    assert (summary["trials"], summary["succeeded"]) == (4, 3)
    assert summary["outcomes"] == {"passed": 3, "position_rmse_m": 1}
    assert summary["worst_seeds"] == [1, 3, 2, 0]
    assert summary["seeds"] == [0, 1, 2, 3]


def test_quantiles_are_of_the_trials_and_a_metric_nobody_measured_has_none() -> None:
    metrics = summarise("spiral", TRIALS)["metrics"]
    assert metrics["position_rmse_m"]["median"] == pytest.approx(0.0045)
    assert metrics["position_rmse_m"]["max"] == 0.011
    assert metrics["position_rmse_m"]["min"] == 0.003
    assert metrics["nis_mean"]["median"] is None


def test_confidence_interval_is_wilsons() -> None:
    # 17 of 20, the paper's docking; by hand from Wilson's formula, z = 1.96: 0.7936 +- 0.1540
    trials = [trial(seed, 0.001, "passed" if seed < 17 else "jammed") for seed in range(20)]
    assert summarise("dock", trials)["confidence_interval"] == pytest.approx([0.6396, 0.9476], abs=1e-4)


def test_median_lies_between_the_sixth_and_the_fifteenth_of_twenty() -> None:
    # Table of David and Nagaraja: 95.9 % for the 6th and 15th order statistics of 20; no interval of 5 values has 95 %
    assert median_interval(np.arange(1.0, 21.0)) == (6.0, 15.0)
    assert median_interval(np.arange(5.0)) == (None, None)
    assert median_interval(np.arange(6.0)) == (0.0, 5.0)


def worlds(count: int) -> list[Trial]:
    made = [{"mass_factor": i / count, "trim_m": (17 * i) % count / count, "still": 0.0} for i in range(count)]
    return [{**trial(i, 0.001 * math.exp(3.0 * world["mass_factor"])), "world": world} for i, world in enumerate(made)]


def test_metric_that_follows_a_parameter_of_the_world_shows_it_and_one_that_does_not_shows_none() -> None:
    found = summarise("spiral", worlds(40))["sensitivities"]["position_rmse_m"]
    assert found["mass_factor"]["rho"] == pytest.approx(1.0) and found["mass_factor"]["low"] > 0.99
    assert found["trim_m"]["low"] < 0.0 < found["trim_m"]["high"]
    assert "still" not in found
    assert not summarise("spiral", worlds(9))["sensitivities"]


def test_people_read_what_a_metric_goes_with() -> None:
    console = Console(file=io.StringIO(), width=160)
    print_campaign(summarise("spiral", worlds(40)), console)
    assert "Position RMSE, truth against reference goes with: mass_factor 1.00 (" in console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.slow
def test_noise_goes_with_nothing_and_a_true_cause_is_still_named() -> None:
    rng = np.random.default_rng(0)
    named = {"noise": 0, "cause": 0}
    for _ in range(60):
        world = rng.standard_normal((40, 13))
        for kind, share in (("noise", 0.0), ("cause", 1.0)):
            errors = share * world[:, 3:4] + rng.standard_normal((40, 2))
            trials = [
                {
                    **trial(i, 0.0),
                    "metrics": {"position_rmse_m": position, "attitude_rmse_rad": attitude},
                    "world": {f"w{k}": value for k, value in enumerate(world[i])},
                }
                for i, (position, attitude) in enumerate(errors)
            ]
            said = io.StringIO()
            print_campaign(summarise("spiral", trials), Console(file=said, width=160))
            named[kind] += ("goes with:" if kind == "noise" else "goes with: w3 ") in said.getvalue()
    assert named["noise"] <= 6 and named["cause"] >= 57


def test_table_of_a_campaign_shows_units_failures_and_worst_seeds() -> None:
    console = Console(file=io.StringIO(), width=120)
    print_campaign(summarise("spiral", TRIALS), console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "3 of 4 passed" in text
    assert "4.50 mm" in text
    assert "1 of 4 failed: Position RMSE, truth against reference" in text
    assert "worst seeds: 1, 3, 2, 0" in text


def test_campaign_that_passed_names_no_worst_seeds_where_those_are_all() -> None:
    said = io.StringIO()
    print_campaign(summarise("spiral", [{**each, "passed": True, "outcome": "passed"} for each in TRIALS]), Console(file=said, width=120))
    assert "4 of 4 passed" in said.getvalue()
    assert "worst seeds" not in said.getvalue()


def test_progress_of_a_campaign_is_a_line_for_each_tenth_in_a_file() -> None:
    """A thousand trials take a quarter of an hour, and printed nothing until the end in a pipe."""
    said = io.StringIO()
    with campaign_progress("dock, 1000 seeds", 1000, Console(file=said, force_terminal=False)) as count:
        for done in range(101, 302):  # the first hundred are there already
            count(done, 1000)
    assert said.getvalue() == "dock, 1000 seeds: 200 of 1000 flown\ndock, 1000 seeds: 300 of 1000 flown\n"
