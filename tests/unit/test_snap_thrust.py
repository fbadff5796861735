"""Paths of bodies whose thrusters span fewer than six axes: the rest is left to buoyancy, within bounds."""

import dataclasses
import math
import re

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from firmware_py.app.mission_plan import plan_mission
from firmware_py.core import propagation, rotations
from firmware_py.core.allocator import Allocator
from firmware_py.core.body import Body
from firmware_py.core.controller import Controller
from firmware_py.core.setpoint import Trajectory
from firmware_py.core.types import Estimate
from firmware_py.description.parameters import Allocation, Control
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.ground.mission_legs import Leg
from firmware_py.ground.plan_jobs import Plan, PlanJob
from firmware_py.prepare import snap_thrust
from firmware_py.prepare.assembly import assemble_vehicle
from firmware_py.prepare.minimum_snap import InfeasibleError, Limits, Waypoint, plan
from firmware_py.prepare.snap_check import MOST_LEAN
from firmware_py.prepare.snap_thrust import divide, least_usage, usage, wrenches

START, NORTH, EAST = np.array([0.0, 0.0, 2.0]), np.array([2.0, 0.0, 2.0]), np.array([0.0, 2.0, 2.0])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def bluerov2() -> Body:
    return assemble_vehicle(load_vehicle("bluerov2"))


@pytest.fixture(params=["bluerov2", "girona500"])
def passive(request: pytest.FixtureRequest) -> Body:
    """A vehicle that leaves an axis to buoyancy: pitch (bluerov2) or roll (girona500)."""
    return assemble_vehicle(load_vehicle(request.param))


def job(*places: np.ndarray, yaw: float | None = None, q_wb: np.ndarray = LEVEL, speed_m_s: float = 0.3) -> PlanJob:
    return PlanJob(0, 1, START, q_wb, tuple(Leg(k, p, yaw, 0.0, speed_m_s) for k, p in enumerate(places)), 0.2, 1.0)


def flown(found: Plan) -> Trajectory:
    assert found.trajectory is not None, found
    return found.trajectory


def without_sway(body: Body) -> Body:
    """The same body with thrusters that give no sideways force."""
    matrix = body.thrusters.matrix.copy()
    matrix[1] = 0.0
    return dataclasses.replace(body, thrusters=dataclasses.replace(body.thrusters, matrix=matrix, pinv=np.linalg.pinv(matrix)))


def believed(x: np.ndarray) -> Estimate:
    zero = np.zeros(3)
    return Estimate(x[:3].copy(), x[3:7].copy(), x[7:13].copy(), zero, zero, zero, zero, 0, math.nan, 0, 0, True)


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [None, 0.785])
@pytest.mark.parametrize("place", [NORTH, EAST, NORTH + EAST - START], ids=["north", "east", "north-east"])
def test_vehicle_that_leaves_an_axis_to_buoyancy_has_its_missions_planned(passive: Body, place: np.ndarray, yaw: float | None) -> None:
    """As long as for one that leaves none, but for a hundredth or two where it would lean too far."""
    six = assemble_vehicle(load_vehicle("bluerov2_heavy"))
    expected = flown(plan_mission(job(place, yaw=yaw), six)).duration_s
    assert flown(plan_mission(job(place, yaw=yaw), passive)).duration_s == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("place", [NORTH, EAST, 5.0 * NORTH], ids=["north", "east", "far and deep"])
def test_mission_of_such_a_vehicle_is_flown_and_it_leans_no_more_than_planned(passive: Body, place: np.ndarray) -> None:
    """Flown as fast as it can: the moment of the added mass, which tips a moving body, counts beside buoyancy."""
    period_s = 0.01
    path = flown(plan_mission(job(place, speed_m_s=1.5), passive))
    controller, allocator = Controller(passive, Control()), Allocator(passive, Allocation())
    x = np.zeros(propagation.STATES)
    x[:3], x[3:7] = START, LEVEL
    planned = leant = error = 0.0
    for k in range(round(path.duration_s / period_s)):
        wanted = path.sample(k * period_s)
        planned = max(planned, float(divide(passive, np.concatenate(list(wanted))[None]).lean[0]))
        leant = max(leant, float(np.linalg.norm(rotations.difference(wanted.q_wb.copy(), x[3:7].copy()))))
        error = max(error, float(np.linalg.norm(wanted.p_wb - x[:3])))
        x = propagation.step(x, allocator.step(controller.step(wanted, wanted, believed(x))).achieved, period_s, *passive.plant)
    assert planned <= 1.01 * MOST_LEAN
    assert leant <= 1.1 * planned + 0.01
    assert error < 0.01


