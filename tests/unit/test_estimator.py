"""The estimator on a robot at rest or in steady motion: missing sensors, biases, trim, and the time between tags."""

import math
from dataclasses import replace

import numpy as np
import pytest

from firmware_py.core import propagation
from firmware_py.core.body import CRUISE_M_S, Body
from firmware_py.core.drag_lookup import add_drag
from firmware_py.core.estimator import READY_AFTER
from firmware_py.core.rotations import difference, exp, from_euler, multiply
from firmware_py.core.types import NEVER_AGE_NS, Measured
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.estimated_robot import DELAY_TICKS, NOTHING, P_WB, PERIOD, Q_WB, P, Robot, assert_rests, holding, sensors, tag, world

# ---------------------------------------------------------------- from nothing to a pose


def test_robot_that_saw_no_tag_knows_nothing_for_a_second(body: Body) -> None:
    robot = Robot(body)
    for _ in range(100):
        estimate = robot.step(sensors())
    assert not estimate.ready
    assert estimate.sigma_p.min() > 100.0
    assert estimate.tag_age_ns >= NEVER_AGE_NS
    assert math.isnan(estimate.nis)


def test_pose_is_believed_after_ten_tags(body: Body) -> None:
    robot = Robot(body)
    for n in range(READY_AFTER):
        assert not robot.step(NOTHING).ready
        ready = robot.step(Measured(None, None, None, [tag(robot.time_ns - 3 * PERIOD)])).ready
        assert ready == (n == READY_AFTER - 1)


def test_first_tag_gives_the_pose_at_once(body: Body) -> None:
    robot = Robot(body)
    assert_rests(robot.step(sensors(P_WB, Q_WB, tag(0))), tolerance_m=1e-9)


def test_age_of_the_tag_is_counted_from_its_picture(body: Body) -> None:
    robot = Robot(body)
    robot.rest(60)
    robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - 30_000_000)))
    assert robot.step(sensors()).tag_age_ns == 40_000_000


# ---------------------------------------------------------------- between tags


def test_pose_is_carried_through_two_seconds_without_a_tag(body: Body) -> None:
    robot = Robot(body)
    seen = robot.rest(300)
    for _ in range(200):
        blind = robot.step(sensors())
    np.testing.assert_allclose(blind.p_wb, P_WB, atol=0.05)
    assert np.all(blind.sigma_p[:2] > 3.0 * seen.sigma_p[:2]), "and it says that it knows less"
    assert blind.tag_age_ns >= 2_000_000_000


def test_depth_is_followed_at_once_while_no_tag_comes(body: Body) -> None:
    """Waiting for late tags must not delay the depth by half a second."""
    robot = Robot(body)
    robot.rest(300)
    for _ in range(100):
        robot.step(sensors())
    for _ in range(30):
        estimate = robot.step(sensors()._replace(depth_m=P_WB[2] + 0.1))
    assert estimate.p_wb[2] > P_WB[2] + 0.05


def test_head_and_anchor_believe_the_same(body: Body) -> None:
    """The head, which runs ahead, has fused what the anchor will fuse, in the same order."""
    robot = Robot(body)
    robot.rest(301)
    for tick in range(80):
        robot.step(sensors(P_WB + 1e-3 * tick))
    estimator = robot.estimator
    assert estimator._head.time_ns == robot.time_ns - 2 * PERIOD
    assert estimator._anchor.time_ns == robot.time_ns - PERIOD - 500_000_000
    caught_up = estimator._filter.advanced(estimator._anchor, estimator._head.time_ns)
    np.testing.assert_allclose(estimator._head.x, caught_up.x, atol=1e-12)
    np.testing.assert_allclose(estimator._head.covariance, caught_up.covariance, atol=1e-12)


@pytest.mark.parametrize(("blind_ticks", "ahead"), [(24, 0), (25, 4), (27, 12), (40, 44), (70, 49)])
def test_head_leaves_the_anchor_after_a_quarter_of_a_second_and_hurries(body: Body, blind_ticks: int, ahead: int) -> None:
    robot = Robot(body)
    robot.rest(302)
    for _ in range(blind_ticks):
        robot.step(sensors())
    estimator = robot.estimator
    assert (estimator._head.time_ns - estimator._anchor.time_ns) // PERIOD == ahead
    back = robot.step(sensors(P_WB, Q_WB, tag(robot.time_ns - DELAY_TICKS * PERIOD)))
    assert estimator._head is estimator._anchor
    assert_rests(back)


