"""Many seeds of one scenario, in processes of their own; campaign.json says what came of them."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from firmware_py.description.parameters import Parameters
from hil.flight import fly_and_judge
from hil.scenario import Scenario

SUMMARY_FILE = "campaign.json"
CONFIDENCE = 0.95
WORST = 5
"""Seeds named as the worst."""
QUANTILES = {"min": 0.0, "q05": 0.05, "median": 0.5, "q95": 0.95, "max": 1.0}

Trial = dict[str, Any]


def fly_trial(scenario: Scenario, parameters: Parameters, seed: int, bus: str) -> Trial:
    """One trial, logs thrown away: its seed, whether it passed, and its metrics."""
    with tempfile.TemporaryDirectory() as folder:
        result = fly_and_judge(scenario, seed, parameters, Path(folder), bus)
    failed = [check.name for check in result.checks if not check.passed]
    outcome = "passed" if result.passed else failed[0] if failed else "not checked"
    return {"seed": seed, "passed": result.passed, "outcome": outcome, "metrics": result.metrics}


def run_campaign(
    scenario: Scenario,
    parameters: Parameters,
    seeds: Sequence[int],
    jobs: int,
    out: Path,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Flies every seed and writes campaign.json into `out`; returns its content. `executor` replaces the processes."""
    out.mkdir(parents=True, exist_ok=True)
    pool = executor or ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))
    trials: list[Trial] = []
    with pool:
        futures = [pool.submit(fly_trial, scenario, parameters, seed, f"virtual:trial{seed}") for seed in seeds]
        for future in as_completed(futures):
            trials.append(future.result())
            if progress is not None:
                progress(len(trials), len(futures))
    summary = summarise(scenario.name, sorted(trials, key=lambda trial: int(trial["seed"])))
    (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return summary


def summarise(scenario: str, trials: Sequence[Trial]) -> dict[str, Any]:
    """The content of campaign.json. The interval is Wilson's."""
    succeeded = sum(bool(trial["passed"]) for trial in trials)
    interval = binomtest(succeeded, len(trials)).proportion_ci(CONFIDENCE, method="wilson")
    outcomes: dict[str, int] = {}
    for trial in trials:
        outcomes[trial["outcome"]] = outcomes.get(trial["outcome"], 0) + 1
    worst = sorted(trials, key=lambda trial: -trial["metrics"].get("position_rmse_m", 0.0))[:WORST]
    return {
        "scenario": scenario,
        "trials": len(trials),
        "succeeded": succeeded,
        "outcomes": outcomes,
        "confidence_interval": [interval.low, interval.high],
        "metrics": {name: _quantiles(trial["metrics"].get(name) for trial in trials) for name in trials[0]["metrics"]},
        "worst_seeds": [trial["seed"] for trial in worst],
        "seeds": [trial["seed"] for trial in trials],
    }


def _quantiles(values: Iterable[float | None]) -> Mapping[str, float | None]:
    known = np.array([v for v in values if v is not None and np.isfinite(v)])
    return {name: float(np.quantile(known, q)) if known.size else None for name, q in QUANTILES.items()}
