"""Minimum snap within the thrusters' limits: the wrench along a path, its usage, and the time the path takes."""

import dataclasses
import math

import numpy as np
import pytest

from firmware_py.core import rotations
from firmware_py.core.body import Body
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare import paths
from firmware_py.prepare.assembly import assemble, assemble_vehicle
from firmware_py.prepare.minimum_snap import InfeasibleError, Limits, Waypoint, plan
from firmware_py.prepare.snap_thrust import least_usage, usage, wrenches
from tests.unit.waypoints import poses


@pytest.fixture(scope="module")
def one() -> Body:
    return assemble_vehicle(load_vehicle("modcube"))


@pytest.mark.slow
def test_thrusters_keep_their_share_between_the_points_where_it_is_checked(one: Body) -> None:
    grids = [plan(poses(3, seed), None, body=one).grid(400)[..., :19].reshape(-1, 19) for seed in range(6)]
    assert 0.99 * Limits().thruster_share < max(usage(one, wrenches(one, grid))[0] for grid in grids) <= Limits().thruster_share


def test_wrench_along_a_path_is_that_of_the_equations_of_motion(one: Body) -> None:
    """Checks the wrench by differences: less drag and righting moment, it is the rate of change of the momentum in the world."""
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
        share = least_usage(one, wrench)[0]
        assert share <= 1.0 + 1e-9
        pinv = thrusters.pinv @ wrench
        assert share <= np.maximum(pinv / thrusters.f_max, pinv / thrusters.f_min).max() + 1e-9
        assert least_usage(one, 2.0 * wrench)[0] == pytest.approx(2.0 * share)
    assert usage(one, np.array([[0, 0, 0.1, 0, 0, 0], [0, 0, 5.0, 0, 0, 0]]))[1] == 1


@pytest.mark.slow
def test_worst_force_that_the_thrusters_reach_is_the_paper_s(one: Body) -> None:
    """The paper's errata: at least 22.9 N in the worst direction, with limits of 10 and -8 N."""
    d = np.random.default_rng(7).normal(size=(150, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    reach = [1.0 / least_usage(one, np.concatenate([x, np.zeros(3)]))[0] for x in d]
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


@pytest.mark.parametrize("short", range(4))
def test_refusal_names_the_piece_that_is_too_short_and_not_its_neighbour_that_swings_out(one: Body, short: int) -> None:
    """Regression: in 42 of 53 random paths it named another piece than the one with too little time."""
    waypoints = [Waypoint(np.array([1.0 * k, 0.3 * (-1.0) ** k, 0.2 * k])) for k in range(5)]
    durations = [1.0 if k == short else 8.0 for k in range(4)]
    with pytest.raises(InfeasibleError, match="thrusters would be used to") as refused:
        plan(waypoints, durations, body=one, stretch=False)
    assert refused.value.hurried == short
    with pytest.raises(InfeasibleError) as refused:
        plan(waypoints, 4.0, body=one, stretch=False)
    assert refused.value.hurried is None


@pytest.mark.slow
def test_free_durations_are_as_short_as_the_thrusters_allow(one: Body) -> None:
    found = plan(poses(4), None, body=one)
    motion = found.grid(16)[..., :19].reshape(-1, 19)
    assert usage(one, wrenches(one, motion))[0] == pytest.approx(0.8, abs=0.01)
    weak = dataclasses.replace(one.thrusters, f_min=0.5 * one.thrusters.f_min, f_max=0.5 * one.thrusters.f_max)
    half = dataclasses.replace(one, thrusters=weak)
    assert plan(poses(4), None, body=half).duration_s > 1.2 * found.duration_s


@pytest.mark.parametrize("stretch", [True, False])
def test_attitude_that_cannot_be_held_is_refused_at_once(stretch: bool) -> None:
    """Also where the durations are not to be stretched: there it was refused for the way to it, as if more time would help."""
    vehicle = load_vehicle("modcube")
    heavy = dataclasses.replace(vehicle, inertial=dataclasses.replace(vehicle.inertial, righting_arm_m=0.1))
    waypoints = [Waypoint(np.zeros(3)), Waypoint(np.array([1.0, 0, 0]), rotations.from_euler(math.pi / 2, 0.0, 0.0))]
    with pytest.raises(InfeasibleError, match="to stand still at waypoint 1") as refused:
        plan(waypoints, [10.0], body=assemble_vehicle(heavy), stretch=stretch)
    assert refused.value.place == (1, None)


@pytest.mark.slow
def test_docked_bodies_fly_the_same_waypoints() -> None:
    vehicle = load_vehicle("modcube")
    for cells in ([(0, 0, 0), (1, 0, 0)], [(0, 0, 0), (1, 0, 0), (0, 1, 0)]):
        found = plan(poses(3), None, body=assemble(cells, [0] * len(cells), [vehicle] * len(cells)))
        assert 3.0 < found.duration_s < 60.0
