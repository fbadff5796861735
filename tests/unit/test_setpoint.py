"""The glider: changes speed smoothly, arrives without overshoot, and does not depend on the tick period."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from firmware_py.core.rotations import difference, exp, from_euler, multiply
from firmware_py.core.setpoint import Glider, Wish, ahead_of, leashed, leashed_turn, limited, rest_at
from firmware_py.core.types import Setpoint

ZERO = np.zeros(3)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
BANDWIDTH = 6.0


def glider(at: Setpoint | None = None) -> Glider:
    new = Glider(BANDWIDTH, 0.3, 0.6)
    new.put(at or rest_at(ZERO, LEVEL))
    return new


def test_speed_follows_the_filter_that_the_docstring_names() -> None:
    """Against scipy's integration of v'' = w^2 (wanted - v) - 2 w v'."""
    start = Setpoint(ZERO, LEVEL, np.array([0.2, -0.1, 0.0]), ZERO, np.array([0.3, 0.0, -0.2]), ZERO)
    wanted = np.array([0.0, 0.25, -0.1])

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        _p, v, a = y.reshape(3, 3)
        return np.concatenate([v, a, BANDWIDTH**2 * (wanted - v) - 2 * BANDWIDTH * a])

    exact = solve_ivp(slope, (0, 0.7), np.concatenate([ZERO, start.v_w, start.a_w]), rtol=1e-10, atol=1e-12).y[:, -1]
    moved = glider(start)
    for _ in range(70):
        moved.step(Wish(wanted, ZERO), 0.01)
    np.testing.assert_allclose(np.concatenate([moved.at.p_wb, moved.at.v_w, moved.at.a_w]), exact, atol=1e-8)


@pytest.mark.parametrize("ticks", [1, 7, 100])
def test_place_does_not_depend_on_the_tick(ticks: int) -> None:
    moved = glider()
    for _ in range(ticks):
        moved.step(Wish(np.array([0.3, 0.0, 0.0]), ZERO), 1.0 / ticks)
    one = glider()
    one.step(Wish(np.array([0.3, 0.0, 0.0]), ZERO), 1.0)
    np.testing.assert_allclose(moved.at.p_wb, one.at.p_wb, atol=1e-12)


def test_robot_arrives_without_overshoot_and_below_its_speed() -> None:
    moved, goal = glider(), np.array([1.0, -2.0, 0.5])
    turn = from_euler(0.0, 1.2, 2.0)
    ways = []
    for _ in range(3000):
        at = moved.step(Wish(ZERO, ZERO, goal, turn), 0.01)
        ways.append(float(np.linalg.norm(goal - at.p_wb)))
        assert np.linalg.norm(at.v_w) <= 0.3 + 1e-9 and np.linalg.norm(at.w_b) <= 0.6 + 1e-9
    assert np.all(np.diff(ways) <= 1e-9) and ways[-1] < 1e-3
    off = Rotation.from_quat(moved.at.q_wb[[1, 2, 3, 0]]).inv() * Rotation.from_quat(turn[[1, 2, 3, 0]])
    assert off.magnitude() < 1e-3


def test_axis_without_a_place_goes_by_its_speed() -> None:
    moved = glider()
    for _ in range(1000):
        at = moved.step(Wish(np.array([0.1, 0.0, 0.0]), ZERO, np.array([np.nan, 0.2, np.nan])), 0.01)
    np.testing.assert_allclose(at.v_w, [0.1, 0.0, 0.0], atol=1e-4)
    assert at.p_wb[0] > 0.9 and abs(at.p_wb[1] - 0.2) < 1e-3 and at.p_wb[2] == 0.0


def test_set_point_never_jumps() -> None:
    """Whatever the wish changes to from one tick to the next."""
    rng, moved = np.random.default_rng(0), glider()
    for _ in range(300):
        before = moved.at
        after = moved.step(Wish(rng.uniform(-0.3, 0.3, 3), rng.uniform(-0.6, 0.6, 3)), 0.01)
        assert np.abs(after.p_wb - before.p_wb).max() < 0.01
        assert np.abs(after.v_w - before.v_w).max() < 0.03
        assert np.abs(after.a_w - before.a_w).max() < BANDWIDTH**2 * 0.7 * 0.01 + 2 * BANDWIDTH * 1.2 * 0.01


def test_vector_is_shortened_to_its_limit() -> None:
    np.testing.assert_allclose(limited(np.array([3.0, 4.0, 0.0]), 1.0), [0.6, 0.8, 0.0])
    np.testing.assert_array_equal(limited(np.array([0.3, 0.4, 0.0]), 0.5), [0.3, 0.4, 0.0])


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_set_point_leads_a_body_by_a_metre_along_each_axis_and_by_two_radians_at_the_most(way: float) -> None:
    place, attitude, axis = np.array([1.0, -2.0, 3.0]), from_euler(0.3, -0.4, 2.0), way * np.array([0.6, 0.0, 0.8])
    ahead = place + way * np.array([1.5, 0.4, -0.9])
    np.testing.assert_allclose(leashed(ahead, place), place + way * np.array([1.0, 0.4, -0.9]), rtol=1e-12)
    for turn, kept in ((1.9, 1.9), (2.5, 2.0)):
        led = leashed_turn(multiply(attitude, exp(turn * axis)), attitude)
        np.testing.assert_allclose(difference(led, attitude), kept * axis, atol=1e-12)


def test_feed_forward_looks_ahead() -> None:
    now = Setpoint(ZERO, LEVEL, np.ones(3), 2 * np.ones(3), 3 * np.ones(3), 4 * np.ones(3))
    ahead = ahead_of(now, 0.1)
    np.testing.assert_allclose(ahead.v_w, 1.3)
    np.testing.assert_allclose(ahead.w_b, 2.4)
