"""Minimum-snap paths keep their limits, however much the durations of their segments differ."""

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py.prepare.minimum_snap import InfeasibleError, Limits, Waypoint, plan

always = settings(derandomize=True, deadline=None, database=None, max_examples=60)
octaves = st.lists(st.floats(-5.0, 5.0), min_size=2, max_size=4)
"""Binary logarithms of the segments' durations, which differ by a factor of up to a thousand."""


def waypoints(count: int, seed: int) -> list[Waypoint]:
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, rng=rng).as_quat(scalar_first=True)
    return [Waypoint(p, q) for p, q in zip(rng.normal(size=(count, 3)), turns, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "columns", "bound"),
    [(Limits(angular_rate=0.6), slice(10, 13), 0.6), (Limits(angular_acceleration=0.5), slice(16, 19), 0.5)],
)
@always
@given(octaves, st.integers(0, 1000))
def test_turning_keeps_its_limit_whatever_the_durations(
    limits: Limits, columns: slice, bound: float, times: list[float], seed: int
) -> None:
    try:
        found = plan(waypoints(len(times) + 1, seed), [5.0 * 2.0**octave for octave in times], limits)
    except InfeasibleError:
        reject()
    assert np.linalg.norm(found.grid(20_000)[..., columns], axis=-1).max() <= bound * (1.0 + 1e-3)
