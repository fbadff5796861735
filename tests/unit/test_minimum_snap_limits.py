"""Minimum snap within limits: against an active-set solver, stretched no more than the limits require, and refused."""

import dataclasses
import itertools
import math

import daqp
import numpy as np
import osqp
import pytest

from firmware_py.core import rotations
from firmware_py.core.body import Body
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare import minimum_snap, snap_osqp
from firmware_py.prepare.assembly import assemble_vehicle
from firmware_py.prepare.minimum_snap import InfeasibleError, Limits, Waypoint, plan
from firmware_py.prepare.piecewise import Piecewise
from tests.unit.waypoints import durations, extremes, poses, walk


@pytest.fixture(scope="module")
def one() -> Body:
    return assemble_vehicle(load_vehicle("modcube"))


@pytest.mark.slow
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
    """A derivative of one piece, as a row over the plain coefficients of all pieces."""
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
    """Least snap in plain coefficients: equalities removed by their null space, acceleration bounded at dense samples, solved by daqp."""
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
    with pytest.raises(InfeasibleError, match=message) as refused:
        plan(waypoints, [5.0, 5.0, 5.0], limits, stretch=False)
    place = refused.value.place
    assert place.time_s is not None and f"between waypoints {place.waypoint} and {place.waypoint + 1}, at " in str(refused.value)


def test_equal_neighbours_count_each_for_itself_in_a_refusal() -> None:
    """They are merged before the path is planned, and the line of a file that the bench names was too early by one for each."""
    places = [(0, 0, 0), (0, 0, 0), (0.1, 0, 0), (0.1, 0, 0), (0.1, 0, 0), (2, 0, 0)]
    waypoints = [Waypoint(np.array(p, dtype=float), stop=True) for p in places]
    with pytest.raises(InfeasibleError, match=r"velocity along x within 0.1 m/s between waypoints 4 and 5, at \d") as refused:
        plan(waypoints, 10.0, Limits(velocity=np.full(3, 0.1)), stretch=False)
    assert refused.value.place.waypoint == 4
    with pytest.raises(InfeasibleError, match="between waypoints 1 and 2"):
        plan(waypoints[:3], 1.0, Limits(velocity=np.full(3, 0.01)), stretch=False)


def test_time_is_stretched_no_more_than_the_limit_asks() -> None:
    waypoints = [Waypoint(p) for p in walk(6)]
    limits = Limits(velocity=np.full(3, 0.12))
    found = plan(waypoints, durations(walk(6)), limits)
    assert found.stretch > 1.2
    assert np.all(extremes(found)[0] <= 0.12 * (1.0 + 1e-6))
    shorter = np.diff(found.breaks) * 0.99
    with pytest.raises(InfeasibleError):
        plan(waypoints, shorter, limits, stretch=False)


@pytest.mark.parametrize("length_m", [0.1, 1.0, 5.0, 100.0])
def test_straight_path_takes_the_same_share_of_its_speed_whatever_its_length(length_m: float) -> None:
    """Regression: OSQP took paths of five metres and more for infeasible where shorter ones were flown, and they took 1.4 times as long."""
    limits = Limits(velocity=np.full(3, 0.15), acceleration=np.full(3, 10.0))
    found = plan([Waypoint(np.zeros(3)), Waypoint(np.array([length_m, 0.0, 0.0]))], None, limits)
    assert length_m / found.duration_s == pytest.approx(0.65 * 0.15, rel=0.02)
    assert np.all(extremes(found)[0] <= 0.15 * (1.0 + 1e-6))


def test_free_durations_are_found_though_a_given_velocity_bounds_them_from_above() -> None:
    """At 1.5 m/s through the middle of a narrow corridor, a path that takes the 20 s with which the search begins would overshoot."""
    at = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    waypoints = [Waypoint(at[0]), Waypoint(at[1], velocity_w=np.array([1.5, 0.0, 0.0])), Waypoint(at[2])]
    limits = Limits(acceleration=np.full(3, 2.0), corridor_m=0.02)
    with pytest.raises(InfeasibleError, match=r"keeps the corridor"):
        plan(waypoints, 20.0, limits, stretch=False)
    found = plan(waypoints, limits=limits)
    assert found.duration_s < 5.0
    assert extremes(found)[1].max() == pytest.approx(2.0, rel=5e-3)


