"""Named checks of a run against limits, and result.json. A metric that is missing or NaN fails its check."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

RESULT_FILE = "result.json"


class Limit(NamedTuple):
    """A metric must be within low..high, both included. `name` is what people read; the metric's when empty."""

    metric: str
    low: float = -math.inf
    high: float = math.inf
    name: str = ""


class Check(NamedTuple):
    """One check that was made."""

    name: str
    value: float
    limit: str
    """In words: `<= 0.005`, `>= 25`, `0.7 to 1.4`."""
    passed: bool


class Result(NamedTuple):
    """What a run came to, as result.json holds it."""

    scenario: str
    seed: int
    passed: bool
    metrics: dict[str, float]
    checks: tuple[Check, ...]


def limit_text(limit: Limit) -> str:
    """The range in words."""
    if math.isinf(limit.low):
        return f"<= {limit.high:g}"
    if math.isinf(limit.high):
        return f">= {limit.low:g}"
    return f"{limit.low:g} to {limit.high:g}"


def check_metrics(metrics: Mapping[str, float], limits: Iterable[Limit]) -> tuple[Check, ...]:
    """One check per limit, in order."""
    checks = []
    for limit in limits:
        value = metrics.get(limit.metric, math.nan)
        passed = limit.low <= value <= limit.high  # False for NaN
        checks.append(Check(limit.name or limit.metric, value, limit_text(limit), passed))
    return tuple(checks)


def judge(scenario: str, seed: int, metrics: Mapping[str, float], limits: Iterable[Limit]) -> Result:
    """The result of a run: passed when every check passed and there is at least one."""
    checks = check_metrics(metrics, limits)
    return Result(scenario, seed, bool(checks) and all(c.passed for c in checks), dict(metrics), checks)


def write_result(result: Result, folder: Path) -> Path:
    """Write result.json into `folder`; NaN and infinity, which JSON lacks, become null. Returns its path."""
    plain = result._asdict() | {
        "metrics": {name: _number(value) for name, value in result.metrics.items()},
        "checks": [check._asdict() | {"value": _number(check.value)} for check in result.checks],
    }
    path = folder / RESULT_FILE
    path.write_text(json.dumps(plain, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path


def _number(value: float) -> Any:
    if not math.isfinite(value):
        return None
    return int(value) if float(value).is_integer() and abs(value) < 2**53 else float(value)
