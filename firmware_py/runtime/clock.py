"""Clocks: the only place of the firmware that reads one. Everything else is given time as integer nanoseconds."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Protocol

MACHINE_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""Goes on while the machine sleeps, where the system has such a clock: a ground computer whose lid was shut for an hour finds that it has
missed an hour, as one that stood still does, and disarms. By CLOCK_MONOTONIC it would go on with whatever it held in that place."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class Clock(Protocol):
    """Something that knows the time."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary moment; never goes back."""
        ...


class MonotonicClock:
    """The machine's MACHINE_CLOCK, which never goes back: the same for all processes of one machine."""

    def __init__(self, origin_ns: int = 0) -> None:
        """`origin_ns`: the machine's time that this clock calls zero."""
        self.origin_ns = origin_ns

    @classmethod
    def started_now(cls) -> MonotonicClock:
        """A clock that shows zero now."""
        return cls(time.clock_gettime_ns(MACHINE_CLOCK))

    def now_ns(self) -> int:
        """Nanoseconds since the origin."""
        return time.clock_gettime_ns(MACHINE_CLOCK) - self.origin_ns


def boot_id() -> str:
    """Of this start of the machine, which the time of day does not tell from the one before; empty where the system has none."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def unix_ns() -> int:
    """The time of day, ns since 1970: for what leaves the process (signing, files), never for control."""
    return time.time_ns()
