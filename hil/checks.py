"""Named checks of a run against limits, and result.json. A metric that is missing or NaN fails its check."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

RESULT_FILE = "result.json"
UNBOUNDED = 1e9
"""A bound of this size or more means no bound."""


class Bounds(Protocol):
    """A metric must be within low..high, both included."""

    @property
    def metric(self) -> str: ...
    @property
    def low(self) -> float: ...
    @property
    def high(self) -> float: ...


class Limit(NamedTuple):
    """The bounds of one metric."""

    metric: str
    low: float = -math.inf
    high: float = math.inf


class Check(NamedTuple):
    """One check that was made."""

    name: str
    value: float
    low: float
    high: float
    passed: bool

    @property
    def limit(self) -> str:
        """The bounds in words, in the metric's own unit: `<= 0.005`, `>= 25`, `0.7 to 1.4`."""
        return limit_text(self.low, self.high)


class Flown(NamedTuple):
    """What flew."""

    version: str = ""
    """Version of modcube."""
    controller: str = ""
    """Name of its parameters; `own` for those of a file."""
    vehicles: tuple[str, ...] = ()
    """Names of the vehicles, each once, in the order of the modules."""

    def __str__(self) -> str:
        return f"modcube {self.version}, controller {self.controller}, vehicle {', '.join(self.vehicles)}"


class Result(NamedTuple):
    """The result of a run. result.json holds all of it but the last two."""

    scenario: str
    seed: int
    passed: bool
    metrics: dict[str, float]
    checks: tuple[Check, ...]
    warnings: tuple[str, ...] = ()
    """Warnings of the firmware, a line each (hil.metrics.warning_lines)."""
    unusual: tuple[str, ...] = ()
    """Options that differ from the scenario or the defaults: vehicle, controller, sensors, rate, real time."""
    flown: Flown = Flown()
    no_tag_reason: str = ""
    """Why no tag was seen, in words, if the flight could not be flown for that reason."""
    unmet_faults: tuple[str, ...] = ()
    """Faults that never began, because the flight ended before its time; a line each."""

    @property
    def seed_and_options(self) -> str:
        """What distinguishes this flight from others of its scenario, in words: its seed and unusual options."""
        return ", ".join([f"seed {self.seed}", *self.unusual])


def limit_text(low: float, high: float) -> str:
    """A range in words; empty if neither side is bounded."""
    if low <= -UNBOUNDED and high >= UNBOUNDED:
        return ""
    if low <= -UNBOUNDED:
        return f"<= {high:.4g}"
    return f">= {low:.4g}" if high >= UNBOUNDED else f"{low:.4g} to {high:.4g}"


def check_metrics(metrics: Mapping[str, float], limits: Iterable[Bounds]) -> tuple[Check, ...]:
    """One check per limit, in order."""
    checks = []
    for limit in limits:
        value = metrics.get(limit.metric, math.nan)
        passed = limit.low <= value <= limit.high  # False for NaN
        checks.append(Check(limit.metric, value, limit.low, limit.high, passed))
    return tuple(checks)


def judge(scenario: str, seed: int, metrics: Mapping[str, float], limits: Iterable[Bounds], warnings: tuple[str, ...] = ()) -> Result:
    """The result of a run: passed when every check passed and there is at least one."""
    checks = check_metrics(metrics, limits)
    return Result(scenario, seed, bool(checks) and all(c.passed for c in checks), dict(metrics), checks, warnings)


def write_result(result: Result, folder: Path) -> Path:
    """Write result.json into `folder`; NaN and infinity, which JSON lacks, become null. Returns its path."""
    plain = {
        "scenario": result.scenario,
        "seed": result.seed,
        **result.flown._asdict(),
        "unusual": list(result.unusual),
        "passed": result.passed,
        "metrics": {name: _number(value) for name, value in result.metrics.items()},
        "checks": [
            {"name": check.name, "value": _number(check.value), "limit": check.limit, "passed": check.passed}
            for check in result.checks
        ],
        "warnings": list(result.warnings),
    }
    path = folder / RESULT_FILE
    path.write_text(json.dumps(plain, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path


def _number(value: float) -> Any:
    if not math.isfinite(value):
        return None
    return int(value) if float(value).is_integer() and abs(value) < 2**53 else float(value)
