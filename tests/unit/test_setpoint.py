"""What set-points are made of: a glider whose motion never jumps, keeps its limits and arrives."""

from itertools import pairwise

import numpy as np
import pytest

from firmware_py.core.rotations import difference, exp, from_euler, multiply
from firmware_py.core.setpoint import Glider, Wish, ahead_of, at_estimate, limited, rest_at
from firmware_py.core.types import Estimate, Setpoint

ZERO = np.zeros(3)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
BANDWIDTH, SPEED, RATE = 6.0, 0.3, 0.6
DT = 0.01
STOP = Wish(ZERO, ZERO)


@pytest.fixture
def glider() -> Glider:
    return Glider(BANDWIDTH, SPEED, RATE)


def glide(glider: Glider, wish: Wish, seconds: float, dt_s: float = DT) -> list[Setpoint]:
    return [glider.step(wish, dt_s) for _ in range(round(seconds / dt_s))]


def is_at_rest(setpoint: Setpoint, tolerance: float = 1e-6) -> bool:
    return bool(np.abs([setpoint.v_w, setpoint.w_b, setpoint.a_w, setpoint.alpha_b]).max() < tolerance)


def test_robot_that_was_told_nothing_stays_at_the_origin(glider: Glider) -> None:
    (setpoint,) = glide(glider, STOP, DT)
    assert is_at_rest(setpoint, 1e-300)
    np.testing.assert_array_equal(setpoint.p_wb, ZERO)


def test_speed_is_taken_up_as_a_critically_damped_filter_does(glider: Glider) -> None:
    """v = V (1 - (1 + w t) exp(-w t)); the way is its integral, whatever the tick."""
    speed = np.array([0.3, -0.1, 0.0])
    t = 0.7
    wt = BANDWIDTH * t
    for dt_s in (0.0025, 0.01, 0.1):
        fresh = Glider(BANDWIDTH, SPEED, RATE)
        end = glide(fresh, Wish(speed, ZERO), t, dt_s)[-1]
        np.testing.assert_allclose(end.v_w, speed * (1.0 - (1.0 + wt) * np.exp(-wt)), atol=1e-12)
        np.testing.assert_allclose(end.a_w, speed * BANDWIDTH * wt * np.exp(-wt), atol=1e-12)
        way = t - (2.0 - (2.0 + wt) * np.exp(-wt)) / BANDWIDTH
        np.testing.assert_allclose(end.p_wb, speed * way, atol=1e-12)


def test_derivatives_are_those_of_the_motion(glider: Glider) -> None:
    """Place, speed and acceleration of each tick fit the next, through a change of wish."""
    wishes = [Wish(np.array([0.2, 0.1, -0.1]), np.array([0.3, -0.2, 0.1])), Wish(np.array([-0.2, 0.0, 0.1]), ZERO)]
    path = [point for wish in wishes for point in glide(glider, wish, 0.5, 0.001)]
    for a, b in pairwise(path):
        np.testing.assert_allclose((b.p_wb - a.p_wb) / 0.001, 0.5 * (a.v_w + b.v_w), atol=1e-5)
        np.testing.assert_allclose((b.v_w - a.v_w) / 0.001, 0.5 * (a.a_w + b.a_w), atol=1e-3)
        np.testing.assert_allclose(difference(b.q_wb, a.q_wb) / 0.001, 0.5 * (a.w_b + b.w_b), atol=1e-5)


@pytest.mark.parametrize("goal", [[0.05, 0.0, 0.0], [2.0, -1.0, 0.5], [-0.3, 0.3, 0.3]])
def test_place_is_reached_without_passing_it_and_within_the_speed(glider: Glider, goal: list[float]) -> None:
    path = glide(glider, Wish(ZERO, ZERO, np.array(goal), LEVEL), 20.0)
    np.testing.assert_allclose(path[-1].p_wb, goal, atol=1e-3)
    assert is_at_rest(path[-1], 5e-3)
    along = [float(point.p_wb @ goal) / float(np.dot(goal, goal)) for point in path]
    assert max(along) < 1.001
    assert max(float(np.linalg.norm(point.v_w)) for point in path) <= SPEED * (1 + 1e-9)


