"""The bench's drift figure for a loop whose ticks start ever later: after their deadlines, or because the deadlines leave their grid."""

import bench_lateness as bench
import numpy as np
import pytest

from firmware_py.runtime.rate_keeper import LATENESS_EDGES_NS

PERIOD_NS, SECONDS = 10_000_000, 60
BINS = len(LATENESS_EDGES_NS) + 1
EARLY, LATER = 20, 25


def counts(late: np.ndarray) -> np.ndarray:
    """(k, BINS) cumulative tick counts every half second; the ticks of half second k have their lateness in bin late[k]."""
    return np.cumsum(50 * np.eye(BINS, dtype=np.int64)[late], axis=0)


def test_loop_that_keeps_its_grid_does_not_drift() -> None:
    deadlines = [5 + k * PERIOD_NS for k in range(100 * SECONDS)]
    assert bench.drift_ns(counts(np.full(2 * SECONDS, EARLY)), deadlines, PERIOD_NS) == 0.0


def test_ticks_that_start_later_after_their_deadlines_drift() -> None:
    deadlines = [5 + k * PERIOD_NS for k in range(100 * SECONDS)]
    late = np.where(np.arange(2 * SECONDS) < SECONDS, EARLY, LATER)
    expected = LATENESS_EDGES_NS[LATER] - LATENESS_EDGES_NS[EARLY]
    assert bench.drift_ns(counts(late), deadlines, PERIOD_NS) == expected


def test_deadlines_that_leave_their_grid_drift() -> None:
    deadlines = [5 + k * (PERIOD_NS + 100) for k in range(100 * SECONDS)]
    drift = bench.drift_ns(counts(np.full(2 * SECONDS, EARLY)), deadlines, PERIOD_NS)
    assert drift == pytest.approx(100 * 100 * SECONDS, rel=0.06)