def test_lean_is_the_angle_at_which_buoyancy_gives_the_moment(bluerov2: Body) -> None:
    """At a wanted pitch that no thruster can hold, the vehicle stays level: its lean is the tangent of that pitch."""
    motion = np.zeros((2, 19))
    motion[0, 3:7], motion[1, 3:7] = rotations.from_euler(0.0, 0.15, 0.4), rotations.from_euler(0.3, 0.0, -1.0)
    found = divide(bluerov2, motion)
    np.testing.assert_allclose(found.lean, [math.tan(0.15), 0.0], atol=1e-6)
    np.testing.assert_array_equal(found.lacking, 0.0)
    righting = float(np.linalg.norm(bluerov2.righting))
    np.testing.assert_allclose(found.thrust[1, 3:], [righting * math.sin(0.3), 0.0, 0.0], atol=1e-6)


def asked_of(body: Body, attitude: Rotation, v_w: np.ndarray, w_w: np.ndarray, a_w: np.ndarray, alpha_w: np.ndarray) -> np.ndarray:
    """(6,) wrench, body frame, that a motion given in the world needs without drag: Kirchhoff and the moment of buoyancy, by numpy."""
    v, w, a, alpha, up = (attitude.inv().apply(each) for each in (v_w, w_w, a_w, alpha_w, [0.0, 0.0, -1.0]))
    momentum = body.mass @ np.r_[v, w]
    change = body.mass @ np.r_[a - np.cross(w, v), alpha]
    turning = np.r_[np.cross(w, momentum[:3]), np.cross(w, momentum[3:]) + np.cross(v, momentum[:3])]
    return np.asarray(change + turning - np.r_[np.zeros(3), np.cross(body.righting, up)])


def test_vehicle_that_leans_goes_on_turning_about_the_same_axes_of_the_world(passive: Body) -> None:
    """What the turning adds to the stiffness of buoyancy counts in the lean and in the wrench left to the thrusters."""
    drag = dataclasses.replace(passive.drag, nodes=0.0 * passive.drag.nodes, rotational=np.zeros(3), linear=np.zeros(6))
    body = dataclasses.replace(passive, drag=drag)
    attitude = Rotation.from_euler("xyz", [0.05, -0.04, 0.9])
    moves = [np.array(m) for m in ([0.2, -0.1, 0.05], [0.1, -0.2, 1.2], [0.1, 0.2, 0.0], [0.3, 0.2, -0.5])]
    v_w, w_w, a_w, alpha_w = moves
    motion = np.r_[np.zeros(3), attitude.as_quat()[[3, 0, 1, 2]], v_w, attitude.inv().apply(w_w), a_w, attitude.inv().apply(alpha_w)]
    found = divide(body, motion[None])
    missing = null_space(body.thrusters.matrix.T)[:, 0]
    upright, step = asked_of(body, attitude, *moves), 1e-4
    ends = [asked_of(body, attitude * Rotation.from_rotvec(side * step * missing[3:]), *moves) for side in (1.0, -1.0)]
    slope = (ends[0] - ends[1]) / (2.0 * step)
    share = -float(missing @ upright) / float(missing @ slope)
    np.testing.assert_allclose(found.lean, [abs(share) * np.linalg.norm(missing[3:])], rtol=1e-6)
    np.testing.assert_allclose(found.thrust[0], upright + share * slope, atol=1e-5)


