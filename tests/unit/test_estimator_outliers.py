"""Wrong, late or few tags: the estimator refuses or weights them, and finds the robot again from good ones."""

import math

import numpy as np
import pytest

from firmware_py.core.body import Body
from firmware_py.core.estimator import READY_AFTER, RESET_AFTER
from firmware_py.core.observation import MOST_RATE_RAD_S, MOST_SPEED_M_S, is_sound
from firmware_py.core.propagation import STATES
from firmware_py.core.rotations import exp, multiply
from firmware_py.core.types import Estimate
from tests.unit.estimated_robot import DELAY_TICKS, P_WB, PERIOD, Q_WB, Robot, assert_rests, sensors, tag


def test_tag_that_jumps_is_refused_and_moves_nothing(body: Body) -> None:
    robot = Robot(body)
    robot.rest(101)
    before = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - PERIOD, P_WB + np.array([0.3, 0.0, 0.0]))))
    assert before.rejected == 1
    assert_rests(before)
    assert before.tag_age_ns > PERIOD, "a refused tag is no fresh pose"


@pytest.mark.parametrize("axis", [0, 1])
def test_flipped_tag_is_refused(body: Body, axis: int) -> None:
    """The second solution of a planar tag: right place, tilted by tens of degrees."""
    robot = Robot(body)
    robot.rest(101)
    flipped = tag(robot.time_ns - PERIOD)._replace(q_wb=multiply(Q_WB, exp(0.6 * np.eye(3)[axis])))
    estimate = robot.step(sensors(P_WB, Q_WB, flipped))
    assert estimate.rejected == 1
    assert_rests(estimate)


def test_robot_that_was_carried_away_is_found_again_after_half_a_second(body: Body) -> None:
    robot = Robot(body)
    robot.rest(100)
    there = P_WB + np.array([0.8, -0.6, 0.3])
    for n in range(1, RESET_AFTER + 1):
        estimate = robot.step(sensors(there, Q_WB, tag(robot.time_ns - PERIOD, there)))
        assert estimate.rejected == n
        assert (np.linalg.norm(estimate.p_wb - there) < 0.01) == (n == RESET_AFTER)
        assert estimate.ready, "the attitude was never lost, and the refused tags agree on the new place"
    for _ in range(READY_AFTER):
        estimate = robot.step(sensors(there, Q_WB, tag(robot.time_ns - PERIOD, there)))
    assert_rests(estimate, there)


def test_tags_that_agree_on_no_place_take_neither_place_nor_attitude(body: Body) -> None:
    """The filter started from one of them twice a second, and a robot that surfaced had no attitude meanwhile."""
    robot, rng = Robot(body), np.random.default_rng(0)
    robot.rest(100)
    for _ in range(3 * RESET_AFTER):
        estimate = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - PERIOD, P_WB + rng.normal(size=3))))
        assert estimate.ready
    assert_rests(estimate)
    assert estimate.rejected == 3 * RESET_AFTER


def rest_pushed(body: Body, ticks: int, q_wb: np.ndarray = Q_WB) -> tuple[Robot, Estimate]:
    """A robot at attitude Q_WB, held against a moment that its description lacks, and seen as `q_wb`; and its last estimate."""
    robot = Robot(body)
    robot.tau = robot.tau - np.r_[np.zeros(3), PUSH]
    for _ in range(ticks):
        seen = [tag(robot.time_ns - DELAY_TICKS * PERIOD, P_WB, q_wb)] if robot.tick % 2 else []
        estimate = robot.step(sensors(P_WB, Q_WB, *seen))
    return robot, estimate


PUSH = np.array([0.09, -0.045, 0.02])
"""N m, as from an arm and a trim that were not measured."""


@pytest.mark.slow
def test_robot_that_was_carried_away_still_knows_what_pushes_it(body: Body) -> None:
    """Only the position is lost: otherwise the arm would turn the robot until the moment was learnt again."""
    robot, estimate = rest_pushed(body, 1000)
    np.testing.assert_allclose(estimate.moment_b, PUSH, atol=2e-3)
    there = P_WB + np.array([0.8, -0.6, 0.3])
    for n in range(200):
        estimate = robot.step(sensors(there, Q_WB, tag(robot.time_ns - PERIOD, there)))
        np.testing.assert_allclose(estimate.moment_b, PUSH, atol=2e-3, err_msg=f"after {n} tags")
    assert_rests(estimate, there)


@pytest.mark.parametrize("spoilt", [5.0, -5.0, np.nan])
def test_moment_that_nobody_could_believe_is_forgotten_with_the_place(body: Body, spoilt: float) -> None:
    """The moment may be the reason why the tags were refused."""
    robot = Robot(body)
    robot.rest(100)
    there = P_WB + np.array([0.8, -0.6, 0.3])
    for _ in range(RESET_AFTER):
        robot.estimator._anchor.x[22:25] = spoilt
        robot.step(sensors(there, Q_WB, tag(robot.time_ns - PERIOD, there)))
    for _ in range(100):
        estimate = robot.step(sensors(there, Q_WB, tag(robot.time_ns - PERIOD, there)))
    assert_rests(estimate, there)


