"""Guidance when the mode, the body or its place changes: nothing jumps, and guidance continues from where the robot is."""

import itertools
import math

import numpy as np
import pytest

from firmware_py.core.rotations import difference, from_euler, heading, to_matrix
from firmware_py.core.setpoint import rest_at
from firmware_py.core.transitions import Effect
from firmware_py.core.types import Mode, Setpoint, Sticks
from firmware_py.description.parameters import Parameters
from tests.unit.guidance_flight import FLOWN, LEVEL, WRENCH, ZERO, Flight, Ramp, estimate, sticks
from tests.unit.healths import GOOD


@pytest.mark.parametrize("modes", list(itertools.product(FLOWN, FLOWN)), ids=lambda pair: "-".join(m.name for m in pair))
def test_no_change_of_mode_jumps(modes: tuple[Mode, Mode]) -> None:
    """Neither the set-point nor the wrench jumps, with sticks held over and a moving body."""
    flight = Flight()
    for mode in modes:
        flight.do(Effect.ENTER_MODE, mode)
        flight.run(1.0, sticks(0.5, -0.3, 0.4, 0.2))
    steps = np.abs(np.diff(np.array(flight.wrenches[1:]), axis=0))
    assert steps[:, :3].max() < 1.5 and steps[:, 3:].max() < 0.12, "N, N m a tick: the blend's slope"
    places = np.abs(np.diff(np.array([s.p_wb for s in flight.setpoints]), axis=0))
    assert places.max() < 0.01


def test_armed_robot_starts_from_no_wrench() -> None:
    flight = Flight()
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE)
    flight.run(0.01)
    np.testing.assert_allclose(flight.wrenches[-1], 0.0, atol=1e-12)
    flight.run(0.5)
    np.testing.assert_allclose(flight.wrenches[-1], WRENCH)


@pytest.mark.parametrize("mode", [Mode.STABILIZE, Mode.ALT_HOLD, Mode.POSHOLD, Mode.GUIDED])
def test_robot_that_is_held_is_turned_the_way_it_was_asked_to_and_never_back(mode: Mode) -> None:
    flight, nan = Flight(), np.full(3, np.nan)
    flight.do(Effect.ENTER_MODE, mode)
    for _ in range(150):
        flight.do(Effect.TAKE_POINT, mode, Setpoint(nan, np.full(4, np.nan), nan, np.array([0.0, 0.0, 0.6]), ZERO, ZERO))
        flight.run(0.1, sticks(yaw=1.0), follows=False)
        assert difference(flight.setpoints[-1].q_wb, flight.estimate.q_wb)[2] > 0.0


def test_robot_that_is_pushed_off_its_place_comes_back_to_it() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    flight.estimate = estimate((3.0, 0.0, 1.0))
    assert np.abs(flight.run(1.0, sticks(), follows=False).p_wb[0]) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("mode", [Mode.POSHOLD, Mode.ALT_HOLD])
@pytest.mark.parametrize(
    ("roll", "given", "tilt"),
    [(2.6, None, 0.0), (0.62, None, 0.0), (0.58, None, 0.58), (2.6, Sticks(moment=(0.0, 0.0, 0.1)), 2.6)],
    ids=["upside down", "steep", "tilted", "a pilot turns it"],
)
def test_steep_robot_that_a_failsafe_makes_hold_turns_upright_where_it_is(
    mode: Mode, roll: float, given: Sticks | None, tilt: float
) -> None:
    flight = Flight()
    flight.estimate = estimate((1.0, 0.5, 2.0), from_euler(roll, 0.0, 0.3))
    flight.do(Effect.ENTER_LEVEL, mode)
    now = flight.run(15.0, given)
    assert math.acos(to_matrix(now.q_wb)[2, 2]) == pytest.approx(tilt, abs=0.02)
    np.testing.assert_allclose(now.p_wb, [1.0, 0.5, 2.0], atol=0.02)
    steps = [np.linalg.norm(difference(a.q_wb, b.q_wb)) for a, b in itertools.pairwise(flight.setpoints)]
    assert max(steps) <= 1.01 * Parameters().steering.level_rad_s * 0.01


def test_docking_sequence_steers_in_its_mode_alone() -> None:
    flight, place = Flight(), rest_at(np.array([0.1, 0.0, 1.0]), estimate().q_wb)
    flight.do(Effect.ENTER_MODE, Mode.DOCK)
    flight.guidance.dock(place)
    assert flight.run(0.01) is place
    flight.do(Effect.ENTER_MODE)
    flight.guidance.dock(rest_at(np.array([9.0, 0.0, 1.0]), estimate().q_wb))
    assert flight.run(1.0).p_wb[0] < 0.11


@pytest.mark.parametrize("pitch", [0.0, 1.0, 1.4, 1.5707, -1.0, -1.4, -1.5707])
def test_heading_is_kept_through_the_vertical(pitch: float) -> None:
    np.testing.assert_allclose(difference(heading(from_euler(0.0, pitch, 0.8)), from_euler(0.0, 0.0, 0.8)), 0.0, atol=1e-3)