def test_gyro_turns_the_robot_between_tags(body: Body) -> None:
    """What the gyro measured since the last picture shows in the same tick, whatever the thruster model says."""
    robot = Robot(body)
    robot.rest(200)
    rate = np.array([0.0, 0.0, 0.5])
    for _ in range(10):
        estimate = robot.step(sensors()._replace(gyro=rate))
    np.testing.assert_allclose(estimate.nu[3:], rate, atol=5e-3)
    turned = 0.095 * rate  # the ten ticks, less half of the one in which the turn began
    np.testing.assert_allclose(difference(estimate.q_wb, Q_WB), turned, atol=4e-3)


def test_turn_that_no_model_foresees_is_followed_to_its_end(body: Body) -> None:
    """A second at 2 rad/s^2 that no thruster made: each tick's increment used to lose half a tick, half a degree in all."""
    robot = Robot(replace(body, righting=np.zeros(3)))  # without a righting moment, which would act on top
    robot.rest(301)
    axis, alpha = np.array([0.0, 0.6, 0.8]), 2.0
    for tick in range(1, 101):
        turned = exp(axis * (0.5 * alpha * (0.01 * tick) ** 2))
        q_wb = multiply(Q_WB, turned)
        estimate = robot.step(sensors(P_WB, q_wb)._replace(gyro=axis * (alpha * 0.01 * tick)))
    assert np.linalg.norm(difference(estimate.q_wb, q_wb)) < 1.5e-3


def test_skipped_ticks_are_flown_through(body: Body) -> None:
    robot = Robot(body)
    robot.rest(200)
    robot.tick += 7
    assert_rests(robot.rest(2))


@pytest.mark.parametrize("missing", ["gyro", "accel", "depth_m"])
def test_pose_is_kept_without_one_kind_of_sensor(body: Body, missing: str) -> None:
    robot = Robot(body)
    for _ in range(300):
        seen = [tag(robot.time_ns - 5 * PERIOD)] if robot.tick % 2 else []
        estimate = robot.step(sensors(P_WB, Q_WB, *seen)._replace(**{missing: None}))
    assert_rests(estimate)
    assert estimate.rejected == 0


# ---------------------------------------------------------------- what it learns


def test_gyro_bias_is_learned(body: Body) -> None:
    robot = Robot(body)
    bias = np.array([0.02, -0.01, 0.015])
    for _ in range(1000):
        seen = [tag(robot.time_ns - 5 * PERIOD)] if robot.tick % 2 else []
        estimate = robot.step(sensors(P_WB, Q_WB, *seen)._replace(gyro=bias))
    np.testing.assert_allclose(estimate.nu[3:], 0.0, atol=1e-3)
    assert_rests(estimate)


def test_tag_fixes_the_datum_of_the_depth(body: Body) -> None:
    """Weather shifts the pressure sensor's zero by 10 cm; the estimate does not follow it."""
    robot = Robot(body)
    for _ in range(500):
        seen = [tag(robot.time_ns - 5 * PERIOD)] if robot.tick % 2 else []
        estimate = robot.step(sensors(P_WB, Q_WB, *seen)._replace(depth_m=P_WB[2] + 0.1))
    assert_rests(estimate)


@pytest.mark.slow
def test_current_and_trim_are_learned_as_a_disturbance(body: Body) -> None:
    """The thrusters hold the robot against a force in the world, 2 N north, and a trim moment; the estimate shows both."""
    force_w, moment_b = np.array([2.0, -1.0, 0.5]), np.array([0.05, -0.08, 0.02])
    robot = Robot(body)
    robot.tau = robot.tau - np.r_[world(Q_WB).inv().apply(force_w), moment_b]
    estimate = robot.rest(1500)
    np.testing.assert_allclose(estimate.force_w, force_w, atol=0.05)
    np.testing.assert_allclose(estimate.moment_b, moment_b, atol=5e-3)
    np.testing.assert_allclose(estimate.nu[:3], 0.0, atol=2e-3)


