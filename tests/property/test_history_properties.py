"""The half-second ring against a plain list, over any sequence of ticks and gaps."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.core.history import History

PERIOD = 10_000_000
always = settings(derandomize=True, deadline=None, database=None, max_examples=60)
gaps = st.lists(st.integers(1, 4), min_size=1, max_size=150)


@always
@given(gaps)
def test_ring_holds_what_a_list_would(ticks_between: list[int]) -> None:
    """Each push adds its own tick and fills the ticks skipped before it with its wrench and without sensors."""
    history = History(PERIOD)
    plain: list[tuple[float, bool]] = []
    tick = 0
    for n, gap in enumerate(ticks_between):
        tick += gap
        if plain:
            plain += [(float(n), False)] * (gap - 1)
        plain.append((float(n), True))
        history.push(tick * PERIOD, np.full(6, float(n)), np.full(3, float(n)), None, None)
    assert history.newest == len(plain) - 1 and history.newest_ns == tick * PERIOD
    first = max(0, len(plain) - history.length)
    taus, gyros, _ = history.since(first)
    np.testing.assert_array_equal(taus[:, 0], [tau for tau, _ in plain[first:]])
    np.testing.assert_array_equal(np.isfinite(gyros[:, 0]), [heard for _, heard in plain[first:]])


@always
@given(st.integers(1, 200), st.integers(-3 * PERIOD, 3 * PERIOD), st.integers(0, 40))
def test_sample_after_a_time_is_the_first_that_is_later(count: int, offset: int, back: int) -> None:
    history = History(PERIOD)
    for n in range(count):
        history.push(n * PERIOD, np.zeros(6), None, None, None)
    time = history.time_of(count - 1 - back) + offset
    index = history.first_after(time)
    if index <= history.newest:
        assert history.time_of(index) > time
    assert history.time_of(index - 1) <= time


@always
@given(st.lists(st.tuples(st.integers(1, 4), st.integers(-PERIOD * 2 // 5, PERIOD * 2 // 5)), min_size=2, max_size=150))
def test_tick_that_comes_off_its_time_shifts_no_other(ticks: list[tuple[int, int]]) -> None:
    """With ticks off an even grid by up to 40 % of a period, every sample is still found at its time, within twice that."""
    history, tick, actual = History(PERIOD), 0, {}
    for gap, off in ticks:
        tick += gap
        actual[tick] = tick * PERIOD + off
        history.push(actual[tick], np.full(6, float(tick)), None, None, None)
    for index in range(max(0, history.newest - history.length + 1), history.newest + 1):
        time = actual.get(index + min(actual))
        if time is not None:
            assert history.since(index)[0][0, 0] == index + min(actual)
            assert abs(history.time_of(index) - time) <= 0.8 * PERIOD
