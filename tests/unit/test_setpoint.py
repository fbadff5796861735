"""Guidance: stands still where it was told, follows a path from when it was told, and looks a thruster lag ahead."""

import numpy as np
import pytest

from firmware_py.core.rotations import from_euler
from firmware_py.core.setpoint import Guidance, rest_at
from firmware_py.core.types import Estimate, Setpoint

LEAD_S = 0.09
START_NS = 5_000_000_000
ZERO = np.zeros(3)


class Ramp:
    """One metre north in two seconds, at rest before and after."""

    duration_s = 2.0

    def sample(self, t_s: float) -> Setpoint:
        inside = 0.0 < t_s < self.duration_s
        position = np.array([0.5 * min(max(t_s, 0.0), self.duration_s), 0.0, 0.0])
        velocity = np.array([0.5 if inside else 0.0, 0.0, 0.0])
        return Setpoint(position, np.array([1.0, 0.0, 0.0, 0.0]), velocity, ZERO, ZERO, ZERO)


@pytest.fixture
def guidance() -> Guidance:
    return Guidance(LEAD_S)


def ns(seconds: float) -> int:
    return START_NS + round(seconds * 1e9)


def is_at_rest(setpoint: Setpoint) -> bool:
    return not np.any([setpoint.v_w, setpoint.w_b, setpoint.a_w, setpoint.alpha_b])


def test_robot_that_was_told_nothing_stays_at_the_origin(guidance: Guidance) -> None:
    now, ahead = guidance.step(START_NS)
    assert now is ahead and is_at_rest(now)
    np.testing.assert_array_equal(now.p_wb, ZERO)
    assert guidance.finished(START_NS)


@pytest.mark.parametrize("t", [-1.0, 0.0, 0.01, 1.0, 1.95, 2.0, 3.0])
def test_path_is_sampled_now_and_a_thruster_lag_ahead(guidance: Guidance, t: float) -> None:
    guidance.follow(Ramp(), START_NS)
    now, ahead = guidance.step(ns(t))
    np.testing.assert_allclose(now.p_wb, Ramp().sample(t).p_wb, atol=1e-9)
    np.testing.assert_allclose(ahead.p_wb, Ramp().sample(t + LEAD_S).p_wb, atol=1e-9)


@pytest.mark.parametrize(("t", "over"), [(0.0, False), (1.999999999, False), (2.0, True), (100.0, True)])
def test_path_is_finished_at_its_end(guidance: Guidance, t: float, over: bool) -> None:
    guidance.follow(Ramp(), START_NS)
    assert guidance.finished(ns(t)) is over


def test_hold_ends_the_path(guidance: Guidance) -> None:
    guidance.follow(Ramp(), START_NS)
    guidance.hold(rest_at(np.array([1.0, 2.0, 3.0]), from_euler(0.0, 1.5, 0.0)))
    now, ahead = guidance.step(ns(1.0))
    np.testing.assert_array_equal(now.p_wb, [1.0, 2.0, 3.0])
    assert now is ahead and guidance.finished(ns(1.0))


def test_new_path_takes_the_place_of_the_old(guidance: Guidance) -> None:
    guidance.follow(Ramp(), START_NS)
    guidance.follow(Ramp(), ns(1.0))
    np.testing.assert_array_equal(guidance.step(ns(1.0))[0].p_wb, ZERO)


def test_hold_here_is_where_the_robot_is_believed_to_be(guidance: Guidance) -> None:
    q_wb = from_euler(0.3, -0.4, 2.0)
    moving = Estimate(np.ones(3), q_wb, np.ones(6), ZERO, ZERO, ZERO, ZERO, 0, 0.0, 0, 0, True)
    guidance.hold_here(moving)
    now, _ = guidance.step(START_NS)
    np.testing.assert_array_equal(now.p_wb, np.ones(3))
    np.testing.assert_array_equal(now.q_wb, q_wb)
    assert is_at_rest(now), "it stops there, however fast it was"


def test_rest_survives_a_strided_view() -> None:
    """Compiled stages refuse a strided array, or would recompile in mid-flight."""
    wide = np.arange(12.0).reshape(3, 4)
    setpoint = rest_at(wide[:, 1], wide[0])
    assert setpoint.p_wb.flags.c_contiguous
    np.testing.assert_array_equal(setpoint.p_wb, [1.0, 5.0, 9.0])