def test_attitude_is_reached_within_the_rate_from_any_side(glider: Glider) -> None:
    for goal in (from_euler(0.0, 0.5 * np.pi, 0.0), from_euler(np.pi - 0.01, 0.0, 0.0), from_euler(0.3, -1.0, -2.0)):
        glider.put(rest_at(ZERO, LEVEL))
        path = glide(glider, Wish(ZERO, ZERO, ZERO, goal), 20.0)
        np.testing.assert_allclose(difference(path[-1].q_wb, goal), 0.0, atol=2e-3)
        assert max(float(np.linalg.norm(point.w_b)) for point in path) <= RATE * (1 + 1e-9)
        assert all(abs(float(point.q_wb @ point.q_wb) - 1.0) < 1e-12 for point in path)


def test_axis_without_a_place_goes_by_speed_alone(glider: Glider) -> None:
    wish = Wish(np.array([0.0, 0.1, 0.0]), ZERO, np.array([1.0, np.nan, np.nan]), None)
    end = glide(glider, wish, 15.0)[-1]
    assert end.p_wb[0] == pytest.approx(1.0, abs=2e-3)
    assert end.v_w[1] == pytest.approx(0.1, abs=1e-6) and end.p_wb[2] == 0.0


def test_glider_goes_on_from_where_it_is_put(glider: Glider) -> None:
    start = Setpoint(np.ones(3), from_euler(0.3, 0.2, 0.1), np.array([0.2, 0.0, 0.0]), ZERO, ZERO, ZERO)
    glider.put(start)
    first, *_, last = glide(glider, STOP, 3.0)
    np.testing.assert_allclose(first.p_wb, start.p_wb + 0.002 * np.eye(3)[0], atol=1e-4)
    assert is_at_rest(last)


def test_tick_of_no_length_changes_nothing(glider: Glider) -> None:
    glide(glider, Wish(np.array([0.2, 0.1, 0.0]), np.array([0.1, 0.0, 0.3])), 0.3)
    before = glider.at
    after = glider.step(STOP, 0.0)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-15)


@pytest.mark.parametrize("vector", [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [3.0, -4.0, 12.0]])
def test_limited_vector_keeps_its_direction(vector: list[float]) -> None:
    short = limited(np.array(vector), 0.3)
    assert np.linalg.norm(short) <= 0.3 * (1 + 1e-12)
    np.testing.assert_allclose(np.cross(short, vector), 0.0, atol=1e-12)
    assert np.linalg.norm(short) == pytest.approx(min(0.3, float(np.linalg.norm(vector))))


def test_set_point_ahead_has_the_speed_that_the_thrusters_will_meet() -> None:
    now = Setpoint(np.ones(3), LEVEL, np.full(3, 0.1), np.full(3, 0.2), np.full(3, 1.0), np.full(3, -2.0))
    ahead = ahead_of(now, 0.09)
    np.testing.assert_allclose(ahead.v_w, 0.19)
    np.testing.assert_allclose(ahead.w_b, 0.02)
    np.testing.assert_array_equal(ahead.a_w, now.a_w)


def test_set_point_of_a_moving_robot_moves_with_it() -> None:
    q_wb = from_euler(0.3, -0.4, 2.0)
    nu = np.array([0.2, 0.0, 0.1, 0.3, 0.0, -0.1])
    setpoint = at_estimate(Estimate(np.ones(3), q_wb, nu, ZERO, ZERO, ZERO, ZERO, 0, 0.0, 0, 0, True))
    later = multiply(q_wb, exp(1e-3 * setpoint.w_b))
    np.testing.assert_allclose(difference(later, q_wb), 1e-3 * nu[3:], atol=1e-12)
    assert float(np.linalg.norm(setpoint.v_w)) == pytest.approx(float(np.linalg.norm(nu[:3])))
    np.testing.assert_array_equal(setpoint.a_w, ZERO)


def test_rest_survives_a_strided_view() -> None:
    """Compiled stages refuse a strided array, or would recompile in mid-flight."""
    wide = np.arange(12.0).reshape(3, 4)
    setpoint = rest_at(wide[:, 1], wide[0])
    assert setpoint.p_wb.flags.c_contiguous and is_at_rest(setpoint)
    np.testing.assert_array_equal(setpoint.p_wb, [1.0, 5.0, 9.0])
