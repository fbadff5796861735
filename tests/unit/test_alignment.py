"""Before the first tags: attitude from gravity after a second, position and heading only once ten tags agree."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core.alignment import TagAgreement, upright
from firmware_py.core.drag_lookup import add_drag
from firmware_py.core.estimator import READY_AFTER, RESET_AFTER, Estimator
from firmware_py.core.rotations import difference, exp, from_euler, heading, multiply
from firmware_py.core.types import NEVER_AGE_NS, BodyPose, Estimate, Measured
from firmware_py.description.parameters import Estimation
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

BODY = assemble_vehicle(load_vehicle("modcube"))
PERIOD = 10_000_000
G = 9.80665
STILL = np.zeros((20, 3))
P_WB, Q_WB = np.array([1.0, -0.5, 0.8]), from_euler(0.2, -0.4, 2.5)
LEVER = np.array([0.0, 0.0, -0.105])
UPSIDE_DOWN = (math.pi, 0.0, 0.0)


def turned_back(q_wb: np.ndarray, v_w: np.ndarray) -> np.ndarray:
    return np.asarray(Rotation.from_quat(q_wb[[1, 2, 3, 0]]).inv().apply(v_w))


def felt(q_wb: np.ndarray, more: tuple[float, float, float] = (0.0, 0.0, 0.0), count: int = 20) -> np.ndarray:
    """(count, 3) specific forces, body frame, of a body at rest except for the acceleration `more`, world frame."""
    return np.tile(turned_back(q_wb, np.array(more) - [0.0, 0.0, G]), (count, 1))


def tag(capture_ns: int, p_wb: np.ndarray = P_WB, q_wb: np.ndarray = Q_WB) -> BodyPose:
    return BodyPose(capture_ns, p_wb + Rotation.from_quat(q_wb[[1, 2, 3, 0]]).apply(LEVER), LEVER, q_wb, 1.0)


class Robot:
    """A robot at rest and its estimator, tick by tick."""

    def __init__(self, q_wb: np.ndarray = Q_WB) -> None:
        self.estimator, self.q_wb, self.tick = Estimator(BODY, Estimation(), PERIOD), q_wb, 0
        down_b = turned_back(q_wb, np.array([0.0, 0.0, 1.0]))
        self.tau = np.r_[0.0, 0.0, 0.0, np.cross(BODY.righting, down_b)]

    @property
    def time_ns(self) -> int:
        return self.tick * PERIOD

    def step(self, *tags: BodyPose, depth_m: float | None = 0.8, gyro: np.ndarray | None = None) -> Estimate:
        self.tick += 1
        rate = np.zeros(3) if gyro is None else gyro
        return self.estimator.step(self.time_ns, Measured(rate, felt(self.q_wb)[0], depth_m, list(tags)), self.tau)

    def rest(self, ticks: int) -> Estimate:
        for _ in range(ticks):
            estimate = self.step()
        return estimate

    def turn(self, rate: np.ndarray, ticks: int) -> Estimate:
        """Turns the robot about its centre at `rate` (3,) rad/s, body frame, by something that the model does not contain."""
        for _ in range(ticks):
            self.q_wb = multiply(self.q_wb, exp(rate * PERIOD * 1e-9))
            estimate = self.step(gyro=rate)
        return estimate

    def see(self, count: int, p_wb: np.ndarray = P_WB, q_wb: np.ndarray = Q_WB) -> Estimate:
        for _ in range(count):
            estimate = self.step(tag(self.time_ns - 2 * PERIOD, p_wb, q_wb))
        return estimate


# ---------------------------------------------------------------- gravity


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.5, -0.3, 0.0), (-2.0, 1.2, 0.0), UPSIDE_DOWN, (0.3, 1.5, 0.0)])
def test_gravity_tells_roll_and_pitch(angles: tuple[float, float, float]) -> None:
    q_wb = from_euler(*angles)
    found = upright(STILL, felt(q_wb))
    assert found is not None
    np.testing.assert_allclose(difference(found, q_wb), 0.0, atol=1e-9)


def test_heading_is_not_felt() -> None:
    found = upright(STILL, felt(from_euler(0.3, 0.2, 2.0)))
    assert found is not None
    np.testing.assert_allclose(difference(found, from_euler(0.3, 0.2, 0.0)), 0.0, atol=1e-9)


def test_mean_is_taken_over_what_came() -> None:
    accels = felt(Q_WB)
    accels[::2] = np.nan
    accels[1::4] += 0.2
    accels[3::4] -= 0.2
    found = upright(STILL, accels)
    assert found is not None
    np.testing.assert_allclose(turned_back(found, np.array([0.0, 0.0, -G])), felt(Q_WB)[0], atol=1e-9)


@pytest.mark.parametrize("imu_every", [1, 4, 8])
def test_imu_that_is_slower_than_the_tick_feels_gravity(imu_every: int) -> None:
    """Regression: with one of 100 Hz at 400 Hz, whose ticks of 0.2 s are 80, a robot without tags never had an attitude."""
    came = np.arange(80)[:, None] % imu_every == 0
    gyros, accels = (np.where(came, values, np.nan) for values in (np.zeros((80, 3)), felt(Q_WB, count=80)))
    found = upright(gyros, accels)
    assert found is not None
    np.testing.assert_allclose(turned_back(found, np.array([0.0, 0.0, -G])), felt(Q_WB)[0], atol=1e-9)


@pytest.mark.parametrize(("gyros", "accels"), [
    (STILL, felt(Q_WB, (0.0, 0.0, 0.51))),
    (STILL, felt(Q_WB, (0.0, 0.0, -0.51))),
    (STILL + np.array([0.0, 0.51, 0.0]), felt(Q_WB)),
    (STILL, np.full((20, 3), np.nan)),
    (np.tile([0.6, -0.6, 0.0], (20, 1)), felt(Q_WB)),
    (np.full((20, 3), np.nan), felt(Q_WB)),
    (STILL, np.where(np.arange(20)[:, None] < 11, np.nan, felt(Q_WB))),
    (STILL[:0], felt(Q_WB, count=0)),
    (STILL, np.full((20, 3), np.inf)),
], ids=[
    "pushed down", "pushed up", "turning", "swaying", "no accelerometer", "no gyro", "too few", "nothing", "infinite",
])  # fmt: skip
def test_attitude_is_not_guessed_from_what_is_not_gravity(gyros: np.ndarray, accels: np.ndarray) -> None:
    assert upright(gyros, accels) is None


# ---------------------------------------------------------------- the first tags


def test_tags_that_tell_the_same_are_counted() -> None:
    agreement = TagAgreement()
    for n in range(3):
        assert agreement.agrees(tag(n, P_WB + 0.01 * n), np.zeros(3), Q_WB)
    assert agreement.count == 3


@pytest.mark.parametrize(("p_wb", "q_wb"), [
    (P_WB + np.array([0.0, 0.11, 0.0]), Q_WB), (P_WB, multiply(from_euler(0.0, 0.0, 0.11), Q_WB)),
], ids=["elsewhere", "heading elsewhere"])  # fmt: skip
def test_tag_that_tells_another_place_or_heading_begins_the_count_anew(p_wb: np.ndarray, q_wb: np.ndarray) -> None:
    agreement = TagAgreement()
    for n in range(5):
        agreement.agrees(tag(n), np.zeros(3), Q_WB)
    assert agreement.agrees(tag(5, p_wb, q_wb), np.zeros(3), Q_WB) and agreement.count == 1
    assert agreement.agrees(tag(6, p_wb, q_wb), np.zeros(3), Q_WB) and agreement.count == 2


@pytest.mark.parametrize(("gap_s", "moved_m", "count"), [(0.2, 0.25, 6), (0.2, 0.35, 1), (1.0, 1.0, 6), (1.01, 0.0, 1)])
def test_tags_that_come_seldom_tell_the_same_of_a_robot_that_moves_and_nothing_after_a_second(
    gap_s: float, moved_m: float, count: int
) -> None:
    agreement = TagAgreement()
    for n in range(5):
        agreement.agrees(tag(n), np.zeros(3), Q_WB)
    agreement.agrees(tag(4 + round(gap_s * 1e9), P_WB + np.array([moved_m, 0.0, 0.0])), np.zeros(3), Q_WB)
    assert agreement.count == count


@pytest.mark.parametrize(("known_m", "count"), [(0.5, 2), (0.0, 1)])
def test_tags_of_a_robot_that_moves_tell_the_same_where_its_way_is_known(known_m: float, count: int) -> None:
    agreement, way = TagAgreement(), np.array([1.0, 0.0, 0.0])
    agreement.agrees(tag(0), np.zeros(3), Q_WB)
    agreement.agrees(tag(16_000_000, P_WB + 0.5 * way), known_m * way, Q_WB)
    assert agreement.count == count


def test_headings_are_compared_around_the_circle() -> None:
    agreement = TagAgreement()
    for n, north in enumerate((math.pi - 0.02, -math.pi + 0.02, math.pi - 0.02)):
        assert agreement.agrees(tag(n, q_wb=from_euler(0.0, 0.0, north)), np.zeros(3), from_euler(0.0, 0.0, 0.0))
    assert agreement.count == 3


@pytest.mark.parametrize(("tilt_rad", "agrees"), [(0.34, True), (0.36, False), (0.7, False), (math.pi, False)])
def test_tag_with_another_way_down_does_not_agree(tilt_rad: float, agrees: bool) -> None:
    agreement = TagAgreement()
    agreement.agrees(tag(0), np.zeros(3), Q_WB)
    flipped = multiply(from_euler(0.0, 0.0, 1.0), multiply(exp(np.array([0.0, tilt_rad, 0.0])), Q_WB))
    assert agreement.agrees(tag(1, q_wb=flipped), np.zeros(3), Q_WB) is agrees
    assert agreement.count == 1, "gravity has left out what is flipped: the others count on"


# ---------------------------------------------------------------- the estimator


@pytest.mark.slow
def test_robot_without_a_tag_stands_upright_after_a_second() -> None:
    robot = Robot()
    assert not robot.rest(100).ready
    estimate = robot.rest(1)
    assert estimate.ready and not estimate.placed and estimate.tag_age_ns >= NEVER_AGE_NS
    estimate = robot.rest(1000)
    level = multiply(heading(estimate.q_wb), from_euler(0.2, -0.4, 0.0))
    np.testing.assert_allclose(difference(estimate.q_wb, level), 0.0, atol=2e-3)
    assert estimate.p_wb[2] == pytest.approx(0.8, abs=2e-3)
    assert np.abs(estimate.p_wb[:2]).max() < 0.1 and np.abs(estimate.nu).max() < 0.01
    assert estimate.sigma_p[:2].tolist() == [1e3, 1e3] and 0.05 < estimate.sigma_p[2] < 0.1, "the depth without its datum"
    vertical = turned_back(estimate.q_wb, np.array([0.0, 0.0, 1.0]))
    assert np.linalg.norm(estimate.sigma_q) == pytest.approx(1e3, rel=0.01) and abs(vertical @ estimate.sigma_q) > 900.0


def test_turning_robot_waits_until_it_rests() -> None:
    robot = Robot()
    for _ in range(150):
        assert not robot.step(gyro=np.array([0.0, 0.6, 0.0])).ready
    assert robot.rest(30).ready


@pytest.mark.parametrize("depth_m", [0.1, 5.0])
def test_depth_that_was_not_heard_at_first_is_taken_when_it_comes(depth_m: float) -> None:
    robot = Robot()
    for _ in range(110):
        estimate = robot.step(depth_m=None)
    assert estimate.ready and estimate.sigma_p[2] > 100.0
    for _ in range(60):
        estimate = robot.step(depth_m=depth_m)
    assert estimate.p_wb[2] == pytest.approx(depth_m, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("accel_m_s2", [1.0, 3.0])
def test_robot_that_is_pushed_across_when_it_stands_up_rights_itself(accel_m_s2: float) -> None:
    """The thrusters push it, which the model contains: the tilt is wrong by up to 17 deg at first."""
    robot = Robot(from_euler(0.0, 0.0, 0.0))
    rest_tau, push = robot.tau, np.array([accel_m_s2, 0.0, 0.0])
    robot.tau = rest_tau + np.r_[BODY.mass[0, 0] * push, 0.0, 0.0, 0.0]
    for _ in range(101):
        robot.tick += 1
        measured = Measured(np.zeros(3), felt(robot.q_wb, (accel_m_s2, 0.0, 0.0))[0], 0.8, [])
        estimate = robot.estimator.step(robot.time_ns, measured, robot.tau)
    assert np.linalg.norm(difference(estimate.q_wb, robot.q_wb)) == pytest.approx(math.atan(accel_m_s2 / G), abs=0.02)
    robot.tau = rest_tau
    assert np.linalg.norm(difference(robot.rest(1000).q_wb, robot.q_wb)) < 0.02


@pytest.mark.slow
def test_steady_thrust_for_a_minute_is_believed_to_drive_nobody_mad() -> None:
    """Half stick: without bounds the velocity estimate grew to 15 m/s."""
    robot = Robot(from_euler(0.1, 0.0, 0.0))
    drag, way = np.zeros(6), np.r_[0.45, np.zeros(5)]
    add_drag(BODY.drag.nodes, BODY.drag.rotational, BODY.drag.linear, way, drag)
    robot.rest(300)
    robot.tau = robot.tau - 1.3 * drag
    estimate = robot.rest(6000)
    assert np.linalg.norm(robot.estimator._anchor.x[7:10]) < 0.5, "late tags find the filter sound"
    assert np.linalg.norm(estimate.nu[:3]) < 0.5 and np.linalg.norm(estimate.force_w) < 30.0
    assert np.linalg.norm(difference(estimate.q_wb, multiply(heading(estimate.q_wb), robot.q_wb))) < 0.05


@pytest.mark.slow
def test_heading_that_nobody_told_is_not_learned_from_noise() -> None:
    """Heading and vertical gyro bias used to count as known, and a bump turned the estimate by 344 deg."""
    rng, robot, q_wb = np.random.default_rng(1), Robot(from_euler(0.0, 0.0, 0.0)), []
    for tick in range(3100):
        robot.tick += 1
        bump = np.array([1.5, 1.0, 0.0]) if 3000 <= tick < 3010 else np.zeros(3)
        accel = felt(robot.q_wb)[0] + bump + rng.normal(0.0, 0.036, 3)
        q_wb.append(robot.estimator.step(robot.time_ns, Measured(rng.normal(0.0, 0.0022, 3), accel, 0.8, []), robot.tau).q_wb)
    assert np.linalg.norm(difference(q_wb[-1], q_wb[2999])) < 0.01
    assert abs(robot.estimator.motion.x[15]) < 1e-3


@pytest.mark.slow
def test_rise_or_fall_that_no_depth_tells_is_not_believed_to_go_on_for_ever() -> None:
    robot = Robot(from_euler(0.1, 0.0, 0.0))
    drag, way = np.zeros(6), np.r_[0.4, 0.0, 0.45, np.zeros(3)]
    add_drag(BODY.drag.nodes, BODY.drag.rotational, BODY.drag.linear, way, drag)
    robot.rest(300)
    robot.tau = robot.tau - 1.3 * drag
    for _ in range(6000):
        estimate = robot.step(depth_m=None)
    assert np.linalg.norm(estimate.nu[:3]) < 0.2 and np.linalg.norm(estimate.force_w) < 30.0
    estimate = robot.rest(100)
    assert estimate.p_wb[2] == pytest.approx(0.8, abs=0.02)
    assert np.linalg.norm(difference(estimate.q_wb, multiply(heading(estimate.q_wb), robot.q_wb))) < 0.03


@pytest.mark.slow
def test_tags_that_come_too_seldom_to_be_believed_keep_nobody_from_standing_up() -> None:
    robot, ready = Robot(), []
    for tick in range(1000):
        seen = [tag(robot.time_ns - 2 * PERIOD)] if tick % 150 == 0 else []
        ready.append(robot.step(*seen).ready)
    assert ready.index(True) < 250 and np.mean(ready[250:]) > 0.9


@pytest.mark.parametrize(("blind_ticks", "ready"), [(1150, True), (1230, False)])
def test_attitude_that_tags_bore_out_is_given_up_twelve_seconds_after_them(blind_ticks: int, ready: bool) -> None:
    robot = Robot()
    for tick in range(200 + blind_ticks):
        robot.tick += 1
        seen = [tag(robot.time_ns - 2 * PERIOD)] if tick < 200 else []
        estimate = robot.estimator.step(robot.time_ns, Measured(np.zeros(3), None, 0.8, seen), robot.tau)
    assert estimate.ready == ready


def test_attitude_that_no_accelerometer_bears_out_is_given_up() -> None:
    robot = Robot()
    robot.rest(300)
    ready = []
    for _ in range(210):
        robot.tick += 1
        ready.append(robot.estimator.step(robot.time_ns, Measured(np.zeros(3), None, 0.8, []), robot.tau).ready)
    assert ready.index(False) == 200
    assert robot.rest(150).ready


def test_robot_that_glimpsed_a_few_tags_stands_up_none_the_less() -> None:
    robot = Robot()
    robot.rest(20)
    robot.see(READY_AFTER - 1)
    assert not robot.rest(100).ready
    estimate = robot.rest(120)
    assert estimate.ready and not estimate.placed
    np.testing.assert_allclose(difference(estimate.q_wb, Q_WB), 0.0, atol=0.02)


def test_ten_tags_that_tell_the_same_give_place_and_heading() -> None:
    robot = Robot()
    before = robot.rest(300)
    estimate = robot.see(READY_AFTER - 1)
    assert estimate.ready and not estimate.placed
    assert np.linalg.norm(estimate.p_wb[:2] - before.p_wb[:2]) < 0.05
    estimate = robot.see(1)
    assert estimate.placed and estimate.tag_age_ns == 3 * PERIOD
    np.testing.assert_allclose(estimate.p_wb, P_WB, atol=5e-3)
    np.testing.assert_allclose(difference(estimate.q_wb, Q_WB), 0.0, atol=5e-3)
    assert estimate.sigma_p.max() < 0.05 and estimate.rejected == 0


@pytest.mark.slow
def test_what_was_learned_upright_stays_when_the_place_is_told() -> None:
    """The thrusters hold the body down with 2 N against an unmodelled force, which is learnt without any tag."""
    robot = Robot()
    robot.tau = robot.tau + np.r_[turned_back(Q_WB, np.array([0.0, 0.0, 2.0])), 0.0, 0.0, 0.0]
    before = robot.rest(2000)
    after = robot.see(READY_AFTER)
    assert before.force_w[2] == pytest.approx(-2.0, abs=0.2)
    assert after.force_w[2] == pytest.approx(before.force_w[2], abs=0.1)
    np.testing.assert_allclose(after.nu, before.nu, atol=0.02)
    np.testing.assert_allclose(after.moment_b, before.moment_b, atol=0.02)


def test_righting_that_was_learned_stays_when_the_place_is_told() -> None:
    robot, known = Robot(), np.array([0.1, -0.05, 0.2])
    robot.rest(200)
    for belief in (robot.estimator._anchor, robot.estimator._head):  # an opposite moment, so that nothing turns
        belief.x[22:25], belief.x[26:29] = -np.cross(known, turned_back(Q_WB, np.array([0.0, 0.0, -1.0]))), known
    before = robot.rest(1)
    after = robot.see(READY_AFTER)
    np.testing.assert_allclose(robot.estimator.motion.x[26:29], known, atol=0.03)
    np.testing.assert_allclose(after.moment_b, before.moment_b, atol=0.02)


def test_speed_that_was_made_up_is_not_kept_when_the_place_is_told() -> None:
    robot = Robot()
    robot.rest(200)
    robot.estimator._anchor.x[7:10] = robot.estimator._head.x[7:10] = [0.6, 0.0, 0.0]
    robot.see(READY_AFTER)
    assert robot.estimator._anchor.covariance.diagonal()[6:9] == pytest.approx(0.25)
    assert np.linalg.norm(robot.see(30).nu[:3]) < 0.1
    assert robot.see(1).rejected == 0


def test_flipped_tags_between_good_ones_place_nobody_and_keep_nobody_from_it() -> None:
    robot = Robot()
    robot.rest(200)
    flipped = multiply(Q_WB, exp(np.array([0.7, 0.0, 0.0])))
    for n in range(READY_AFTER):
        assert not robot.see(3, q_wb=flipped).placed
        assert robot.see(1).placed == (n == READY_AFTER - 1)
    assert np.linalg.norm(difference(robot.see(1).q_wb, Q_WB)) < 0.01


def test_tags_that_contradict_gravity_are_not_believed_though_there_are_no_others() -> None:
    """Started from them, the filter never had a pose: the accelerometer contradicted them, and every half second it started anew."""
    robot = Robot()
    robot.rest(200)
    flipped = multiply(Q_WB, exp(np.array([0.7, 0.0, 0.0])))
    after = robot.see(3 * RESET_AFTER, q_wb=flipped)
    assert after.ready and not after.placed and after.rejected == 3 * RESET_AFTER
    assert robot.see(READY_AFTER).placed


def test_tag_within_the_first_second_needs_no_gravity() -> None:
    robot = Robot()
    robot.rest(50)
    assert robot.see(READY_AFTER).placed
    assert robot.rest(300).placed, "and tags that end do not take the place away"


def test_robot_whose_process_stood_still_stands_up_where_it_was() -> None:
    robot = Robot()
    robot.rest(20)
    robot.see(200)
    robot.tick += 60
    assert not robot.rest(1).ready
    estimate = robot.rest(130)
    assert estimate.ready and not estimate.placed
    np.testing.assert_allclose(estimate.p_wb, P_WB, atol=0.05)
    np.testing.assert_allclose(difference(estimate.q_wb, Q_WB), 0.0, atol=0.02)


@pytest.mark.slow
def test_robot_that_was_adrift_for_long_believes_ten_tags_and_not_one() -> None:
    robot = Robot()
    robot.rest(20)
    robot.see(200)
    robot.rest(1100)
    there = P_WB + np.array([2.0, 1.0, 0.0])
    estimate = robot.see(READY_AFTER - 1, there)
    assert estimate.ready and estimate.placed and estimate.sigma_p[0] == 1e3
    assert np.linalg.norm(estimate.p_wb - P_WB) < 0.2
    estimate = robot.see(1, there)
    np.testing.assert_allclose(estimate.p_wb, there, atol=5e-3)
    assert estimate.rejected == 0 and estimate.tag_age_ns == 3 * PERIOD and estimate.sigma_p[0] < 0.05


@pytest.mark.slow
def test_robot_that_was_adrift_bumps_into_a_wall_and_still_knows_its_gyros() -> None:
    robot, bump = Robot(), np.array([0.4, -0.3, 0.5])
    robot.rest(20)
    robot.see(2000)
    robot.rest(1100)
    robot.see(30)
    robot.turn(bump, 50)
    robot.turn(-bump, 50)
    estimate = robot.rest(200)
    np.testing.assert_allclose(difference(estimate.q_wb, robot.q_wb), 0.0, atol=0.01)
    np.testing.assert_allclose(robot.estimator._anchor.x[13:16], 0.0, atol=0.001)


@pytest.mark.slow
def test_robot_that_made_its_heading_up_learns_its_gyros_when_tags_come() -> None:
    robot, bias = Robot(), np.array([0.0, 0.0, 0.01])
    for _ in range(6000):
        robot.step(gyro=bias)
    for _ in range(300):
        estimate = robot.step(tag(robot.time_ns - 2 * PERIOD), gyro=bias)
    np.testing.assert_allclose(difference(estimate.q_wb, Q_WB), 0.0, atol=0.005)


def test_parted_body_that_never_saw_a_tag_stands_on() -> None:
    robot, part = Robot(), Robot()
    before = robot.rest(300)
    estimate = part.estimator.restart(robot.time_ns, robot.estimator.motion)
    assert estimate.ready and not estimate.placed
    part.tick = robot.tick + 1
    still = Measured(np.zeros(3), None, None, [])
    assert part.estimator.step(part.time_ns, still, part.tau).ready, "what the whole has felt, its parts have"
    np.testing.assert_allclose(part.rest(50).p_wb, before.p_wb, atol=0.05)
    assert part.see(READY_AFTER).placed
