"""Many seeds of one scenario: what campaign.json says of them, and what people see."""

import io
import json
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import hil.campaign
from firmware_py.description.parameters import Parameters
from hil.campaign import Trial, run_campaign, summarise
from hil.console import campaign_progress, print_campaign
from hil.scenario import Scenario, load_scenario


class Inline(Executor):
    """Does the work at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def trial(seed: int, rmse_m: float, outcome: str = "passed") -> Trial:
    metrics = {"position_rmse_m": rmse_m, "nis_mean": float("nan"), "duration_s": 40.0}
    return {"seed": seed, "passed": outcome == "passed", "outcome": outcome, "metrics": metrics}


TRIALS = [trial(0, 0.003), trial(1, 0.011, "position_rmse_m"), trial(2, 0.004), trial(3, 0.005)]


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
    # 17 of 20, the paper's docking; by hand out of Wilson's formula, z = 1.96: 0.7936 +- 0.1540
    trials = [trial(seed, 0.001, "passed" if seed < 17 else "jammed") for seed in range(20)]
    assert summarise("dock", trials)["confidence_interval"] == pytest.approx([0.6396, 0.9476], abs=1e-4)


def test_campaign_flies_every_seed_and_writes_what_it_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown: list[tuple[int, str]] = []

    def fly(scenario: Scenario, parameters: Parameters, seed: int, bus: str) -> Trial:
        flown.append((seed, bus))
        return trial(seed, 0.001 * seed)

    monkeypatch.setattr(hil.campaign, "fly_trial", fly)
    counted: list[tuple[int, int]] = []

    def count(done: int, total: int) -> None:
        counted.append((done, total))

    summary = run_campaign(load_scenario("spiral"), Parameters(), range(5, 8), 1, tmp_path, Inline(), count)
    assert sorted(seed for seed, _ in flown) == [5, 6, 7]
    assert len({bus for _, bus in flown}) == 3  # trials in one process must not hear each other
    assert counted == [(1, 3), (2, 3), (3, 3)]
    assert summary == json.loads((tmp_path / "campaign.json").read_text())
    assert summary["seeds"] == [5, 6, 7]


def test_table_of_a_campaign_shows_units_failures_and_worst_seeds() -> None:
    console = Console(file=io.StringIO(), width=120)
    print_campaign(summarise("spiral", TRIALS), console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "3 of 4 passed" in text
    assert "4.50 mm" in text
    assert "FAILED: position_rmse_m 1" in text
    assert "worst seeds: 1, 3, 2, 0" in text


def test_progress_of_a_campaign_leaves_no_trace_in_a_file() -> None:
    console = Console(file=io.StringIO(), force_terminal=False)
    with campaign_progress("spiral", 20, console) as count:
        count(1, 20)
    assert console.file.getvalue().strip() == ""  # type: ignore[attr-defined]
