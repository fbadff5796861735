"""How ticks kept their deadlines, as telemetry tells it: SYS_STATUS.load, and two histograms as DEBUG_FLOAT_ARRAY."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

_FLOATS = 58
"""Of DEBUG_FLOAT_ARRAY."""


class Times(NamedTuple):
    """How ticks kept their deadlines since the start."""

    load: float
    """Share of the period that all but one tick in a hundred need at most."""
    lateness: tuple[int, ...]
    """(20,) ticks by how late they began: up to 1, 2, 5, 10 us and so on to 1 s; longer."""
    compute: tuple[int, ...]
    """(20,) ticks by how long they ran."""


def load_permille(times: Times | None) -> int:
    """As SYS_STATUS has it; 0 in lockstep, where nobody is late."""
    return round(1e3 * times.load) if times is not None else 0


def histograms(times: Times | None, time_us: int) -> list[Mapping[str, Any]]:
    """LATENESS and COMPUTE; nothing in lockstep."""
    counts = {"LATENESS": times.lateness, "COMPUTE": times.compute} if times is not None else {}
    return [
        {"time_usec": time_us, "name": name, "array_id": i, "data": (*ticks, *[0] * (_FLOATS - len(ticks)))}
        for i, (name, ticks) in enumerate(counts.items())
    ]
