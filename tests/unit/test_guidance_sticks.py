"""Guidance by sticks: forces, moments, speeds and held places, within the fence."""

import math

import numpy as np
import pytest

from firmware_py.core.rotations import difference, from_euler, rotate
from firmware_py.core.setpoint import LEASH_M, rest_at
from firmware_py.core.transitions import Effect
from firmware_py.core.types import Mode, Sticks
from firmware_py.description.parameters import Parameters
from tests.unit.guidance_flight import BODY, WRENCH, Flight, estimate, sticks


def test_manual_sticks_are_forces_and_moments_of_the_body() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.MANUAL)
    flight.run(0.5, Sticks((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    wrench = flight.wrenches[-1]
    assert wrench[0] > 5.0 and wrench[5] < -0.3 and not np.any(wrench[1:5])
    flight.run(1.0)
    assert not flight.wrenches[-1].any(), "sticks that fell silent are neutral"
    flight.estimate = estimate(q=from_euler(0.9, -0.3, 2.0))
    flight.run(0.1, follows=False)
    np.testing.assert_array_equal(flight.setpoints[-1].q_wb, flight.estimate.q_wb, "the pilot holds the attitude, nobody else")


@pytest.mark.parametrize("axis", range(6))
def test_full_stick_is_a_share_of_what_all_thrusters_can_do_along_its_axis(axis: int) -> None:
    flight, held, t = Flight(), np.zeros(6), BODY.thrusters
    held[axis] = 1.0
    flight.do(Effect.ENTER_MODE, Mode.MANUAL)
    flight.run(2.0, Sticks(tuple(held[:3]), tuple(held[3:])), follows=False)
    there, back = (np.where(t.matrix[axis] * sign > 0.0, t.f_max, -t.f_min) for sign in (1.0, -1.0))
    most = 0.5 * np.abs(t.matrix[axis]) @ (there + back)
    np.testing.assert_allclose(flight.wrenches[-1], Parameters().steering.stick_share * most * held, atol=1e-9)


def test_stabilize_keeps_the_controllers_moment() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.STABILIZE)
    flight.run(0.5, sticks(0.5))
    np.testing.assert_allclose(flight.wrenches[-1][3:], WRENCH[3:])
    assert flight.wrenches[-1][0] > 2.0 and flight.wrenches[-1][2] == 0.0


@pytest.mark.parametrize("pitch", [0.0, 0.7, np.pi / 2, -np.pi / 2])
def test_depth_hold_keeps_the_vertical_force_in_every_attitude(pitch: float) -> None:
    flight = Flight()
    flight.estimate = estimate(q=from_euler(0.0, pitch, 0.5))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(0.5, sticks(1.0), follows=False)
    force_w = rotate(flight.estimate.q_wb, flight.wrenches[-1][:3].copy())
    wanted_w = rotate(flight.estimate.q_wb, WRENCH[:3].copy())
    assert force_w[2] == pytest.approx(wanted_w[2])
    np.testing.assert_allclose(force_w[1] / force_w[0], np.tan(0.5), atol=1e-6)
    assert force_w[0] > 2.0, "forward is where it looks"


def test_depth_hold_climbs_and_drifts_freely() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(2.0, sticks(down=-1.0))
    assert flight.setpoints[-1].p_wb[2] < 0.6
    flight.estimate = flight.estimate._replace(p_wb=np.array([3.0, -2.0, 0.9]))
    now = flight.run(0.01, follows=False)
    np.testing.assert_array_equal(now.p_wb[:2], [3.0, -2.0])
    assert now.p_wb[2] < 0.6


def test_sticks_move_the_held_place_and_leave_it_there() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE)
    flight.run(2.0, sticks(forward=1.0))
    assert flight.setpoints[-1].v_w[0] == pytest.approx(0.3, abs=1e-3)
    flight.run(2.5)
    there = flight.setpoints[-1]
    assert np.abs(there.v_w).max() < 1e-4
    np.testing.assert_allclose(flight.run(1.0).p_wb, there.p_wb, atol=1e-4)


def test_robot_glides_to_a_place_that_it_is_to_hold() -> None:
    flight = Flight()
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([1.0, 0.5, 2.0]), from_euler(0.0, 0.0, 1.0)))
    now = flight.run(15.0)
    np.testing.assert_allclose(now.p_wb, [1.0, 0.5, 2.0], atol=1e-3)
    assert np.linalg.norm(difference(now.q_wb, from_euler(0.0, 0.0, 1.0))) < 1e-3
    flight.run(0.2, sticks(right=1.0))
    assert flight.run(3.0).p_wb[1] > 0.52, "sticks take it away"


def test_held_place_stays_within_the_fence() -> None:
    flight = Flight(Parameters().replace("fence.north_m", 0.5))
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([3.0, 0.0, 1.0]), estimate().q_wb))
    assert flight.run(15.0).p_wb[0] == pytest.approx(0.5, abs=1e-3)
    flight.do(Effect.ENTER_MODE)
    assert flight.run(15.0, sticks(forward=1.0)).p_wb[0] < 0.6


def test_robot_beyond_the_fence_can_be_steered_back_and_no_farther() -> None:
    flight = Flight(Parameters().replace("fence.north_m", 0.5))
    flight.estimate = estimate((0.9, 0.0, 1.0))
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    assert flight.run(3.0, sticks(forward=1.0)).p_wb[0] == pytest.approx(0.9, abs=1e-3)
    assert flight.run(6.0, sticks(forward=-1.0)).p_wb[0] < 0.5


def test_fence_and_speeds_may_change_in_flight() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    before = flight.run(1.0, sticks(forward=1.0))
    flight.guidance.retune(Parameters().replace("fence.north_m", 0.5).replace("steering.speed_m_s", 0.05))
    after = flight.run(DT := 0.01, sticks(forward=1.0))
    assert np.linalg.norm(after.p_wb - before.p_wb) < 1.5 * DT * np.linalg.norm(before.v_w), "nothing jumps"
    assert flight.run(3.0, sticks(forward=1.0)).v_w[0] < 0.0501
    assert flight.run(20.0, sticks(forward=1.0)).p_wb[0] < 0.55


@pytest.mark.parametrize("mode", [Mode.ALT_HOLD, Mode.POSHOLD])
def test_sticks_lead_no_set_point_away_from_a_robot_that_lies_on_the_ground(mode: Mode) -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, mode)
    flight.run(20.0, sticks(down=1.0), follows=False)
    assert flight.setpoints[-1].p_wb[2] < flight.estimate.p_wb[2] + LEASH_M + 0.15
    flight.run(0.1, sticks(), follows=False)
    assert flight.setpoints[-1].p_wb[2] == pytest.approx(flight.estimate.p_wb[2]), "let go, it presses no more"
    assert flight.run(0.5, sticks(down=-1.0), follows=False).p_wb[2] < flight.estimate.p_wb[2], "and it comes off as soon as it is asked to"


def test_sticks_push_along_the_robots_own_axes() -> None:
    flight = Flight()
    flight.estimate = estimate(q=from_euler(0.0, 0.0, 0.5 * math.pi))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    moved = flight.run(2.0, sticks(forward=1.0)).p_wb
    assert moved[1] > 0.3 and abs(moved[0]) < 1e-6
