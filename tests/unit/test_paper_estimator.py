"""The paper's tag-only filter: it follows a steady run, is late by the tags' delay, and refuses flips."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body
from firmware_py.core.estimator import READY_AFTER, RESET_AFTER
from firmware_py.core.paper_estimator import TagOnlyEstimator
from firmware_py.core.rotations import difference, exp, from_euler, multiply
from firmware_py.core.types import BodyPose, Estimate, Measured
from firmware_py.description.parameters import Estimation
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

PERIOD = 10_000_000
P_WB = np.array([1.0, -0.5, 0.8])
Q_WB = from_euler(0.2, -0.4, 1.0)
R_WB = Rotation.from_quat(Q_WB[[1, 2, 3, 0]])
LEVER = np.array([0.0, 0.0, -0.105])
PAPER = replace(Estimation(), kind="paper")


@pytest.fixture(scope="module")
def body() -> Body:
    return assemble_vehicle(load_vehicle("modcube"))


def seen(capture_ns: int, p_wb: np.ndarray = P_WB, q_wb: np.ndarray = Q_WB) -> Measured:
    turn = Rotation.from_quat(q_wb[[1, 2, 3, 0]])
    return Measured(None, None, None, [BodyPose(capture_ns, p_wb + turn.apply(LEVER), LEVER, q_wb, 1)])


NOTHING = Measured(None, None, None, [])


def run(body: Body, velocity_w: np.ndarray, ticks: int) -> tuple[Estimate, np.ndarray]:
    """A steady run with a tag in every second tick; the last estimate, and where the robot was."""
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    for k in range(ticks):
        p = P_WB + velocity_w * k * 0.01
        estimate = estimator.step(k * PERIOD, seen(k * PERIOD, p) if k % 2 == 0 else NOTHING, np.zeros(6))
    return estimate, p


def test_paper_estimator_follows_a_steady_run(body: Body) -> None:
    velocity_w = np.array([0.1, -0.2, 0.05])
    estimate, p = run(body, velocity_w, 1000)
    np.testing.assert_allclose(estimate.p_wb, p, atol=1e-4)
    np.testing.assert_allclose(R_WB.apply(estimate.nu[:3]), velocity_w, atol=1e-3)
    assert estimate.ready


def test_paper_estimator_follows_a_steady_turn(body: Body) -> None:
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    rate = np.array([0.0, 0.3, 0.0])
    for k in range(1000):
        q = multiply(Q_WB, exp(rate * k * 0.01))
        estimate = estimator.step(k * PERIOD, seen(k * PERIOD, P_WB, q), np.zeros(6))
    np.testing.assert_allclose(difference(estimate.q_wb, q), 0.0, atol=1e-4)
    np.testing.assert_allclose(estimate.nu[3:], rate, atol=1e-3)


def test_paper_estimator_does_not_make_up_for_delay(body: Body) -> None:
    """It takes a picture for the present: 50 ms at 0.2 m/s are 10 mm behind."""
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    for k in range(1000):
        p = P_WB + np.array([0.2, 0.0, 0.0]) * k * 0.01
        late = seen((k - 5) * PERIOD, p - np.array([0.01, 0.0, 0.0]))
        estimate = estimator.step(k * PERIOD, late, np.zeros(6))
    assert p[0] - estimate.p_wb[0] == pytest.approx(0.01, abs=1e-4)


def test_paper_estimator_is_ready_after_ten_tags(body: Body) -> None:
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    ready = [estimator.step(k * PERIOD, seen(k * PERIOD), np.zeros(6)).ready for k in range(READY_AFTER)]
    assert ready == [False] * (READY_AFTER - 1) + [True]


def test_paper_estimator_knows_nothing_of_a_disturbance(body: Body) -> None:
    estimate, _ = run(body, np.zeros(3), 100)
    assert not estimate.force_w.any() and not estimate.moment_b.any()


def test_paper_estimator_refuses_flips(body: Body) -> None:
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    for k in range(50):
        estimator.step(k * PERIOD, seen(k * PERIOD), np.zeros(6))
    flipped = seen(50 * PERIOD, P_WB, multiply(Q_WB, exp(np.array([0.8, 0.0, 0.0]))))
    estimate = estimator.step(50 * PERIOD, flipped, np.zeros(6))
    assert estimate.rejected == 1
    np.testing.assert_allclose(estimate.p_wb, P_WB, atol=1e-6)
    np.testing.assert_allclose(difference(estimate.q_wb, Q_WB), 0.0, atol=1e-6)


def test_paper_estimator_begins_anew_where_tags_stay_elsewhere_and_forgives_flips(body: Body) -> None:
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    turned = multiply(Q_WB, exp(np.array([1.0, 0.0, 0.0])))
    for k in range(100):
        estimator.step(k * PERIOD, seen(k * PERIOD), np.zeros(6))
    for k in range(100, 100 + RESET_AFTER - 1):
        estimator.step(k * PERIOD, seen(k * PERIOD, P_WB, turned), np.zeros(6))
    assert estimator.step(200 * PERIOD, seen(200 * PERIOD), np.zeros(6)).ready, "a good tag after many flips is no reason to forget"
    for k in range(300, 300 + RESET_AFTER + READY_AFTER):
        estimate = estimator.step(k * PERIOD, seen(k * PERIOD, P_WB, turned), np.zeros(6))
    np.testing.assert_allclose(difference(estimate.q_wb, turned), 0.0, atol=1e-3)
    assert estimate.ready
