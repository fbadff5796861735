"""The paper's tag-only filter follows a steady run, lags by the tags' delay, and refuses flips."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body
from firmware_py.core.estimator import READY_AFTER, RESET_AFTER
from firmware_py.core.paper_estimator import TagOnlyEstimator
from firmware_py.core.propagation import ERRORS
from firmware_py.core.rotations import difference, exp, multiply
from firmware_py.core.topology import PARTED_SIGMA, part_of
from firmware_py.core.types import Estimate, Measured
from firmware_py.description.parameters import Estimation
from tests.unit.estimated_robot import NOTHING, P_WB, PERIOD, Q_WB, tag, world

PAPER = replace(Estimation(), kind="paper")


def seen(capture_ns: int, p_wb: np.ndarray = P_WB, q_wb: np.ndarray = Q_WB) -> Measured:
    return NOTHING._replace(tags=[tag(capture_ns, p_wb, q_wb)])


def run(body: Body, velocity_w: np.ndarray, ticks: int) -> tuple[Estimate, np.ndarray]:
    """Simulates a steady run with a tag in every second tick; returns the last estimate and the true place."""
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    for k in range(ticks):
        p = P_WB + velocity_w * k * 0.01
        estimate = estimator.step(k * PERIOD, seen(k * PERIOD, p) if k % 2 == 0 else NOTHING, np.zeros(6))
    return estimate, p


def test_paper_estimator_follows_a_steady_run(body: Body) -> None:
    velocity_w = np.array([0.1, -0.2, 0.05])
    estimate, p = run(body, velocity_w, 1000)
    np.testing.assert_allclose(estimate.p_wb, p, atol=1e-4)
    np.testing.assert_allclose(world(Q_WB).apply(estimate.nu[:3]), velocity_w, atol=1e-3)
    assert estimate.ready


def test_paper_estimator_follows_a_steady_turn(body: Body) -> None:
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    rate = np.array([0.0, 0.3, 0.0])
    for k in range(1000):
        q = multiply(Q_WB, exp(rate * k * 0.01))
        estimate = estimator.step(k * PERIOD, seen(k * PERIOD, P_WB, q), np.zeros(6))
    np.testing.assert_allclose(difference(estimate.q_wb, q), 0.0, atol=1e-4)
    np.testing.assert_allclose(estimate.nu[3:], rate, atol=1e-3)


@pytest.mark.slow
def test_paper_estimator_does_not_make_up_for_delay(body: Body) -> None:
    """The filter treats a picture as current: 50 ms at 0.2 m/s lag by 10 mm."""
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


@pytest.mark.parametrize("before", [READY_AFTER, 50])
def test_paper_estimator_refuses_flips(before: int, body: Body) -> None:
    """From the tag on after which it is ready."""
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    for k in range(before):
        estimator.step(k * PERIOD, seen(k * PERIOD), np.zeros(6))
    flipped = seen(before * PERIOD, P_WB, multiply(Q_WB, exp(np.array([0.8, 0.0, 0.0]))))
    estimate = estimator.step(before * PERIOD, flipped, np.zeros(6))
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


# ---------------------------------------------------------------- joining and parting


def noisy(k: int, rng: np.random.Generator) -> Measured:
    """Measurement in tick `k` of a robot that runs and turns, with tags in two ticks of three."""
    if k % 3 == 2:
        return NOTHING
    q = multiply(Q_WB, exp(np.array([0.0, 0.3, 0.1]) * k * 0.01 + rng.normal(0.0, 0.009, 3)))
    return seen(k * PERIOD, P_WB + np.array([0.1, -0.2, 0.05]) * k * 0.01 + rng.normal(0.0, [0.002, 0.002, 0.004]), q)


def settled(body: Body, rng: np.random.Generator) -> TagOnlyEstimator:
    """The filter after five seconds."""
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    for k in range(500):
        estimator.step(k * PERIOD, noisy(k, rng), np.zeros(6))
    return estimator


def test_paper_estimator_that_goes_on_in_another_estimates_the_same(body: Body) -> None:
    rng = np.random.default_rng(3)
    estimator = settled(body, rng)
    other = TagOnlyEstimator(body, PAPER, PERIOD)
    other.restart(499 * PERIOD, estimator.motion)
    for k in range(500, 600):
        measured = noisy(k, rng)
        stays, goes_on = (e.step(k * PERIOD, measured, np.zeros(6)) for e in (estimator, other))
        for name in ("p_wb", "q_wb", "nu", "sigma_p", "sigma_q"):
            np.testing.assert_allclose(getattr(goes_on, name), getattr(stays, name), atol=1e-10)


@pytest.mark.slow
def test_paper_estimator_of_a_parted_body_hardly_jumps(body: Body) -> None:
    """The uncertainty of the magnets' push is added to the filter's own; a metre in its place makes the filter jump by 0.4 m/s."""
    peaks = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        estimator = settled(body, rng)
        other = TagOnlyEstimator(body, PAPER, PERIOD)
        other.restart(499 * PERIOD, part_of(body, estimator.motion, body))
        after = [other.step(k * PERIOD, noisy(k, rng), np.zeros(6)) for k in range(500, 540)]
        truth_w = np.array([0.1, -0.2, 0.05])
        peaks.append(max(np.abs(Rotation.from_quat(e.q_wb[[1, 2, 3, 0]]).apply(e.nu[:3]) - truth_w).max() for e in after))
    assert np.mean(peaks) < PARTED_SIGMA[2]


def test_paper_estimators_covariance_stands_where_that_of_a_body_belongs(body: Body) -> None:
    """Velocity is in the body's axes: the world's down, which tags measure worst, lies where the robot's attitude puts it."""
    estimator = settled(body, np.random.default_rng(3))
    covariance = estimator.motion.covariance
    assert covariance.shape == (ERRORS, ERRORS)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
    turn = Rotation.from_quat(estimator.q_wb[[1, 2, 3, 0]]).as_matrix()
    velocity_w = turn @ covariance[6:9, 6:9] @ turn.T
    assert np.sqrt(velocity_w.diagonal()) == pytest.approx([0.0143, 0.0143, 0.0169], rel=0.5)
    np.testing.assert_allclose(velocity_w, np.diag(velocity_w.diagonal()), atol=1e-12)
    assert velocity_w[2, 2] > 1.1 * velocity_w[0, 0]
    assert 0.05**2 < covariance[9:12, 9:12].diagonal().max() < 0.2**2 and not covariance[12:].any()


def test_flip_is_no_news_to_the_paper_estimator(body: Body) -> None:
    """The age is that of the newest accepted tag."""
    estimator = TagOnlyEstimator(body, PAPER, PERIOD)
    assert estimator.step(0, seen(0), np.zeros(6)).tag_age_ns == 0
    for k in range(1, 50):
        assert estimator.step(k * PERIOD, seen((k - 3) * PERIOD), np.zeros(6)).tag_age_ns == 3 * PERIOD
    turned = multiply(Q_WB, exp(np.array([0.8, 0.0, 0.0])))
    for k in range(50, 50 + RESET_AFTER - 1):
        estimate = estimator.step(k * PERIOD, seen(k * PERIOD, P_WB, turned), np.zeros(6))
        assert (estimate.rejected, estimate.tag_age_ns) == (k - 49, (k - 46) * PERIOD)
    assert estimator.step(90 * PERIOD, seen(90 * PERIOD, P_WB, turned), np.zeros(6)).tag_age_ns == 0, "begun anew"