@pytest.mark.parametrize("turn_rad", [0.7, 0.175], ids=["flipped", "by a camera knocked by ten degrees"])
def test_askew_tags_alone_take_no_pose_from_a_robot_at_rest_and_make_none(body: Body, turn_rad: float) -> None:
    """The filter started from them twice a second, had no pose meanwhile, and a robot that surfaced without one tumbled."""
    robot = Robot(body)
    robot.rest(100)
    flipped = multiply(Q_WB, exp(np.array([turn_rad, 0.0, 0.0])))
    for _ in range(5 * RESET_AFTER):
        estimate = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - PERIOD)._replace(q_wb=flipped)))
        assert estimate.ready
    assert_rests(estimate)
    assert estimate.rejected == 5 * RESET_AFTER


@pytest.mark.parametrize("ticks", [20, 60, 200])
def test_robot_that_was_seen_askew_is_upright_at_once_when_it_is_seen_well(body: Body, ticks: int) -> None:
    """Tags whose tilt contradicted gravity: biases absorbed the difference, and would tilt the following estimates."""
    robot, _ = rest_pushed(body, ticks, multiply(Q_WB, exp(np.array([0.3, 0.0, 0.0]))))
    for _ in range(RESET_AFTER):
        estimate = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - PERIOD)))
    assert estimate.rejected >= RESET_AFTER
    for _ in range(100):
        assert_rests(robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - PERIOD))))


@pytest.mark.parametrize("ticks", [1, 100], ids=["before the first tag", "later"])
def test_tag_whose_attitude_is_none_is_refused(body: Body, ticks: int) -> None:
    """No frame can hold such a quaternion; a filter that started from one would divide by zero."""
    robot = Robot(body)
    robot.rest(ticks)
    for _ in range(3):
        estimate = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - PERIOD)._replace(q_wb=np.zeros(4))))
    assert estimate.rejected == 3
    assert_rests(robot.rest(5 * READY_AFTER), tolerance_m=0.02)


@pytest.mark.parametrize("speed", [1e3, -1e160])
def test_filter_that_believes_a_speed_that_no_robot_has_begins_anew(body: Body, speed: float) -> None:
    """A false depth once made it believe 1e160 m/s."""
    robot = Robot(body)
    robot.rest(101)
    robot.estimator._anchor.x[8] = speed
    estimate = robot.step(sensors())
    assert not estimate.ready and np.isfinite(estimate.p_wb).all() and not estimate.nu.any()
    estimate = robot.rest(5 * READY_AFTER)
    assert estimate.ready
    assert_rests(estimate, tolerance_m=0.02)


@pytest.mark.parametrize(("first", "most"), [(7, MOST_SPEED_M_S), (10, MOST_RATE_RAD_S)])
def test_robot_may_be_thrown_into_the_water_and_spin_but_not_beyond_what_its_gyro_can_tell(first: int, most: float) -> None:
    x, share = np.eye(1, STATES, 3)[0], np.array([0.6, 0.0, -0.8])
    for factor, is_possible in ((0.99, True), (1.01, False), (math.nan, False)):
        x[first : first + 3] = factor * most * share
        assert is_sound(x, np.ones(6)) == is_possible


def test_good_tags_between_bad_ones_keep_the_pose(body: Body) -> None:
    robot = Robot(body)
    robot.rest(100)
    for n in range(3 * RESET_AFTER):
        seen = tag(robot.time_ns - PERIOD, P_WB if n % 10 == 9 else P_WB + np.array([0.5, 0.0, 0.0]))
        estimate = robot.step(sensors(P_WB, Q_WB, seen))
    assert_rests(estimate)
    assert estimate.rejected == 27 * 3


def test_tag_older_than_one_that_counted_is_refused(body: Body) -> None:
    """Pictures are fused in time order only: one that was overtaken is not used any more."""
    robot = Robot(body)
    robot.rest(60)
    robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - 3 * PERIOD)))
    estimate = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - 6 * PERIOD)))
    assert estimate.rejected == 1
    assert math.isnan(estimate.nis) and estimate.nis_dof == 0


def test_tag_older_than_the_window_is_refused(body: Body) -> None:
    """The window is half a second, plus the tick by which the filter lags behind."""
    robot = Robot(body)
    robot.rest(60)
    for _ in range(70):
        robot.step(sensors())
    assert robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - 511_000_000))).rejected == 1
    accepted = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - 499_000_000)))
    assert (accepted.rejected, accepted.nis_dof) == (1, 6)


def test_picture_with_more_tags_weighs_more(body: Body) -> None:
    """The noise of a mean falls with the square root of the number of tags in it."""
    moved = []
    for count in (1, 4, 16):
        robot = Robot(body)
        robot.rest(101)
        aside = tag(robot.time_ns - PERIOD, P_WB + np.array([0.004, 0.0, 0.0]))._replace(tags=count)
        moved.append(robot.step(sensors(P_WB, Q_WB, aside)).p_wb[0] - P_WB[0])
    assert 0.0 < 1.3 * moved[0] < moved[1] and 1.3 * moved[1] < moved[2] < 0.004