def test_body_that_takes_over_goes_on_at_its_speed_and_from_its_thrusters_wrench() -> None:
    flight, before = Flight(), np.array([4.0, -1.0, 2.0, 0.5, 0.4, -0.3])
    turned = from_euler(0.0, 0.0, 0.5 * math.pi)
    moving = estimate((0.5, 0.5, 1.0), turned, (0.2, 0.0, 0.0, 0.0, 0.0, 0.1))
    flight.guidance.take_over(Mode.POSHOLD, moving, before, turned)
    flight.estimate = moving
    now = flight.run(0.01, follows=False)
    np.testing.assert_allclose(now.p_wb, moving.p_wb, atol=1e-6)
    np.testing.assert_allclose(now.v_w, [0.0, 0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(flight.wrenches[-1], before, atol=1e-9)
    flight.run(0.5 * Parameters().steering.blend_s, follows=False)
    np.testing.assert_allclose(flight.wrenches[-1], 0.5 * (before + WRENCH), atol=1e-9)
    flight.run(0.5 * Parameters().steering.blend_s, follows=False)
    np.testing.assert_allclose(flight.wrenches[-1], WRENCH, atol=1e-9)


@pytest.mark.parametrize(("lean", "kept"), [(0.3, True), (0.4, False)])
def test_body_that_takes_over_turns_back_to_the_attitude_that_was_to_be_held_if_that_is_near(lean: float, kept: bool) -> None:
    flight, leaning = Flight(), from_euler(0.0, lean, 0.0)
    flight.estimate = estimate((0.5, 0.5, 1.0), leaning, (0.2, 0.0, 0.0, 0.0, 0.0, 0.0))
    flight.guidance.take_over(Mode.POSHOLD, flight.estimate, WRENCH, LEVEL)
    assert flight.run(0.01, follows=False).q_wb == pytest.approx(leaning, abs=1e-4), "without a jump"
    now = flight.run(5.0)
    assert np.linalg.norm(difference(now.q_wb, LEVEL if kept else leaning)) < 1e-3
    went_m = 2.0 / Parameters().steering.bandwidth * 0.2
    assert now.p_wb == pytest.approx([0.5 + went_m * math.cos(lean), 0.5, 1.0 - went_m * math.sin(lean)], abs=2e-3), "as far as it brakes"


def test_second_dock_begins_without_the_wish_of_the_first() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.DOCK)
    flight.guidance.dock(rest_at(np.array([0.0, 0.0, 1.1]), LEVEL))
    flight.run(0.1)
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    flight.run(0.1)
    flight.estimate = estimate((3.0, 0.0, 1.0))
    flight.do(Effect.ENTER_MODE, Mode.DOCK)
    assert flight.run(0.1).p_wb[0] == pytest.approx(3.0, abs=0.01)


def test_robot_that_is_turned_far_from_its_set_point_holds_as_it_is() -> None:
    flight = Flight()
    flight.run(0.1)
    flight.estimate = estimate(q=from_euler(0.0, 0.0, 0.5))
    flight.do(Effect.ENTER_MODE)
    assert np.linalg.norm(difference(flight.run(0.01, follows=False).q_wb, flight.estimate.q_wb)) < 1e-6


@pytest.mark.parametrize("mode", [Mode.POSHOLD, Mode.SURFACE, Mode.AUTO])
def test_loop_that_stood_still_goes_on_from_the_body_and_not_from_where_it_would_be(mode: Mode) -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, mode)
    if mode == Mode.AUTO:
        flight.do(Effect.FOLLOW, mode, Ramp())
    elif mode == Mode.POSHOLD:
        flight.do(Effect.HOLD_AT, mode, rest_at(np.array([0.6, 0.0, 1.0]), LEVEL))
    before = flight.run(1.0)
    flight.time_ns += 5_000_000_000
    after = flight.run(0.01)
    assert np.linalg.norm(after.p_wb - before.p_wb) < 0.01
    later = flight.run(1.0)
    assert 0.01 < np.linalg.norm(later.p_wb - after.p_wb) < 0.4, "it goes on"


def test_set_point_stays_with_a_body_whose_modules_obey_nothing() -> None:
    """Regression: a microcontroller that came back after 20 s swam at 0.64 m/s to where its module had been 3 m before."""
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    before = flight.run(1.0)
    flight.estimate = estimate((2.0, 1.0, 1.0))
    held = flight.run(1.0, health=GOOD._replace(still_s=0.1), follows=False)
    assert np.linalg.norm(held.p_wb[:2] - before.p_wb[:2]) < 1e-9, "their commands may only have been late"
    flight.run(1.0, health=GOOD._replace(still_s=0.11), follows=False)
    assert np.linalg.norm(flight.run(1.0, follows=False).p_wb[:2] - [2.0, 1.0]) < 1e-9


def test_body_that_hardly_obeyed_is_stopped_and_does_not_glide_to_rest() -> None:
    """Regression: of one that heard 7 % of its commands at 0.7 m/s, each that it heard told it to go on: it went 2.1 m instead of 1.4 m."""
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    flight.estimate = estimate(nu=(0.7, 0.0, 0.0, 0.0, 0.0, 0.5))
    held = flight.run(0.01, health=GOOD._replace(still_s=0.11), follows=False)
    assert not held.v_w.any() and not held.w_b.any()


def test_path_waits_while_no_module_obeys() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.AUTO)
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp())
    before = flight.run(1.0)
    during, after = flight.run(5.0, health=GOOD._replace(still_s=0.3)), flight.run(1.0)
    np.testing.assert_allclose(during.p_wb, before.p_wb, atol=1e-9)
    assert 0.01 < np.linalg.norm(after.p_wb - before.p_wb) < 0.4, "it goes on"


def test_set_point_that_is_no_number_is_not_gone_on_from() -> None:
    flight = Flight()
    flight.guidance._glider.put(rest_at(np.full(3, math.nan), LEVEL))
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    np.testing.assert_allclose(flight.run(0.01).p_wb, estimate().p_wb, atol=1e-9)
