"""Timing of the ticks in telemetry: SYS_STATUS.load, and two histograms as DEBUG_FLOAT_ARRAY."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

_FLOATS = 58
"""Length of DEBUG_FLOAT_ARRAY's data."""


class Times(NamedTuple):
    """Timing of the ticks since start."""

    load: float
    """99th percentile of the ticks' run time, as a share of the period."""
    lateness: tuple[int, ...]
    """(20,) histogram of how late ticks began; upper bin edges 1, 2, 5, 10 us and so on to 1 s, then a bin for longer."""
    compute: tuple[int, ...]
    """(20,) histogram of how long ticks ran, in the same bins."""


def load_permille(times: Times | None) -> int:
    """Returns the load in the unit of SYS_STATUS; 0 in lockstep, where no tick can be late."""
    return round(1e3 * times.load) if times is not None else 0


def histograms(times: Times | None, time_us: int) -> list[Mapping[str, Any]]:
    """Returns the values of the messages LATENESS and COMPUTE; none in lockstep."""
    counts = {"LATENESS": times.lateness, "COMPUTE": times.compute} if times is not None else {}
    return [
        {"time_usec": time_us, "name": name, "array_id": i, "data": (*ticks, *[0] * (_FLOATS - len(ticks)))}
        for i, (name, ticks) in enumerate(counts.items())
    ]
