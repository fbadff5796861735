"""Minimum snap against other formulations: B-splines, a dense active-set solver, momentum; and its refusals."""

import dataclasses
import itertools
import math

import daqp
import numpy as np
import osqp
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from firmware_py.core import rotations
from firmware_py.core.body import Body
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare import paths
from firmware_py.prepare.assembly import assemble, assemble_vehicle
from firmware_py.prepare.minimum_snap import InfeasibleError, Limits, Waypoint, distinct, plan
from firmware_py.prepare.piecewise import Piecewise
from firmware_py.prepare.snap_thrust import least_usage, usage, wrenches


def walk(n: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(0.5 * np.random.default_rng(seed).normal(size=(n, 3)), axis=0)


def durations(points: np.ndarray, seed: int = 1) -> np.ndarray:
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.asarray(2.0 + 3.0 * lengths + np.random.default_rng(seed).uniform(0.0, 2.0, len(lengths)))


def poses(n: int, seed: int = 2) -> list[Waypoint]:
    turns = Rotation.random(n, rng=np.random.default_rng(seed)).as_quat(scalar_first=True)
    return [Waypoint(p, q) for p, q in zip(walk(n), turns, strict=True)]


@pytest.fixture(scope="module")
def one() -> Body:
    return assemble_vehicle(load_vehicle("modcube"))


# ---------------------------------------------------------------- closed form


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


# ---------------------------------------------------------------- limits


def extremes(found: Piecewise) -> tuple[np.ndarray, np.ndarray]:
    grid = found.grid(200)
    return np.abs(grid[..., 7:10]).max(axis=(0, 1)), np.abs(grid[..., 13:16]).max(axis=(0, 1))


def test_limited_path_of_a_hundred_waypoints_keeps_limits_and_waypoints() -> None:
    points = walk(100)
    waypoints = [Waypoint(p) for p in points]
    times = np.diff(plan(waypoints, 330.0, stretch=False).breaks)
    velocity, acceleration = extremes(plan(waypoints, times, stretch=False))
    limits = Limits(velocity=0.98 * velocity, acceleration=0.93 * acceleration)
    found = plan(waypoints, times, limits, stretch=False)
    reached = extremes(found)
    assert np.all(reached[0] <= limits.velocity)
    assert np.all(reached[1] <= limits.acceleration)
    assert np.any(reached[1] > 0.99 * limits.acceleration)
    for t, p in zip(found.breaks, points, strict=True):
        np.testing.assert_allclose(found.sample(float(t)).p_wb, p, atol=1e-4)


def _row(piece: int, u: float, order: int, times: np.ndarray) -> np.ndarray:
    """Derivative of one piece as a row over the plain coefficients of all pieces."""
    found = np.zeros(10 * len(times))
    for j in range(order, 10):
        found[10 * piece + j] = math.perm(j, order) * u ** (j - order) / times[piece] ** order
    return found


def _equalities(points: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and targets: positions, continuity to the fourth derivative, rest at both ends."""
    last, rows, targets = len(times) - 1, [], []
    for k in range(len(times)):
        rows += [_row(k, 0.0, 0, times), _row(k, 1.0, 0, times)]
        targets += [points[k], points[k + 1]]
        if k < last:
            rows += [_row(k, 1.0, order, times) - _row(k + 1, 0.0, order, times) for order in range(1, 5)]
            targets += [0.0] * 4
    for order in (1, 2, 3):
        rows += [_row(0, 0.0, order, times), _row(last, 1.0, order, times)]
        targets += [0.0, 0.0]
    return np.array(rows), np.array(targets)


def _least_snap_by_active_set(points: np.ndarray, times: np.ndarray, bound: float) -> float:
    """Plain coefficients, equalities taken out by their null space, acceleration bounded on dense samples, daqp."""
    count = len(times)
    form = np.zeros((10 * count, 10 * count))
    for k, i, j in itertools.product(range(count), range(4, 10), range(4, 10)):
        form[10 * k + i, 10 * k + j] = math.perm(i, 4) * math.perm(j, 4) / (i + j - 7) / times[k] ** 7
    rows, targets = _equalities(points, times)
    _, singular, right = np.linalg.svd(rows)
    null = right[np.sum(singular > 1e-10 * singular[0]) :].T
    start = np.linalg.lstsq(rows, targets, rcond=None)[0]
    samples = np.array([_row(k, float(u), 2, times) for k in range(count) for u in np.linspace(0.0, 1.0, 101)])
    upper, lower = (sign * bound - samples @ start for sign in (1.0, -1.0))
    bounds = np.ascontiguousarray(samples @ null)
    free = np.zeros(len(upper), dtype=np.int32)
    x, _, flag, _ = daqp.solve(null.T @ form @ null, null.T @ form @ start, bounds, upper, lower, free)
    assert flag == 1
    return float((start + null @ x) @ form @ (start + null @ x))


def test_limited_path_has_the_least_snap_that_another_solver_finds() -> None:
    points, times = np.array([0.0, 0.7, 0.9, 0.4]), np.array([2.5, 1.5, 2.0])
    waypoints = [Waypoint(np.array([x, 0, 0])) for x in points]
    free = plan(waypoints, times, stretch=False)
    bound = 0.8 * float(extremes(free)[1][0])
    ours = plan(waypoints, times, Limits(acceleration=np.full(3, bound)), stretch=False)
    cost = _least_snap_by_active_set(points, times, bound)
    assert free.snap_cost < 0.95 * cost
    assert ours.snap_cost == pytest.approx(cost, rel=0.02)


def test_corridor_holds_between_waypoints() -> None:
    points = walk(25, seed=4)
    waypoints = [Waypoint(p) for p in points]

    def farthest(found: Piecewise) -> float:
        worst = 0.0
        for k, piece in enumerate(found.grid(60)[..., :3]):
            a, b = points[k], points[k + 1]
            share = np.clip((piece - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
            worst = max(worst, float(np.linalg.norm(piece - a - share[:, None] * (b - a), axis=1).max()))
        return worst

    assert farthest(plan(waypoints, durations(points), stretch=False)) > 0.2
    assert farthest(plan(waypoints, durations(points), Limits(corridor_m=0.06), stretch=False)) <= 0.06 * math.sqrt(2.0)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Limits(velocity=np.array([9, 0.05, 9])), r"velocity along y within 0.05 m/s between waypoints 1 and 2, at \d"),
        (Limits(acceleration=np.array([9, 9, 1e-3])), r"acceleration along z within 0.001 m/s\^2 between waypoints"),
        (Limits(angular_rate=0.01), r"turning takes .* rad/s of at most 0.01 rad/s between waypoints"),
        (Limits(angular_acceleration=1e-4), r"turning takes .* rad/s\^2 of at most 0.0001 rad/s\^2 between waypoints"),
    ],
)
def test_request_that_cannot_be_met_says_which_limit_and_where(limits: Limits, message: str) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0.3], [1, 1, 0], [0, 1, 0.3]], dtype=float)
    waypoints = [Waypoint(p, rotations.from_euler(0, 0, 0.5 * k)) for k, p in enumerate(points)]
    with pytest.raises(InfeasibleError, match=message):
        plan(waypoints, [5.0, 5.0, 5.0], limits, stretch=False)


def test_time_is_stretched_no_more_than_the_limit_asks() -> None:
    waypoints = [Waypoint(p) for p in walk(6)]
    limits = Limits(velocity=np.full(3, 0.12))
    found = plan(waypoints, durations(walk(6)), limits)
    assert found.stretch > 1.2
    assert np.all(extremes(found)[0] <= 0.12 * (1.0 + 1e-6))
    shorter = np.diff(found.breaks) * 0.99
    with pytest.raises(InfeasibleError):
        plan(waypoints, shorter, limits, stretch=False)


STOPS = [Waypoint(np.array(p, dtype=float), stop=True) for p in ((0, 0, 0), (1, 0, 0), (1, 1, 0))]


def test_path_that_stops_at_every_waypoint_says_which_limit_it_cannot_keep() -> None:
    message = r"no trajectory in 4.00 s that stops at every waypoint keeps the velocity along [xy] within 0.4 m/s between waypoints"
    with pytest.raises(InfeasibleError, match=message):
        plan(STOPS, 4.0, Limits(velocity=np.full(3, 0.4), corridor_m=0.1), stretch=False)


@pytest.mark.parametrize("times", [None, 4.0, [1.0, 2.0]])
def test_path_that_stops_at_every_waypoint_takes_the_time_that_its_limit_asks(times: object) -> None:
    found = plan(STOPS, times, Limits(velocity=np.full(3, 0.4)))  # type: ignore[arg-type]
    assert extremes(found)[0].max() == pytest.approx(0.4, rel=5e-3)
    assert extremes(found)[0].max() <= 0.4 * (1.0 + 1e-3)


def test_solver_that_gives_up_is_a_limit_that_cannot_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def give_up(*_: object, **__: object) -> None:
        raise osqp.OSQPException(4)

    monkeypatch.setattr(osqp.OSQP, "setup", give_up)
    waypoints = [Waypoint(p) for p in walk(6)]
    with pytest.raises(InfeasibleError, match=r"keeps the velocity along [xyz] within 0.12 m/s .*: OSQP gave up with error 4"):
        plan(waypoints, durations(walk(6)), Limits(velocity=np.full(3, 0.12)), stretch=False)


def test_request_that_fits_is_not_stretched(one: Body) -> None:
    found = plan([Waypoint(np.zeros(3)), Waypoint(np.array([0.5, 0.2, -0.1]))], [20.0], body=one)
    assert found.stretch == 1.0
    assert found.duration_s == 20.0


@pytest.mark.parametrize(
    ("waypoints", "times", "message"),
    [
        ([Waypoint(np.zeros(3))], None, "two waypoints"),
        ([Waypoint(np.zeros(3))] * 3, [1.0], "2 durations"),
        ([Waypoint(np.zeros(3))] * 3, [1.0, -1.0], "above zero"),
        ([Waypoint(np.zeros(3))] * 3, -5.0, "above zero"),
        ([Waypoint(np.zeros(3)), Waypoint(np.ones(3))], None, "free durations"),
    ],
)
def test_meaningless_request_is_refused(waypoints: list[Waypoint], times: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plan(waypoints, times)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "limits",
    [
        Limits(angular_rate=0.5),
        Limits(angular_acceleration=0.5, corridor_m=0.1),
        Limits(velocity=np.array([math.inf, math.inf, 0.1])),
        Limits(acceleration=np.array([math.inf, math.inf, 0.1])),
    ],
)
def test_free_durations_of_a_path_that_meets_no_limit_are_refused(limits: Limits) -> None:
    waypoints = [Waypoint(np.zeros(3)), Waypoint(np.array([1.0, 0, 0])), Waypoint(np.array([1.0, 1, 0]))]
    with pytest.raises(ValueError, match="free durations need a limit that this path meets"):
        plan(waypoints, None, limits)


def test_free_durations_of_a_robot_that_stays_are_refused(one: Body) -> None:
    for limits, body in ((Limits(velocity=np.ones(3), angular_rate=0.5), None), (None, one)):
        with pytest.raises(ValueError, match="free durations"):
            plan([Waypoint(np.ones(3))] * 3, None, limits, body)


def test_turning_alone_bounds_the_time_of_a_path_that_moves_too() -> None:
    waypoints = [Waypoint(np.zeros(3)), Waypoint(np.array([1.0, 0, 0]), rotations.from_euler(0, 0, 1.0))]
    grid = plan(waypoints, None, Limits(angular_rate=0.5)).grid(50)
    assert np.linalg.norm(grid[..., 10:13], axis=-1).max() == pytest.approx(0.5, rel=0.01)


def test_acceleration_keeps_its_limit_between_the_points_where_it_is_checked() -> None:
    waypoints, limits = [Waypoint(p) for p in walk(5, seed=2)], Limits(acceleration=np.full(3, 0.05), corridor_m=0.2)
    largest = np.abs(plan(waypoints, None, limits).grid(1000)[..., 13:16]).max()
    assert 0.99 * 0.05 < largest <= 0.05


@pytest.mark.parametrize(
    ("limits", "columns", "bound"),
    [(Limits(angular_rate=0.6), slice(10, 13), 0.6), (Limits(angular_acceleration=0.5), slice(16, 19), 0.5)],
)
def test_turning_keeps_its_limit_between_the_points_where_it_is_checked(limits: Limits, columns: slice, bound: float) -> None:
    largest = [np.linalg.norm(plan(poses(3, seed), None, limits).grid(1000)[..., columns], axis=-1).max() for seed in range(12)]
    assert 0.99 * bound < max(largest) <= bound


@pytest.mark.slow
def test_thrusters_keep_their_share_between_the_points_where_it_is_checked(one: Body) -> None:
    grids = [plan(poses(3, seed), None, body=one).grid(400)[..., :19].reshape(-1, 19) for seed in range(6)]
    assert 0.99 * Limits().thruster_share < max(usage(one, wrenches(one, grid))[0] for grid in grids) <= Limits().thruster_share


@pytest.mark.parametrize("k", [0, 1, 2])
def test_velocity_where_the_path_rests_is_refused(k: int) -> None:
    waypoints = [Waypoint(np.array([float(i), 0, 0]), stop=i == 1) for i in range(3)]
    waypoints[k] = dataclasses.replace(waypoints[k], velocity_w=np.array([0.3, 0, 0]))
    with pytest.raises(ValueError, match=f"waypoint {k} has a velocity, but the path rests there"):
        plan(waypoints, 10.0)
    waypoints[k] = dataclasses.replace(waypoints[k], velocity_w=np.zeros(3))
    assert plan(waypoints, 10.0).duration_s == pytest.approx(10.0)


# ---------------------------------------------------------------- what the thrusters can do


def test_wrench_along_a_path_is_that_of_the_equations_of_motion(one: Body) -> None:
    """Momentum in the world, by differences: the wrench less drag and righting moment is its rate of change."""
    body = dataclasses.replace(one, righting=np.array([0.0, 0.0, -0.1]))
    found, h = paths.moebius((0, 0, 1.5), 20.0), 1e-5

    def momentum(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        now = found.sample(t)
        r = rotations.to_matrix(now.q_wb.copy())
        m = body.mass @ np.concatenate([r.T @ now.v_w, now.w_b])
        return r @ m[:3], r @ m[3:], r

    for t in (3.0, 7.7, 11.0, 16.0):
        now = found.sample(t)
        asked = wrenches(body, np.concatenate(list(now))[None])[0]
        p1, l1, _ = momentum(t - h)
        p2, l2, _ = momentum(t + h)
        p, _, r = momentum(t)
        drag_free = dataclasses.replace(body.drag, nodes=np.zeros_like(body.drag.nodes), rotational=np.zeros(3))
        free = dataclasses.replace(body, drag=drag_free, righting=np.zeros(3))
        inertial = wrenches(free, np.concatenate(list(now))[None])[0]
        np.testing.assert_allclose(r @ inertial[:3], (p2 - p1) / (2 * h), atol=1e-5)
        moment = (l2 - l1) / (2 * h) + np.cross(now.v_w, p)
        np.testing.assert_allclose(r @ inertial[3:], moment, atol=1e-5)
        assert (asked[:3] - inertial[:3]) @ (r.T @ now.v_w) > 0.0
        up = r.T @ np.array([0, 0, -1.0])
        damping = -body.drag.rotational * np.linalg.norm(now.w_b) * now.w_b
        np.testing.assert_allclose(asked[3:] - inertial[3:], -np.cross(body.righting, up) - damping, atol=1e-3)


def test_least_usage_of_the_thrusters_is_between_the_bounds(one: Body) -> None:
    rng = np.random.default_rng(6)
    thrusters = one.thrusters
    for _ in range(10):
        forces = rng.uniform(thrusters.f_min, thrusters.f_max)
        wrench = thrusters.matrix @ forces
        share = least_usage(one, wrench)
        assert share <= 1.0 + 1e-9
        pinv = thrusters.pinv @ wrench
        assert share <= np.maximum(pinv / thrusters.f_max, pinv / thrusters.f_min).max() + 1e-9
        assert least_usage(one, 2.0 * wrench) == pytest.approx(2.0 * share)
    assert usage(one, np.array([[0, 0, 0.1, 0, 0, 0], [0, 0, 5.0, 0, 0, 0]]))[1] == 1


@pytest.mark.slow
def test_worst_force_that_the_thrusters_reach_is_the_paper_s(one: Body) -> None:
    """Errata: at least 22.9 N in the worst direction, at 10 and -8 N."""
    d = np.random.default_rng(7).normal(size=(150, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    reach = [1.0 / least_usage(one, np.concatenate([x, np.zeros(3)])) for x in d]
    assert min(reach) == pytest.approx(22.9, abs=0.3)


@pytest.mark.slow
def test_path_is_stretched_until_the_thrusters_can_fly_it(one: Body) -> None:
    waypoints = poses(5)
    with pytest.raises(InfeasibleError, match=r"thrusters would be used to \d+ % .* between waypoints \d and \d"):
        plan(waypoints, 4.0, body=one, stretch=False)
    found = plan(waypoints, 4.0, body=one)
    assert found.stretch > 1.5
    motion = found.grid(16)[..., :19].reshape(-1, 19)
    assert usage(one, wrenches(one, motion))[0] == pytest.approx(0.8, abs=0.01)


@pytest.mark.slow
def test_free_durations_are_as_short_as_the_thrusters_allow(one: Body) -> None:
    found = plan(poses(4), None, body=one)
    motion = found.grid(16)[..., :19].reshape(-1, 19)
    assert usage(one, wrenches(one, motion))[0] == pytest.approx(0.8, abs=0.01)
    weak = dataclasses.replace(one.thrusters, f_min=0.5 * one.thrusters.f_min, f_max=0.5 * one.thrusters.f_max)
    half = dataclasses.replace(one, thrusters=weak)
    assert plan(poses(4), None, body=half).duration_s > 1.2 * found.duration_s


def test_attitude_that_cannot_be_held_is_refused_at_once() -> None:
    vehicle = load_vehicle("modcube")
    heavy = dataclasses.replace(vehicle, inertial=dataclasses.replace(vehicle.inertial, righting_arm_m=0.1))
    waypoints = [Waypoint(np.zeros(3)), Waypoint(np.array([1.0, 0, 0]), rotations.from_euler(math.pi / 2, 0.0, 0.0))]
    with pytest.raises(InfeasibleError, match="to stand still at waypoint 1"):
        plan(waypoints, [10.0], body=assemble_vehicle(heavy))


@pytest.mark.slow
def test_docked_bodies_fly_the_same_waypoints() -> None:
    vehicle = load_vehicle("modcube")
    for cells in ([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), (1, 0, 0), (0, 1, 0)]):
        found = plan(poses(3), None, body=assemble(cells, [0] * len(cells), [vehicle] * len(cells)))
        assert 3.0 < found.duration_s < 60.0
