"""A path that is timed anew is the same path, keeps every limit, and takes hardly longer than the least time that there is."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from firmware_py.core.rotations import from_euler
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare import minimum_snap
from firmware_py.prepare.assembly import assemble_vehicle
from firmware_py.prepare.minimum_snap import InfeasibleError, Limits, UnwantedError, Waypoint, fastest, plan
from firmware_py.prepare.piecewise import Piecewise
from firmware_py.prepare.snap_osqp import _Problem, solve_limited
from firmware_py.prepare.snap_timing import MOVED_M, Timed, hastened, stretch_within

SPEED, ACCELERATION = 0.3, 0.1
LIMITS = Limits(np.full(3, SPEED / math.sqrt(3.0)), np.full(3, ACCELERATION), 0.1, 0.5, 0.5)
SURVEY = [np.array([10.0 * (k % 4 in (1, 2)), k // 2, 2.0]) for k in range(5)]
"""Lanes of 10 m, 1 m apart."""


def timed(places: list[np.ndarray], yaws: list[float] | None = None) -> tuple[Piecewise, Timed]:
    """The path through `places` as it was planned, and timed anew."""
    yaws = yaws or [0.0] * len(places)
    waypoints = [Waypoint(place, from_euler(0.0, 0.0, yaw)) for place, yaw in zip(places, yaws, strict=True)]
    path = plan(waypoints, None, LIMITS)
    return path, hastened(path, SPEED, LIMITS, lambda found: True)


@pytest.fixture(scope="module")
def survey() -> Piecewise:
    return plan([Waypoint(place) for place in SURVEY], None, LIMITS)


def motion(path: Piecewise) -> np.ndarray:
    """(n, 19) p, q, v, w, a, alpha at many times."""
    return np.array([np.concatenate(path.sample(t)) for t in np.linspace(0.0, path.duration_s, 4000)])


def assert_within_limits(path: Piecewise) -> None:
    x = motion(path)
    assert np.linalg.norm(x[:, 7:10], axis=1).max() <= SPEED * (1.0 + 1e-4)
    assert np.abs(x[:, 13:16]).max() <= ACCELERATION * (1.0 + 1e-3)
    assert np.linalg.norm(x[:, 10:13], axis=1).max() <= 0.5 * (1.0 + 1e-4)
    assert np.linalg.norm(x[:, 16:19], axis=1).max() <= 0.5 * (1.0 + 1e-3)
    np.testing.assert_allclose(x[[0, -1], 7:], 0.0, atol=1e-9, err_msg="at rest at both ends")


@pytest.mark.slow
@pytest.mark.parametrize("length_m", [0.05, 1.0, 5.0, 100.0])
def test_straight_line_takes_hardly_longer_than_full_acceleration_full_speed_and_full_braking(length_m: float) -> None:
    """The least time: of a trapezoid of speed, or of a triangle where the way is too short for full speed. No motion beats it."""
    _, found = timed([np.array([0.0, 0.0, 1.0]), np.array([length_m, 0.0, 1.0])])
    top = min(SPEED, math.sqrt(ACCELERATION * length_m))
    least_s = length_m / top + top / ACCELERATION
    assert_within_limits(found.path)
    assert least_s < found.path.duration_s < 1.02 * least_s + 4.0


@pytest.mark.slow
def test_diagonal_is_flown_at_the_speed_itself_not_at_its_share_along_each_axis() -> None:
    _, found = timed([np.array([0.0, 0.0, 5.0]), np.array([20.0, 20.0, 25.0])])
    speeds = np.linalg.norm(motion(found.path)[:, 7:10], axis=1)
    assert_within_limits(found.path)
    assert np.median(speeds) > 0.97 * SPEED


@pytest.mark.slow
def test_survey_takes_less_than_half_the_time_on_the_same_path() -> None:
    """Regression: a run of places without a stop was slower than one that stopped at each of them."""
    path, found = timed(SURVEY, [0.3 * k for k in range(len(SURVEY))])
    assert_within_limits(found.path)
    assert found.path.duration_s < 0.5 * path.duration_s
    assert found.at_s[0] == 0.0 and found.at_s[-1] == pytest.approx(found.path.duration_s)
    for place, before_s, at_s in zip(SURVEY, path.breaks, found.at_s, strict=True):
        now, before = found.path.sample(at_s), path.sample(before_s)
        np.testing.assert_allclose(now.p_wb, place, atol=1e-9)
        np.testing.assert_allclose(now.q_wb, before.q_wb, atol=1e-9)
    for k, (a, b) in enumerate(itertools.pairwise(SURVEY)):
        legs = [np.array([p.sample(t).p_wb for t in np.linspace(*times[k : k + 2], 300)]) for p, times in ((path, path.breaks), found)]
        along = (b - a) / np.linalg.norm(b - a)
        was_off, is_off = (np.linalg.norm(leg - a - np.outer((leg - a) @ along, along), axis=1).max() for leg in legs)
        assert is_off < was_off + 0.002


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "acceleration", "corridor_m"), [(1.0, 0.5, 0.2), (1.0, 2.0, 0.02), (2.0, 2.0, 0.2)])
def test_path_stays_where_it_was_at_any_acceleration(speed: float, acceleration: float, corridor_m: float) -> None:
    """Regression: at 2 m/s^2 it moved by 58 mm, and left a corridor of 20 mm by 24 mm."""
    limits = Limits(np.full(3, speed / math.sqrt(3.0)), np.full(3, acceleration), corridor_m, 0.5, 0.5)
    square = [Waypoint(np.array(place)) for place in ((0.0, 0.0, 3.0), (4.0, 0.0, 3.0), (4.0, 4.0, 3.0), (0.0, 4.0, 3.0))]
    path = plan(square, None, limits)
    found = hastened(path, speed, limits, lambda found: True)
    assert found.path.duration_s < 0.8 * path.duration_s
    before, now = motion(path)[:, :3], motion(found.path)[::10, :3]
    half_step_m = 0.5 * np.linalg.norm(np.diff(before, axis=0), axis=1).max()
    for place in now:
        assert np.linalg.norm(before - place, axis=1).min() < math.hypot(MOVED_M, half_step_m)


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "acceleration"), [(0.3, 2.0), (0.02, 0.1)])
def test_more_acceleration_than_the_speed_needs_costs_no_time(speed: float, acceleration: float) -> None:
    """Regression: lanes at 0.3 m/s took 174 s with 2 m/s^2, and 92 s with 0.5 m/s^2."""
    limits = Limits(np.full(3, speed / math.sqrt(3.0)), np.full(3, acceleration), 0.1, 0.5, 0.5)
    assert fastest([Waypoint(place) for place in SURVEY], speed, limits).path.duration_s < 1.25 * 22.0 / speed


def assert_within_corridor(found: Timed, places: list[np.ndarray], corridor_m: float) -> None:
    """Beside the straight lines between the places, beyond their ends, and at the places when it says so."""
    for k, (a, b) in enumerate(itertools.pairwise(places)):
        ways = np.array([found.path.sample(t).p_wb for t in np.linspace(*found.at_s[k : k + 2], 500)]) - a
        along = (b - a) / np.linalg.norm(b - a)
        assert np.linalg.norm(ways - np.outer(ways @ along, along), axis=1).max() <= corridor_m
        assert -corridor_m <= (ways @ along).min() and (ways @ along).max() <= np.linalg.norm(b - a) + corridor_m
        np.testing.assert_allclose(ways[-1] + a, b, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
@pytest.mark.parametrize(("size_m", "longest"), [(0.3, 1.25), (3.0, 1.04), (10.0, 1.04)])
def test_fastest_path_is_solved_once_and_within_limits(monkeypatch: pytest.MonkeyPatch, size_m: float, longest: float, seed: int) -> None:
    """Compared with a solution at each of many paces, of which the best is taken. Regression: planning twenty lanes took 36 s."""
    solved: list[int] = []
    monkeypatch.setattr(minimum_snap, "solve_limited", lambda *given: solved.append(1) or solve_limited(*given))
    rng = np.random.default_rng(seed)
    places = list(rng.uniform(-size_m, size_m, (5, 3)))
    corridor_m, yaws = float(rng.choice([0.03, 0.1, 1.0])), rng.uniform(-1.2, 1.2, 5)
    limits = dataclasses.replace(LIMITS, velocity=None, corridor_m=corridor_m)
    waypoints = [Waypoint(place, from_euler(0.0, 0.0, yaw)) for place, yaw in zip(places, yaws, strict=True)]
    found = fastest(waypoints, SPEED, limits)
    assert_within_limits(found.path)
    assert_within_corridor(found, places, corridor_m + MOVED_M)
    assert len(solved) <= 1
    by_pace = hastened(plan(waypoints, None, dataclasses.replace(LIMITS, corridor_m=corridor_m)), SPEED, LIMITS, lambda found: True)
    assert found.path.duration_s < longest * by_pace.path.duration_s


@pytest.mark.slow
@pytest.mark.parametrize(("length_m", "corridor_m"), [(20.0, 0.02), (100.0, 0.1), (200.0, 0.02)])
def test_corridor_a_thousandth_of_a_leg_and_less_is_flown_within(length_m: float, corridor_m: float) -> None:
    """Regression: where OSQP says, wrongly, that there is no such path, the mission was refused. It stops at each place now."""
    places = [place * np.array([0.1 * length_m, 1.0, 1.0]) for place in SURVEY]
    found = fastest([Waypoint(place) for place in places], SPEED, dataclasses.replace(LIMITS, corridor_m=corridor_m))
    assert_within_limits(found.path)
    assert_within_corridor(found, places, corridor_m + MOVED_M)
    assert found.path.duration_s < 1.2 * (2.0 * length_m + 2.0) / SPEED


def test_turns_on_the_spot_before_a_leg_are_flown_from_stop_to_stop_where_the_smooth_path_turns_too_far() -> None:
    """Regression: one mission of sixteen that looked about twice and then went on for 20 m was refused."""
    places, yaws = [0.0, 0.0, 0.0, 20.0], [1.8, -2.7, -1.8, 1.9]
    waypoints = [Waypoint(np.array([x, 0.0, 2.0]), from_euler(0.0, 0.0, yaw)) for x, yaw in zip(places, yaws, strict=True)]
    with pytest.raises(InfeasibleError, match="attitude turns too far"):
        plan(waypoints, None, LIMITS)
    found = fastest(waypoints, SPEED, LIMITS)
    assert_within_limits(found.path)
    for waypoint, at_s in zip(waypoints, found.at_s, strict=True):
        now = found.path.sample(at_s)
        np.testing.assert_allclose(now.p_wb, waypoint.p_wb, atol=1e-9)
        assert waypoint.q_wb is not None and abs(now.q_wb @ waypoint.q_wb) == pytest.approx(1.0)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_path_is_stretched_to_just_within_its_limits_from_any_pace(survey: Piecewise, factor: float) -> None:
    other = survey.slowed(factor)
    kept = other.slowed(stretch_within(other, SPEED, LIMITS))
    assert_within_limits(kept)
    with pytest.raises(AssertionError):
        assert_within_limits(kept.slowed(0.98))


def test_path_that_no_pace_makes_flyable_is_refused_with_its_place() -> None:
    """No thruster of a BlueROV2 pitches it."""
    body = assemble_vehicle(load_vehicle("bluerov2"))
    pitched = Waypoint(np.array([5.0, 0.0, 5.0]), from_euler(0.0, 0.5, 0.0))
    with pytest.raises(InfeasibleError, match="to stand still at waypoint 1") as refused:
        fastest([Waypoint(np.array([0.0, 0.0, 5.0])), pitched], SPEED, LIMITS, body)
    assert refused.value.place.waypoint == 1


def test_turn_on_the_spot_is_timed_too() -> None:
    path, found = timed([np.zeros(3), np.zeros(3)], [0.0, 2.0])
    assert_within_limits(found.path)
    assert 2.0 / 0.5 + 0.5 / 0.5 < found.path.duration_s <= path.duration_s


@pytest.mark.slow
@pytest.mark.parametrize("slower_than", [1.0, 1.5, 3.0])
def test_path_is_slowed_no_more_than_the_robot_needs(survey: Piecewise, slower_than: float) -> None:
    """A robot that flies only paths that take a given time or longer."""
    fastest = hastened(survey, SPEED, LIMITS, lambda found: True).path.duration_s
    found = hastened(survey, SPEED, LIMITS, lambda found: found.duration_s >= slower_than * fastest)
    if slower_than * fastest > survey.duration_s:
        assert found.path is survey and found.at_s is survey.breaks
    else:
        assert slower_than * fastest <= found.path.duration_s < 1.03 * slower_than * fastest


def test_robot_that_can_fly_nothing_faster_keeps_its_path(survey: Piecewise) -> None:
    found = hastened(survey, SPEED, LIMITS, lambda found: False)
    assert found.path is survey and found.at_s is survey.breaks


def test_timing_that_nobody_waits_for_any_more_ends() -> None:
    with pytest.raises(UnwantedError):
        fastest([Waypoint(place) for place in SURVEY], SPEED, LIMITS, wanted=lambda: False)


def test_path_that_nobody_waits_for_any_more_is_solved_no_further(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: with five hundred places, 131 s passed before it was seen that the mission had been cancelled."""
    rounds: list[int] = []
    solve = _Problem.solve
    monkeypatch.setattr(_Problem, "solve", lambda *given: rounds.append(1) or solve(*given))
    places = np.random.default_rng(1).uniform(-10.0, 10.0, (9, 3))
    fastest([Waypoint(place) for place in places], SPEED, LIMITS)
    assert len(rounds) > 2
    rounds.clear()
    with pytest.raises(UnwantedError):
        fastest([Waypoint(place) for place in places], SPEED, LIMITS, wanted=lambda: len(rounds) < 2)
    assert len(rounds) == 2


@pytest.mark.slow
def test_thrusters_of_a_real_robot_bound_the_pace() -> None:
    """At 1.5 m/s a module needs more thrust than a fifth of its thrusters' range."""
    body, fast = assemble_vehicle(load_vehicle("modcube")), 1.5
    limits = Limits(np.full(3, fast), np.full(3, 1.0), 0.5, 0.5, 0.5, thruster_share=0.2)
    waypoints = [Waypoint(np.array([x, 0.0, 5.0])) for x in (0.0, 20.0)]
    found = fastest(waypoints, fast, limits, body)
    assert found.path.duration_s < plan(waypoints, None, limits, body).duration_s
    assert np.linalg.norm(motion(found.path)[:, 7:10], axis=1).max() < 0.9 * fast


@pytest.mark.slow
def test_same_path_is_timed_the_same_to_the_byte(survey: Piecewise) -> None:
    first, second = (hastened(survey, SPEED, LIMITS, lambda found: True) for _ in range(2))
    assert first.path.coefficients.tobytes() == second.path.coefficients.tobytes()
    assert first.path.breaks.tobytes() == second.path.breaks.tobytes()
