"""Clocks: the only place in the firmware that reads one. All other code receives time as integer nanoseconds."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Protocol

MACHINE_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""A clock that keeps running during suspend, where the system has one: a ground computer whose lid was shut for an hour notices that it
missed an hour and disarms, as after any stall longer than `failsafes.bus_silent_limit`. With CLOCK_MONOTONIC it would continue with the
commands that it held before."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class Clock(Protocol):
    """A source of time."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary moment; never decreases."""
        ...


class MonotonicClock:
    """MACHINE_CLOCK relative to an origin; never goes back, and is shared by all processes of one machine."""

    def __init__(self, origin_ns: int = 0) -> None:
        """`origin_ns`: the time of MACHINE_CLOCK at which this clock shows zero."""
        self.origin_ns = origin_ns

    @classmethod
    def started_now(cls) -> MonotonicClock:
        """A clock that shows zero now."""
        return cls(time.clock_gettime_ns(MACHINE_CLOCK))

    def now_ns(self) -> int:
        """Nanoseconds since the origin."""
        return time.clock_gettime_ns(MACHINE_CLOCK) - self.origin_ns


def boot_id() -> str:
    """Identifier of this boot, which the time of day cannot tell from the previous one; empty where the system has none."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def unix_ns() -> int:
    """The time of day, ns since 1970: for data that leaves the process (signing, files), never for control."""
    return time.time_ns()