def test_what_is_left_to_thrusters_is_within_their_span(passive: Body) -> None:
    motion = flown(plan_mission(job(NORTH + EAST, yaw=0.7), passive)).parts[0][1].grid(16)[..., :19].reshape(-1, 19)  # type: ignore[attr-defined]
    found, thrusters = divide(passive, motion), passive.thrusters
    np.testing.assert_allclose(found.thrust @ thrusters.pinv.T @ thrusters.matrix.T, found.thrust, atol=1e-9)
    assert usage(passive, found.thrust)[0] < 0.6
    assert found.lean.max() > 1e-3


def test_vehicle_with_all_six_axes_leaves_nothing_to_buoyancy() -> None:
    body = assemble_vehicle(load_vehicle("modcube"))
    motion = np.random.default_rng(1).normal(size=(20, 19))
    motion[:, 3:7] /= np.linalg.norm(motion[:, 3:7], axis=1, keepdims=True)
    found = divide(body, motion)
    np.testing.assert_array_equal(found.thrust, wrenches(body, motion))
    assert not found.lean.any() and not found.lacking.any()


@pytest.mark.parametrize(
    ("q_wb", "message"),
    [
        (rotations.from_euler(0.0, 0.5, 0.0), "no pitch: the robot would lean by 31.3 deg, .* 11.5 deg, on the way to item 0; "),
        (rotations.from_euler(math.pi, 0.0, 0.0), "keep the robot from falling over on the way to item 0"),
        (rotations.from_euler(math.pi, 0.1, 0.0), "keep the robot from falling over on the way to item 0"),
    ],
    ids=["pitched", "on its head", "nearly on its head"],
)
def test_attitude_that_neither_thrusters_nor_buoyancy_hold_is_refused(bluerov2: Body, q_wb: np.ndarray, message: str) -> None:
    found = plan_mission(job(NORTH, q_wb=q_wb), bluerov2)
    assert found.trajectory is None
    assert re.search(message, found.reason)


def test_refusal_of_an_attitude_that_cannot_be_held_says_what_to_change(bluerov2: Body) -> None:
    """Regression: it spoke of a moment that the thrusters do not give, and named neither the axis nor a remedy."""
    for vehicle, attitude, axis in ((bluerov2, (0.0, 0.35, 0.6), "pitch"), ("girona500", (0.35, 0.0, 0.6), "roll")):
        body = assemble_vehicle(load_vehicle(vehicle)) if isinstance(vehicle, str) else vehicle
        with pytest.raises(InfeasibleError) as refused:
            plan([Waypoint(START), Waypoint(NORTH, rotations.from_euler(*attitude))], body=body)
        degrees = "the robot would lean by 20.9 deg, of at most 11.5 deg, to stand still at waypoint 1"
        assert str(refused.value) == f"its thrusters give no {axis}: {degrees}; keep it level in {axis} there"


def test_push_along_an_axis_without_thrusters_is_refused_at_any_speed(bluerov2: Body) -> None:
    """Buoyancy does not push sideways; a mission that needs no such push is planned."""
    body = without_sway(bluerov2)
    assert plan_mission(job(NORTH), body).trajectory is not None
    found = plan_mission(job(EAST), body)
    assert found.trajectory is None
    assert re.search(r"give [\d.]+ N along the robot's y, which it takes on the way to item 0", found.reason)
    with pytest.raises(InfeasibleError, match="along the robot's y"):
        plan([Waypoint(START), Waypoint(EAST)], 1e4, body=body)


def test_vehicle_that_nothing_rights_is_refused(bluerov2: Body) -> None:
    found = plan_mission(job(NORTH), dataclasses.replace(bluerov2, righting=np.zeros(3)))
    assert found.trajectory is None
    assert re.search("neither thrusters nor buoyancy", found.reason)


def test_path_is_stretched_until_the_vehicle_leans_little_enough(bluerov2: Body) -> None:
    waypoints = [Waypoint(START), Waypoint(NORTH)]
    with pytest.raises(InfeasibleError, match=r"lean by [\d.]+ deg, of at most 11.5 deg|falling over"):
        plan(waypoints, 4.0, Limits(thruster_share=1.0), bluerov2, stretch=False)
    found = plan(waypoints, 4.0, Limits(thruster_share=1.0), bluerov2)
    assert divide(bluerov2, found.grid(16)[..., :19].reshape(-1, 19)).lean.max() == pytest.approx(MOST_LEAN, rel=0.03)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_wrench_outside_the_span_is_used_infinitely_whatever_the_pseudo_inverse_says(bluerov2: Body, order: list[int]) -> None:
    wanted = np.zeros((2, 6))
    wanted[0, 3] = wanted[1, 4] = 2.0
    assert usage(bluerov2, wanted[order]) == (math.inf, order.index(1))


