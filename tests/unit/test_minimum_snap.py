"""Minimum snap without limits: against B-splines and other divisions of the time, and through coincident waypoints."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from firmware_py.core import rotations
from firmware_py.prepare.minimum_snap import Limits, Waypoint, distinct, plan
from tests.unit.waypoints import durations, extremes, poses, walk


@pytest.mark.parametrize("n", [2, 3, 10, 100])
def test_path_without_limits_is_the_spline_of_degree_seven(n: int) -> None:
    points = walk(n)
    times = durations(points)
    found = plan([Waypoint(p) for p in points], times, stretch=False)
    ends = [(k, np.zeros(3)) for k in (1, 2, 3)]
    spline = make_interp_spline(np.concatenate([[0.0], np.cumsum(times)]), points, k=7, bc_type=(ends, ends))
    for t in np.linspace(0.0, found.duration_s, 300):
        now = found.sample(float(t))
        np.testing.assert_allclose(now.p_wb, spline(t), atol=1e-6)
        if 0.0 < t < found.duration_s:
            np.testing.assert_allclose(now.v_w, spline(t, 1), atol=1e-6)
            np.testing.assert_allclose(now.a_w, spline(t, 2), atol=1e-6)
    snap = spline(np.linspace(0.0, found.duration_s, 20001), 4)
    cost = np.trapezoid(np.sum(snap**2, axis=1), dx=found.duration_s / 20000)
    assert found.snap_cost == pytest.approx(cost, rel=1e-3)
    assert found.method == "closed form"


def test_path_meets_a_hundred_poses() -> None:
    waypoints = poses(100)
    found = plan(waypoints, durations(walk(100)), stretch=False)
    for t, waypoint in zip(found.breaks, waypoints, strict=True):
        now = found.sample(float(t))
        np.testing.assert_allclose(now.p_wb, waypoint.p_wb, atol=1e-6)
        np.testing.assert_allclose(rotations.difference(now.q_wb.copy(), waypoint.q_wb), 0.0, atol=1e-6)


def test_wanted_rates_are_the_derivatives_of_the_wanted_pose() -> None:
    found, h = plan(poses(12), durations(walk(12)), stretch=False), 1e-5
    for t in np.linspace(0.013, 0.987, 31) * found.duration_s:
        before, now, after = (found.sample(float(t + k * h)) for k in (-1, 0, 1))
        np.testing.assert_allclose((after.p_wb - before.p_wb) / (2 * h), now.v_w, atol=1e-6)
        np.testing.assert_allclose((after.v_w - before.v_w) / (2 * h), now.a_w, atol=1e-6)
        turn = rotations.difference(after.q_wb.copy(), before.q_wb.copy()) / (2 * h)
        np.testing.assert_allclose(turn, now.w_b, atol=1e-6)
        np.testing.assert_allclose((after.w_b - before.w_b) / (2 * h), now.alpha_b, atol=1e-6)


def test_derivatives_up_to_the_fourth_do_not_jump_at_waypoints() -> None:
    found = plan(poses(20), durations(walk(20)), Limits(corridor_m=0.1), stretch=False)
    assert found.method == "osqp"
    lengths = np.diff(found.breaks)
    for k in range(len(lengths) - 1):
        left, right = found.coefficients[k], found.coefficients[k + 1]
        for order in range(5):
            end = sum(math.perm(j, order) * left[j] for j in range(order, 10)) / lengths[k] ** order
            start = math.factorial(order) * right[order] / lengths[k + 1] ** order
            np.testing.assert_allclose(end, start, atol=1e-9)


def test_path_does_not_depend_on_the_world_s_axes() -> None:
    waypoints, times = poses(8), durations(walk(8))
    turn = rotations.from_euler(0.4, -1.1, 2.0)
    turned = [Waypoint(rotations.rotate(turn, w.p_wb), rotations.multiply(turn, w.q_wb)) for w in waypoints]
    here, there = plan(waypoints, times), plan(turned, times)
    for t in np.linspace(0.0, here.duration_s, 50):
        a, b = here.sample(float(t)), there.sample(float(t))
        np.testing.assert_allclose(rotations.rotate(turn, a.p_wb.copy()), b.p_wb, atol=1e-8)
        np.testing.assert_allclose(a.w_b, b.w_b, atol=1e-8)
        expected = rotations.multiply(turn, a.q_wb.copy())
        np.testing.assert_allclose(rotations.difference(expected, b.q_wb.copy()), 0.0, atol=1e-8)


def test_robot_stops_where_it_is_told_and_passes_with_the_given_velocity() -> None:
    points = walk(5)
    waypoints = [Waypoint(p) for p in points]
    waypoints[2] = dataclasses.replace(waypoints[2], stop=True)
    waypoints[3] = dataclasses.replace(waypoints[3], velocity_w=np.array([0.1, -0.2, 0.05]))
    found = plan(waypoints, durations(points), stretch=False)
    stop, passing = (found.sample(float(found.breaks[k])) for k in (2, 3))
    for value in stop[2:]:
        np.testing.assert_allclose(value, 0.0, atol=1e-9)
    np.testing.assert_allclose(passing.v_w, [0.1, -0.2, 0.05], atol=1e-9)


def test_division_of_the_time_costs_less_snap_than_any_other_nearby() -> None:
    waypoints = [Waypoint(p) for p in walk(12)]
    best = plan(waypoints, 60.0, stretch=False)
    assert best.duration_s == pytest.approx(60.0)
    rng = np.random.default_rng(3)
    for _ in range(10):
        other = np.diff(best.breaks) * np.exp(0.05 * rng.normal(size=11))
        assert plan(waypoints, other * 60.0 / other.sum(), stretch=False).snap_cost > best.snap_cost


A, B, C = (np.array(p, dtype=float) for p in ((0, 0, 0.5), (1, 0, 0.5), (1, 1, 0.5)))
STOP = {"stop": True}


@pytest.mark.slow
@pytest.mark.parametrize("total_s", [None, 20.0])
@pytest.mark.parametrize(
    ("repeated", "once"),
    [
        ([(A, {}), (A, {}), (B, {}), (C, {})], [(A, {}), (B, {}), (C, {})]),
        ([(A, {}), (B, {}), (B + 1e-7, {}), (B, {}), (C, {})], [(A, {}), (B, {}), (C, {})]),
        ([(A, {}), (B, {}), (B, STOP), (C, {})], [(A, {}), (B, STOP), (C, {})]),
        ([(A, {}), (B, STOP), (B, {}), (C, {})], [(A, {}), (B, STOP), (C, {})]),
        ([(A, {}), (B, {}), (B, {"velocity_w": C - A}), (C, {})], [(A, {}), (B, {"velocity_w": C - A}), (C, {})]),
        ([(A, {}), (B, {}), (C, {}), (C, {})], [(A, {}), (B, {}), (C, {})]),
    ],
)
def test_waypoint_that_is_given_twice_is_flown_as_one(repeated: list, once: list, total_s: float | None) -> None:
    limits = Limits(velocity=np.full(3, 1.5))
    found, wanted = (plan([Waypoint(p, **more) for p, more in points], total_s, limits) for points in (repeated, once))
    np.testing.assert_array_equal(found.breaks, wanted.breaks)
    np.testing.assert_array_equal(found.coefficients, wanted.coefficients)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [False, True])
@pytest.mark.parametrize("off_m", [1e-5, 1e-4, 1e-3])
def test_waypoints_that_are_nearly_one_are_flown_in_a_time_that_is_not_absurd(off_m: float, stop: bool) -> None:
    limits = Limits(velocity=np.full(3, 0.4))
    once = plan([Waypoint(A), Waypoint(B, stop=stop), Waypoint(C)], None, limits)
    found = plan([Waypoint(A), Waypoint(B, stop=stop), Waypoint(B + off_m), Waypoint(C)], None, limits)
    assert found.duration_s < 1.5 * once.duration_s
    assert np.all(extremes(found)[0] <= 0.4 * (1.0 + 1e-3))


def test_waypoint_that_is_given_twice_with_durations_has_the_time_between() -> None:
    assert plan([Waypoint(p) for p in (A, B, B, C)], [6.0, 5.0, 6.0]).breaks.tolist() == [0.0, 6.0, 11.0, 17.0]


@pytest.mark.parametrize(
    "second",
    [
        {"q_wb": rotations.from_euler(0.0, 0.0, 1.0)},
        {"velocity_w": np.array([0.1, 0.0, 0.0])},
    ],
)
def test_place_that_is_passed_in_another_way_is_another_waypoint(second: dict[str, np.ndarray]) -> None:
    waypoints = [Waypoint(A), Waypoint(B, velocity_w=np.array([0.0, 0.1, 0.0])), Waypoint(B, **second), Waypoint(C)]
    assert distinct(waypoints)[1] == [0, 1, 2, 3]
    assert len(plan(waypoints, 20.0).breaks) == 4


def test_robot_that_is_to_stay_stays() -> None:
    found = plan([Waypoint(B)] * 4, 10.0)
    assert found.duration_s == 10.0
    np.testing.assert_allclose(found.sample(4.0).p_wb, B)


def test_same_request_gives_the_same_path() -> None:
    runs = [plan(poses(15), 80.0, Limits(corridor_m=0.1), stretch=False) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].coefficients, runs[1].coefficients)