def test_search_for_free_durations_past_a_given_velocity_tries_none_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """A try takes seconds where there are many waypoints."""
    waypoints = [Waypoint(np.zeros(3)), Waypoint(np.eye(3)[0], velocity_w=1.5 * np.eye(3)[0]), Waypoint(2.0 * np.eye(3)[0])]
    limits = Limits(acceleration=np.full(3, 2.0), corridor_m=0.02)
    tried, attempt = list[float](), minimum_snap._Request.attempt
    base = minimum_snap._Request.of(waypoints, limits, None).durations(None)

    def noted(request: minimum_snap._Request, durations: np.ndarray) -> Piecewise:
        tried.append(float(durations[0] / base[0]))
        return attempt(request, durations)

    monkeypatch.setattr(minimum_snap._Request, "attempt", noted)
    plan(waypoints, limits=limits)
    assert tried[:3] == [1.0, 2.0, 0.5] and len(set(tried)) == len(tried)


STOPS = [Waypoint(np.array(p, dtype=float), stop=True) for p in ((0, 0, 0), (1, 0, 0), (1, 1, 0))]


def test_path_that_stops_at_every_waypoint_says_which_limit_it_cannot_keep() -> None:
    message = r"no trajectory in 4.00 s that stops at every waypoint keeps the velocity along [xy] within 0.4 m/s between waypoints"
    with pytest.raises(InfeasibleError, match=message) as refused:
        plan(STOPS, 4.0, Limits(velocity=np.full(3, 0.4), corridor_m=0.1), stretch=False)
    assert f"between waypoints {refused.value.place.waypoint} and" in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 9, 11, 17, 19])
def test_pieces_whose_durations_differ_by_up_to_64_times_keep_their_velocity_without_more_time(seed: int) -> None:
    """They took 1.6 to 55 times as long as asked, and went up to 1.4 % over a velocity near the ends of long pieces."""
    rng = np.random.default_rng(seed)
    times = rng.choice([0.5, 1.0, 8.0, 16.0, 32.0], size=6)
    points = np.vstack([np.zeros(3), np.cumsum(rng.uniform(-0.1, 0.1, (6, 3)) * times[:, None], axis=0)])
    found = plan([Waypoint(p) for p in points], list(times), Limits(velocity=np.full(3, 0.15)))
    assert (found.method, found.stretch) == ("osqp", 1.0)
    speeds = [np.abs(found.sample(float(t)).v_w).max() for t in np.linspace(0.0, found.duration_s, 10_001)]
    assert 0.14 < max(speeds) < 0.1502


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


def test_solver_that_runs_out_of_steps_accuses_the_limit_that_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """It then proves nothing; the limit along x, which comes first, is never met."""
    monkeypatch.setitem(snap_osqp._SOLVER, "max_iter", 10)
    waypoints, limits = [Waypoint(p) for p in walk(6)], Limits(velocity=np.array([9.0, 9.0, 0.12]))
    with pytest.raises(InfeasibleError, match=r"keeps the velocity along z within 0.12 m/s .*: OSQP gave up with maximum iterations"):
        plan(waypoints, durations(walk(6)), limits, stretch=False)


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


@pytest.mark.slow
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
def test_path_is_looked_at_in_no_shorter_pieces_than_time_can_tell() -> None:
    """A piece of a day beside one of a nanosecond throws the quaternion far off, and it returns within no time at the end of the piece."""
    found = plan(poses(4), [1e-9, 1e5, 1.0], stretch=False)
    assert np.all(np.diff(found.resolved(48, 0.3).breaks) > 0.0)
    with pytest.raises(InfeasibleError, match="turning takes"):
        plan(poses(4), [1e-9, 1e5, 1.0], Limits(angular_rate=1.0), stretch=False)


@pytest.mark.parametrize("k", [0, 1, 2])
def test_velocity_where_the_path_rests_is_refused(k: int) -> None:
    waypoints = [Waypoint(np.array([float(i), 0, 0]), stop=i == 1) for i in range(3)]
    waypoints[k] = dataclasses.replace(waypoints[k], velocity_w=np.array([0.3, 0, 0]))
    with pytest.raises(ValueError, match=f"waypoint {k} has a velocity, but the path rests there"):
        plan(waypoints, 10.0)
    waypoints[k] = dataclasses.replace(waypoints[k], velocity_w=np.zeros(3))
    assert plan(waypoints, 10.0).duration_s == pytest.approx(10.0)


def test_solver_that_need_not_polish_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    """The words would appear in the terminal of a flight, among the robot's own."""
    points = [Waypoint(np.array([0.0, 0.0, 0.5])), Waypoint(np.array([1.0, 0.0, 0.5]), stop=True), Waypoint(np.array([1.0, 1.0, 0.5]))]
    assert plan(points, None, Limits(velocity=np.full(3, 1.5))).method == "osqp"
    assert capfd.readouterr().out == ""
