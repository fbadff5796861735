"""Ticks start at absolute deadlines, whatever the ticks before them did."""

import time

import pytest

from firmware_py.app.deadlines import histogram_lines
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.rate_keeper import COARSE_EDGES_NS, Histogram, RateKeeper, absolute_sleeper

PERIOD_NS = 10_000_000


class ManualClock:
    """A clock that stands still until it is set."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def set(self, now_ns: int) -> None:
        assert now_ns >= self._now_ns
        self._now_ns = now_ns


class LateSleeper:
    """Wakes up some time after the deadline, as a busy machine does."""

    def __init__(self, clock: ManualClock, late_ns: int) -> None:
        self.clock = clock
        self.late_ns = late_ns

    def __call__(self, deadline_ns: int) -> None:
        self.clock.set(deadline_ns + self.late_ns)


def keeper(late_ns: int = 0, start_ns: int = 0) -> tuple[RateKeeper, ManualClock]:
    clock = ManualClock(start_ns)
    return RateKeeper(PERIOD_NS, clock, LateSleeper(clock, late_ns)), clock


def test_ticks_do_not_drift_when_every_wake_up_is_late() -> None:
    rate, clock = keeper(late_ns=300_000)
    rate.start(0)
    deadlines = []
    for _ in range(1000):
        deadlines.append(rate.wait())
        clock.set(clock.now_ns() + 2_000_000)
        rate.finish()
    assert deadlines == [k * PERIOD_NS for k in range(1000)]
    assert rate.lateness.worst_ns == 300_000
    assert rate.overruns == rate.skipped == 0


def test_long_tick_is_an_overrun_and_the_next_begins_at_once() -> None:
    rate, clock = keeper()
    rate.start(0)
    rate.wait()
    clock.set(14_000_000)
    rate.finish()
    assert rate.wait() == PERIOD_NS
    assert (rate.overruns, rate.skipped, rate.lateness.worst_ns) == (1, 0, 4_000_000)


def test_stall_skips_deadlines_and_keeps_the_phase() -> None:
    rate, clock = keeper()
    rate.start(5)
    rate.wait()
    clock.set(5 + 57_000_000)
    rate.finish()
    assert rate.wait() == 5 + 5 * PERIOD_NS
    assert rate.skipped == 4
    assert rate.wait() == 5 + 6 * PERIOD_NS


def test_first_tick_is_now_when_no_start_was_set() -> None:
    rate, _ = keeper(start_ns=123)
    assert rate.wait() == 123


def test_quantiles_of_lateness_are_at_most_a_bin_too_large() -> None:
    histogram = Histogram()
    for duration_ns in range(1000, 101_000, 100):
        histogram.add(duration_ns)
    assert 50_950 <= histogram.quantile_ns(0.5) <= 1.26 * 50_950
    assert histogram.quantile_ns(1.0) == 100_900
    assert histogram.total == 1000
    assert Histogram().quantile_ns(0.5) == 0


def test_durations_beyond_every_bin_are_kept() -> None:
    histogram = Histogram()
    histogram.add(5_000_000_000)
    histogram.add(-3)
    assert histogram.counts[0] == histogram.counts[-1] == 1
    assert histogram.quantile_ns(1.0) == 5_000_000_000


def test_coarse_bins_end_at_one_two_and_five_and_hold_every_tick() -> None:
    histogram = Histogram()
    for duration_ns in (900, 1_900, 2_100, 4_900, 80_000, 999_000_000, 2_000_000_000):
        histogram.add(duration_ns)
    assert [round(edge * 1e-3) for edge in COARSE_EDGES_NS[:7]] == [1, 2, 5, 10, 20, 50, 100]
    assert histogram.coarse().tolist() == [1, 1, 2, 0, 0, 0, 1, *[0] * 11, 1, 1]


def test_histogram_is_told_in_lines_from_its_first_to_its_last_tick() -> None:
    histogram = Histogram()
    for duration_ns in (4_000, 4_000, 15_000):
        histogram.add(duration_ns)
    assert list(histogram_lines(histogram)) == [
        f"         to 5 us         2 {'#' * 40}",
        "        to 10 us         0",
        f"        to 20 us         1 {'#' * 20}",
    ]
    assert list(histogram_lines(Histogram())) == []


def test_machine_sleeps_to_the_deadline_and_returns_at_once_after_it() -> None:
    clock = MonotonicClock()
    sleep_until = absolute_sleeper(clock)
    deadline_ns = clock.now_ns() + 1_000_000
    sleep_until(deadline_ns)
    assert clock.now_ns() >= deadline_ns
    sleep_until(0)


def test_period_must_be_positive() -> None:
    with pytest.raises(ValueError, match="above zero"):
        RateKeeper(0, ManualClock(), lambda _: None)


def test_machine_that_slept_an_hour_finds_that_it_missed_an_hour(monkeypatch: pytest.MonkeyPatch) -> None:
    """System sleep counts as a stall, which disarms: CLOCK_MONOTONIC stands still while a laptop's lid is shut."""
    hour_ns, now_ns = 3_600_000_000_000, {time.CLOCK_MONOTONIC: 0, time.CLOCK_BOOTTIME: 0}
    monkeypatch.setattr(time, "clock_gettime_ns", now_ns.__getitem__)
    keeper = RateKeeper(10_000_000, MonotonicClock.started_now(), lambda deadline_ns: None)
    keeper.wait()
    now_ns[time.CLOCK_BOOTTIME] += hour_ns
    assert keeper.wait() == hour_ns and keeper.skipped == 359_999
