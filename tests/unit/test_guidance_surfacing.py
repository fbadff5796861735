"""Guidance of a robot that surfaces, and of one whose world frame moves when tags appear, vanish and return."""

import dataclasses

import numpy as np
import pytest

from firmware_py.core.rotations import difference, from_euler, heading, rotate
from firmware_py.core.setpoint import rest_at
from firmware_py.core.transitions import Effect
from firmware_py.core.types import Mode
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble, assemble_vehicle
from tests.unit.guidance_flight import LEVEL, WRENCH, ZERO, Flight, estimate
from tests.unit.healths import BLIND, GOOD, UPRIGHT

LIFT_N = Parameters().steering.surface_n_per_kg * 15.5
"""Of a module: 9.3 kg of robot and entrained water, 6.2 kg of added mass."""


@pytest.mark.slow
def test_surfacing_robot_rises_levels_and_stays_up() -> None:
    flight = Flight()
    flight.estimate = estimate(q=from_euler(0.4, -0.6, 1.0))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    now = flight.run(40.0)
    assert now.p_wb[2] == pytest.approx(Parameters().steering.surface_depth_m, abs=1e-3) and np.abs(now.v_w).max() < 1e-3
    np.testing.assert_allclose(now.p_wb[:2], 0.0, atol=1e-9)
    assert np.linalg.norm(difference(now.q_wb, heading(now.q_wb))) < 1e-3


def test_surfacing_robot_lifts_blindly_when_it_must() -> None:
    lift = -LIFT_N
    for health, expected in (
        (BLIND, [0.0, 0.0, lift, 0.0, 0.0, 0.0]),
        (GOOD._replace(tag_age_s=9.0, depth_age_s=9.0), [0.0, 0.0, lift, *WRENCH[3:]]),
        (GOOD._replace(tag_age_s=9.0), [0.0, 0.0, -0.5 * lift, *WRENCH[3:]]),
        (GOOD._replace(tag_age_s=1.0, push_m_s=0.6), [0.0, 0.0, -0.5 * lift, *WRENCH[3:]]),
        (GOOD._replace(push_m_s=0.6), [*WRENCH[:2], -0.5 * lift, *WRENCH[3:]]),
        (GOOD, [*WRENCH[:2], -0.5 * lift, *WRENCH[3:]]),
    ):
        flight = Flight()
        flight.do(Effect.ENTER_MODE, Mode.SURFACE)
        flight.run(0.5, health=health)
        np.testing.assert_allclose(flight.wrenches[-1], expected, atol=1e-12)


