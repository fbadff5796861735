"""Campaigns whose flights take no time, for the tests of what campaigns do with their trials."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest

import hil.campaign
from firmware_py.description.parameters import Parameters
from hil.campaign import SUMMARY_FILE, TABLE_FILE, run_campaign
from hil.campaign_summary import Trial
from hil.scenario import Scenario, load_scenario
from hil.workers import Pool


class PlugError(Exception):
    """Stands for a power cut."""


class Inline(Executor):
    """Does the work at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def trial(seed: int, rmse_m: float, outcome: str = "passed") -> Trial:
    metrics = {"position_rmse_m": rmse_m, "nis_mean": None, "duration_s": 40.0}
    return {"seed": seed, "passed": outcome == "passed", "outcome": outcome, "metrics": metrics}


def flying(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, str]]:
    """Makes every flight take no time; returns the list to which each flight will add its (seed, bus)."""
    flown: list[tuple[int, str]] = []

    def fly(scenario: Scenario, parameters: Parameters, seed: int, bus: str, code: str) -> Trial:
        flown.append((seed, bus))
        return {**trial(seed, 0.001 * seed), "world": {"mass_factor": 1.0 + 0.01 * seed}}

    monkeypatch.setattr(hil.campaign, "fly_trial", fly)
    return flown


def fly(out: Path, seeds: range, pool: Pool = Inline, **progress: Any) -> dict[str, Any]:
    return run_campaign(load_scenario("spiral"), Parameters(), seeds, pool, out, **progress)


def content(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in (SUMMARY_FILE, TABLE_FILE)]
