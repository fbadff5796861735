"""For tools/bench.py: one line of its table, and the timing functions."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

REPETITIONS = 7


@dataclass(frozen=True)
class Entry:
    """One line of bench.json."""

    name: str
    value: float
    unit: str
    peer: str | None = None
    peer_value: float | None = None
    ratio: float | None = None


def compare(
    name: str, unit: str, ours: Callable[[], float], peers: dict[str, Callable[[], float]], repetitions: int = REPETITIONS
) -> list[Entry]:
    """Medians of alternating repetitions of functions that return a duration in `unit`; one entry per peer."""
    everyone = {"": ours, **peers}
    times: dict[str, list[float]] = {key: [] for key in everyone}
    for _ in range(repetitions):
        for key, function in everyone.items():
            times[key].append(function())
    value = median(times.pop(""))
    if not peers:
        return [Entry(name, value, unit)]
    return [Entry(name, value, unit, peer, median(each), median(each) / value) for peer, each in times.items()]


def each_us(function: Callable[[], object], times: int) -> Callable[[], float]:
    """Returns a function that calls `function` `times` times and returns the mean duration of a call, us."""

    def run() -> float:
        began = time.perf_counter()
        for _ in range(times):
            function()
        return 1e6 * (time.perf_counter() - began) / times

    return run