def test_velocity_of_a_steady_run_is_found(body: Body) -> None:
    """0.2 m/s ahead, tags 50 ms late: position without lag, velocity within 1 cm/s."""
    velocity_w = world(Q_WB).apply([0.2, 0.0, 0.0])
    robot = Robot(body)
    nu = np.r_[0.2, np.zeros(5)]
    drag_free = np.zeros(6)
    robot.tau = -np.linalg.solve(body.mass_inv, propagation.acceleration(nu, Q_WB, drag_free, *body.plant))
    for _ in range(500):
        now, then = (P_WB + velocity_w * 1e-9 * t for t in (robot.time_ns, robot.time_ns - 5 * PERIOD))
        seen = [tag(robot.time_ns - 5 * PERIOD, then)] if robot.tick % 2 else []
        estimate = robot.step(sensors(now, Q_WB, *seen))
    assert_rests(estimate, now, tolerance_m=2e-3)
    np.testing.assert_allclose(estimate.nu, nu, atol=0.01)


def test_robot_on_its_head_is_estimated_like_any_other(body: Body) -> None:
    upside = from_euler(math.pi, 0.5 * math.pi, 0.3)
    robot = Robot(body)
    robot.tau = holding(body, upside)
    for _ in range(300):
        seen = [tag(robot.time_ns - 5 * PERIOD, P_WB, upside)] if robot.tick % 2 else []
        estimate = robot.step(sensors(P_WB, upside, *seen))
    np.testing.assert_allclose(difference(estimate.q_wb, upside), 0.0, atol=1e-3)
    np.testing.assert_allclose(estimate.p_wb, P_WB, atol=1e-3)
    assert estimate.rejected == 0


def disturbance_doubt(vehicle: str, current_walk: float, speed_m_s: float) -> float:
    """Standard deviation of the disturbance force after nine seconds without a tag, per mass, m/s^2."""
    body = assemble_vehicle(load_vehicle(vehicle))
    robot = Robot(body, replace(P, force_walk=0.015, current_walk=current_walk))
    robot.rest(100)
    way = np.array([speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0])
    add_drag(body.drag.nodes, body.drag.rotational, body.drag.linear, way, robot.tau)
    robot.tau = 2.0 * holding(body) - robot.tau  # thrust that makes up for the drag
    robot.estimator._anchor.x[7:10] = way[:3]
    for _ in range(900):
        robot.step(Measured(np.zeros(3), None, None, []))
    assert np.linalg.norm(robot.estimator.motion.x[7:10]) == pytest.approx(speed_m_s, abs=0.1 * CRUISE_M_S)
    return float(np.sqrt(robot.estimator.motion.covariance[18, 18]) / body.mass[0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["modcube", "bluerov2_heavy"])
def test_robot_under_way_doubts_the_current_by_its_drag_and_one_at_rest_does_not(vehicle: str) -> None:
    """Two random walks add in quadrature; the second is that of the current times the slope of the drag, as far as the speed is kept."""
    body = assemble_vehicle(load_vehicle(vehicle))
    walked = math.sqrt(disturbance_doubt(vehicle, 0.02, CRUISE_M_S) ** 2 - disturbance_doubt(vehicle, 0.0, CRUISE_M_S) ** 2)
    assert walked == pytest.approx(0.02 * body.drag.cruise_slope / body.mass[0, 0] * math.sqrt(9.0), rel=0.1)
    assert disturbance_doubt(vehicle, 0.02, 0.0) == pytest.approx(disturbance_doubt(vehicle, 0.0, 0.0), rel=1e-3)


@pytest.mark.parametrize("spoil", ["state", "covariance", "negative variance"])
def test_estimate_that_is_no_number_any_longer_is_given_up_and_found_again(body: Body, spoil: str) -> None:
    """Whatever the sensors sent to cause it: a NaN in the filter would never go away by itself."""
    robot = Robot(body)
    robot.rest(200)
    if spoil == "state":
        robot.estimator._anchor.x[7] = math.nan
    else:
        robot.estimator._anchor.covariance[:3, :3] = np.eye(3) * (math.nan if spoil == "covariance" else -1e3)
    lost = robot.step(sensors())
    assert not lost.ready
    assert all(np.isfinite(part).all() for part in lost[:7])
    assert robot.rest(200).ready
    assert_rests(robot.rest(100), tolerance_m=2e-3)
