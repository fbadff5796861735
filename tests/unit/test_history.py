"""The last half second: every sample is found by its time, across the ring's seam and over skipped ticks."""

import numpy as np
import pytest

from firmware_py.core.history import WINDOW_NS, History

PERIOD = 10_000_000


def filled(count: int, period: int = PERIOD, start_ns: int = 7_000) -> History:
    """Sample k holds tau = k, gyro = 100 + k, accel = 200 + k, depth = 300 + k."""
    history = History(period)
    for k in range(count):
        tau, gyro, accel = np.full(6, float(k)), np.full(3, 100.0 + k), np.full(3, 200.0 + k)
        history.push(start_ns + k * period, tau, gyro, accel, 300.0 + k)
    return history


def sample(history: History, index: int) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Wrench, gyro, accelerometer and depth of one sample."""
    taus, gyros, others = history.since(index)
    return float(taus[0, 0]), gyros[0], others[0, :3], float(others[0, 3])


@pytest.mark.parametrize("rate_hz", [50, 100, 300, 400])
def test_half_a_second_is_kept_at_every_rate(rate_hz: int) -> None:
    period = 1_000_000_000 // rate_hz
    history = filled(3 * rate_hz, period)
    oldest = history.first_after(history.newest_ns - WINDOW_NS)
    for index in range(oldest, history.newest + 1):
        tau, gyro, accel, depth = sample(history, index)
        assert (tau, gyro[0], accel[0], depth) == (index, 100.0 + index, 200.0 + index, 300.0 + index)


@pytest.mark.parametrize("count", [1, 2, 51, 52, 53, 104, 200])
def test_samples_since_an_index_are_one_run_to_the_newest(count: int) -> None:
    history = filled(count)
    for index in range(max(0, count - history.length), count):
        for array, start in zip(history.since(index), (0.0, 100.0, 200.0), strict=True):
            np.testing.assert_array_equal(array[:, 0], start + np.arange(index, count))
            assert array.flags.c_contiguous, "a strided array recompiles in mid-flight"


def test_first_sample_after_a_time_is_strictly_later() -> None:
    history = filled(30)
    for k in range(30):
        time = history.time_of(k)
        assert time == 7_000 + k * PERIOD
        assert history.first_after(time - 1) == k
        assert history.first_after(time) == k + 1
        assert history.first_after(time + 1) == k + 1
    assert history.first_after(history.newest_ns + 5 * PERIOD) == 30


def test_what_is_older_than_the_ring_is_not_asked_for() -> None:
    history = filled(200)
    oldest = history.first_after(history.newest_ns - 10 * WINDOW_NS)
    assert oldest == 200 - history.length
    assert sample(history, oldest)[0] == oldest


def test_skipped_ticks_hold_the_same_wrench_and_no_sensors() -> None:
    history = filled(5)
    history.push(7_000 + 8 * PERIOD, np.full(6, 9.0), np.ones(3), np.ones(3), 1.0)
    assert history.newest == 8
    for skipped in (5, 6, 7):
        tau, gyro, accel, depth = sample(history, skipped)
        assert np.isnan(gyro).all() and np.isnan(accel).all() and np.isnan(depth)
        assert tau == 9.0
    assert sample(history, 8)[3] == 1.0
    assert history.time_of(8) == 7_000 + 8 * PERIOD


def test_sensor_that_said_nothing_is_not_a_number() -> None:
    history = History(PERIOD)
    history.push(0, np.zeros(6), None, np.ones(3), None)
    _, gyro, accel, depth = sample(history, 0)
    assert np.isnan(gyro).all() and np.isnan(depth)
    np.testing.assert_array_equal(accel, np.ones(3))