def test_lean_is_checked_between_the_points_where_it_is_looked_at(bluerov2: Body) -> None:
    rng = np.random.default_rng(0)
    waypoints = [Waypoint(p) for p in (START, *(START + np.append(rng.uniform(-2.0, 2.0, 2), 0.0) for _ in range(3)))]
    path = plan(waypoints, 30.19)
    at_points, between = (divide(bluerov2, path.grid(points)[..., :19].reshape(-1, 19)).lean.max() for points in (48, 2000))
    assert at_points < MOST_LEAN < between
    with pytest.raises(InfeasibleError, match=r"lean by 11.5 deg, of at most 11.5 deg, between waypoints 2 and 3"):
        plan(waypoints, 30.19, Limits(thruster_share=1.0), bluerov2, stretch=False)


@pytest.fixture(scope="module")
def modcube() -> Body:
    return assemble_vehicle(load_vehicle("modcube"))


def by_pseudo_inverse(body: Body, wanted: np.ndarray) -> np.ndarray:
    """(k,) share of the thrusters' range that each of the wrenches (k, 6) takes by the pseudo-inverse."""
    forces = wanted @ body.thrusters.pinv.T
    return np.asarray(np.maximum(forces / body.thrusters.f_max, forces / body.thrusters.f_min).max(axis=1))


@pytest.mark.slow
def test_wrench_that_takes_too_much_is_found_among_any_number_that_only_look_worse(modcube: Body) -> None:
    """They look worse by the pseudo-inverse, which uses thrusters that the best division would spare."""
    wanted = np.random.default_rng(3).normal(size=(400, 6)) * [10.0, 10.0, 10.0, 1.0, 1.0, 1.0]
    exact = np.array([least_usage(modcube, w)[0] for w in wanted])
    looks = by_pseudo_inverse(modcube, wanted) / exact
    order = np.argsort(-looks)
    decoys, bad = order[:100], order[-1]
    wanted[decoys] *= 0.79 / exact[decoys, None]
    wanted[bad] *= 0.81 / exact[bad]
    assert np.all(by_pseudo_inverse(modcube, wanted[decoys]) > by_pseudo_inverse(modcube, wanted[bad][None]))
    share, where = usage(modcube, np.vstack([wanted[decoys], wanted[bad]]), 0.8)
    assert share == pytest.approx(0.81) and where == 100


@pytest.mark.slow
@pytest.mark.parametrize("name", ["modcube", "bluerov2", "girona500", "chasing_m2"])
def test_usage_is_that_of_the_worst_wrench_exactly(name: str) -> None:
    body = assemble_vehicle(load_vehicle(name))
    wanted = np.random.default_rng(4).normal(size=(60, body.thrusters.f_max.size)) @ body.thrusters.matrix.T
    exact = [least_usage(body, w)[0] for w in wanted]
    share, where = usage(body, wanted)
    assert share == pytest.approx(max(exact), rel=1e-6) and where == int(np.argmax(exact))


def test_few_linear_programs_do_for_a_whole_path(modcube: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, solved = np.random.default_rng(2), []
    waypoints = [Waypoint(rng.uniform(-0.5, 0.5, 3), rotations.from_euler(*rng.uniform(-0.6, 0.6, 3))) for _ in range(6)]
    motion = plan(waypoints, 8.0).grid(48)[..., :19].reshape(-1, 19)
    solve = snap_thrust.linprog
    monkeypatch.setattr(snap_thrust, "linprog", lambda *a, **k: solved.append(a) or solve(*a, **k))
    share, where = usage(modcube, wrenches(modcube, motion))
    assert len(solved) <= 20
    assert share == pytest.approx(least_usage(modcube, wrenches(modcube, motion)[where])[0]) and 0.1 < share < math.inf