@pytest.mark.parametrize(("vehicle", "modules"), [("modcube", 1), ("modcube", 2), ("girona500", 1)])
def test_blind_lift_grows_with_what_it_has_to_move(vehicle: str, modules: int) -> None:
    """Regression: it was 3 N for any vehicle, and a robot of 740 kg that weighed 5 N sank."""
    body = assemble([(i, 0, 0) for i in range(modules)], [0] * modules, [load_vehicle(vehicle)] * modules, list(range(modules)))
    flight = Flight(body=body)
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    flight.run(0.5, health=BLIND)
    np.testing.assert_allclose(flight.wrenches[-1], [0.0, 0.0, -0.2 * body.mass[2, 2], 0.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("depth_m", [0.13, 0.0, -10.0])
def test_robot_that_believes_to_be_at_the_surface_is_lifted_all_the_same(depth_m: float) -> None:
    """A pressure sensor that read too shallow kept a robot with a leak under water. The controller would push down with 3 N here."""
    flight = Flight()
    flight.estimate = estimate((0.0, 0.0, depth_m), from_euler(0.5, -0.3, 2.0))
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    flight.run(5.0, health=GOOD._replace(tag_age_s=9.0), follows=False)
    lift_w = rotate(flight.estimate.q_wb, flight.wrenches[-1][:3].copy())
    np.testing.assert_allclose(lift_w, [0.0, 0.0, -0.5 * LIFT_N], atol=1e-12)


@pytest.mark.slow
def test_stacked_robot_stays_with_its_highest_module_at_the_surface() -> None:
    """With its centre of mass there it lifted half a module out of the water, with all the power that its supply had."""
    stack = assemble([(0, 0, 0), (0, 0, -1), (0, 0, 1)], [0] * 3, [load_vehicle("modcube")] * 3, [0, 1, 2])
    flight = Flight(body=stack)
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    assert flight.run(40.0).p_wb[2] == pytest.approx(Parameters().steering.surface_depth_m + 0.21, abs=1e-3)
    assert rotate(flight.estimate.q_wb, flight.wrenches[-1][:3].copy())[2] == pytest.approx(-0.5 * LIFT_N * 3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "depth_m"), [("modcube", 0.12), ("bluerov2", 0.127), ("girona500", 0.5)])
def test_tall_robot_comes_up_as_far_as_the_water_carries_its_hull(name: str, depth_m: float) -> None:
    """A robot of 0.8 m was to come up to 0.12 m too: it held a fifth of a kilonewton of hull out of the water until its battery was low."""
    flight = Flight(body=assemble_vehicle(load_vehicle(name)))
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    assert flight.run(40.0).p_wb[2] == pytest.approx(depth_m, abs=1e-3)


def test_robot_that_is_heavy_at_the_bottom_has_its_whole_hull_in_the_water_at_the_surface() -> None:
    robot = load_vehicle("girona500")
    robot = dataclasses.replace(robot, inertial=dataclasses.replace(robot.inertial, com_m=np.array([0.0, 0.0, 0.2])))
    flight = Flight(body=assemble_vehicle(robot))
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    assert flight.run(40.0).p_wb[2] == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize("mode", [Mode.STABILIZE, Mode.ALT_HOLD, Mode.SURFACE])
def test_first_tags_move_the_set_point_with_the_world(mode: Mode) -> None:
    """The first tags give another place and heading. The robot has not moved, and must not return to where it believed itself before."""
    flight = Flight()
    flight.do(Effect.ENTER_MODE, mode)
    flight.run(2.0, health=UPRIGHT)
    there = flight.estimate = estimate((5.0, -3.0, 1.4), from_euler(0.0, 0.0, 2.5), (0.1, 0.0, 0.0, 0.0, 0.0, 0.2))
    now = flight.run(0.01, follows=False)
    np.testing.assert_allclose(now.p_wb, there.p_wb, atol=0.01)
    assert np.linalg.norm(difference(now.q_wb, there.q_wb)) < 0.01
    assert flight.run(1.0).p_wb[0] < 5.2


def test_what_was_asked_for_in_the_world_before_is_forgotten_and_what_comes_with_the_first_tags_is_not() -> None:
    flight, there = Flight(), estimate((5.0, -3.0, 1.4))
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(1.0, health=UPRIGHT)
    flight.do(Effect.TAKE_POINT, Mode.ALT_HOLD, rest_at(ZERO, LEVEL))
    flight.estimate = there
    flight.guidance.drop_stale_goals(there, GOOD)
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([4.0, -3.0, 1.4]), LEVEL))
    assert flight.run(20.0).p_wb[0] == pytest.approx(4.0, abs=0.01)
    other = Flight()
    other.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    other.run(1.0, health=UPRIGHT)
    other.do(Effect.TAKE_POINT, Mode.ALT_HOLD, rest_at(ZERO, LEVEL))
    other.estimate = there
    other.guidance.drop_stale_goals(there, GOOD)
    other.do(Effect.ENTER_MODE, Mode.GUIDED)
    assert other.run(5.0).p_wb[0] == pytest.approx(5.0, abs=0.01)


@pytest.mark.parametrize("tag_age_s", [20.0, 0.0], ids=["after a time out of sight", "carried away in sight"])
def test_place_that_tags_tell_a_surfacing_robot_anew_is_not_swum_back_from(tag_age_s: float) -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    flight.run(2.0, health=GOOD._replace(tag_age_s=tag_age_s), follows=False)
    flight.estimate = estimate((1.5, -1.0, 1.0))
    now = flight.run(0.01, follows=False)
    np.testing.assert_allclose(now.p_wb[:2], [1.5, -1.0], atol=1e-3)


def test_robot_that_falls_back_on_gravity_goes_on_from_where_it_is_believed_to_be() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(1.0)
    flight.estimate = estimate((0.0, 0.0, 1.3), from_euler(0.0, 0.0, 2.5))
    now = flight.run(0.01, health=UPRIGHT, follows=False)
    assert np.linalg.norm(difference(now.q_wb, flight.estimate.q_wb)) < 0.01


def test_surfacing_robot_that_is_pushed_out_of_sight_does_not_swim_back() -> None:
    """Believed speed and push ran away together: a robot with a weak thruster swam three metres into a wall instead of rising."""
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    flight.run(0.5)
    flight.estimate = estimate((0.3, 0.0, 1.0))
    now = flight.run(0.1, health=GOOD._replace(tag_age_s=1.0, push_m_s=0.6), follows=False)
    assert now.p_wb[0] == pytest.approx(0.3)


def test_tags_that_come_back_move_no_set_point() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(1.0, health=GOOD._replace(tag_age_s=100.0), follows=False)
    flight.estimate = estimate((0.0, 0.0, 1.3), from_euler(0.0, 0.0, 0.3))
    now = flight.run(0.01, follows=False)
    assert now.p_wb[2] == pytest.approx(1.0) and np.linalg.norm(difference(now.q_wb, flight.estimate.q_wb)) > 0.29
