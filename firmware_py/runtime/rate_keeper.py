"""Starts ticks at absolute deadlines and records how late they were. No drift: a late tick does not move the next."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from bisect import bisect_left
from collections.abc import Callable

import numpy as np

from firmware_py.runtime.clock import MACHINE_CLOCK, Clock

NS_PER_S = 1_000_000_000
LATENESS_EDGES_NS = tuple(int(10 ** (3 + i / 10)) for i in range(61))
"""Upper edges of the histogram's bins: 1 us to 1 s, ten to a decade (26 % wide)."""
_COARSE = tuple(i for i in range(len(LATENESS_EDGES_NS)) if i % 10 in (0, 3, 7))
COARSE_EDGES_NS = tuple(LATENESS_EDGES_NS[i] for i in _COARSE)
"""Upper edges of the coarser bins shown to people: 1, 2, 5, 10 us and so on to 1 s."""
_COARSE_STARTS = (0, *(i + 1 for i in _COARSE))
_TIMER_ABSTIME = 1  # <time.h>


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


def absolute_sleeper(clock: Clock) -> Callable[[int], None]:
    """A function that sleeps until a time of MACHINE_CLOCK, ns.

    Uses clock_nanosleep(TIMER_ABSTIME), or a relative sleep by `clock` where the C library lacks it.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    call = getattr(libc, "clock_nanosleep", None)
    if call is None:
        return lambda deadline_ns: time.sleep(max(0, deadline_ns - clock.now_ns()) / NS_PER_S)
    call.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.POINTER(_Timespec), ctypes.c_void_p)
    wanted = _Timespec()

    def sleep_until(deadline_ns: int) -> None:
        wanted.tv_sec, wanted.tv_nsec = divmod(deadline_ns, NS_PER_S)
        while code := call(MACHINE_CLOCK, _TIMER_ABSTIME, ctypes.byref(wanted), None):
            if code != errno.EINTR:  # a signal: its handler has run, sleep on
                raise OSError(code, os.strerror(code))

    return sleep_until


class RateKeeper:
    """Keeps deadlines start + k * period. `wait` sleeps until the next deadline; `finish` closes the tick.

    A tick that is still running at the next deadline is an overrun. Deadlines that lie a whole period or more back are skipped and
    counted, so that after a stall ticks continue at their old phase instead of in a burst.
    """

    def __init__(self, period_ns: int, clock: Clock, sleep_until: Callable[[int], None]) -> None:
        """`sleep_until` blocks until the clock shows at least that time. Raises ValueError for a period not above 0."""
        if period_ns <= 0:
            raise ValueError(f"period {period_ns} ns must be above zero")
        self.period_ns = period_ns
        self._clock = clock
        self._sleep_until = sleep_until
        self._next_ns: int | None = None
        self.lateness = Histogram()
        """How long after its deadline each tick began."""
        self.compute = Histogram()
        """How long each tick ran."""
        self.overruns = 0
        """Ticks that ran beyond the next deadline."""
        self.skipped = 0
        """Deadlines that were skipped."""
        self._began_ns = 0

    def start(self, first_ns: int) -> None:
        """Set the first deadline."""
        self._next_ns = first_ns

    def wait(self) -> int:
        """Sleep until the next deadline. Returns that deadline, ns: the tick's time. The first call starts now."""
        now_ns = self._clock.now_ns()
        if self._next_ns is None:
            self._next_ns = now_ns
        behind = (now_ns - self._next_ns) // self.period_ns
        if behind > 0:
            self.skipped += behind
            self._next_ns += behind * self.period_ns
        deadline_ns = self._next_ns
        if now_ns < deadline_ns:
            self._sleep_until(deadline_ns)
        self._began_ns = self._clock.now_ns()
        self.lateness.add(self._began_ns - deadline_ns)
        self._next_ns = deadline_ns + self.period_ns
        return deadline_ns

    def finish(self) -> None:
        """The tick is done."""
        now_ns = self._clock.now_ns()
        self.compute.add(now_ns - self._began_ns)
        self.overruns += self._next_ns is not None and now_ns > self._next_ns


class Histogram:
    """Durations in fixed logarithmic bins; never grows."""

    def __init__(self) -> None:
        self.counts = np.zeros(len(LATENESS_EDGES_NS) + 1, dtype=np.int64)
        """(62,) bin i counts durations up to LATENESS_EDGES_NS[i]; the last bin counts longer ones."""
        self.worst_ns = 0
        self.total = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration; below zero counts as zero."""
        self.counts[bisect_left(LATENESS_EDGES_NS, duration_ns)] += 1
        self.worst_ns = max(self.worst_ns, duration_ns)
        self.total += 1

    def coarse(self) -> np.ndarray:
        """(20,) counts by COARSE_EDGES_NS; the last counts durations longer than a second."""
        return np.asarray(np.add.reduceat(self.counts, _COARSE_STARTS))

    def quantile_ns(self, share: float) -> int:
        """The `share` quantile as the upper edge of its bin: at most 26 % above the true value. 0 when empty."""
        if self.total == 0:
            return 0
        place = int(np.searchsorted(np.cumsum(self.counts), share * self.total))
        return min(LATENESS_EDGES_NS[place], self.worst_ns) if place < len(LATENESS_EDGES_NS) else self.worst_ns
