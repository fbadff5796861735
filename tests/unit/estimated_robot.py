"""A robot at rest, its sensor readings, and its estimator."""

import numpy as np
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body
from firmware_py.core.estimator import Estimator
from firmware_py.core.rotations import difference, from_euler
from firmware_py.core.types import BodyPose, Estimate, Measured
from firmware_py.description.parameters import Estimation

PERIOD = 10_000_000
P = Estimation()
P_WB = np.array([1.0, -0.5, 0.8])
Q_WB = from_euler(0.2, -0.4, 1.0)
LEVER = np.array([0.0, 0.0, -0.105])
NOTHING = Measured(None, None, None, [])
DELAY_TICKS = 5


def world(q_wb: np.ndarray) -> Rotation:
    return Rotation.from_quat(q_wb[[1, 2, 3, 0]])


def holding(body: Body, q_wb: np.ndarray = Q_WB) -> np.ndarray:
    """The thruster wrench that holds the attitude against buoyancy."""
    return np.r_[0.0, 0.0, 0.0, -np.cross(body.righting, world(q_wb).inv().apply([0.0, 0.0, -1.0]))]


def tag(capture_ns: int, p_wb: np.ndarray = P_WB, q_wb: np.ndarray = Q_WB) -> BodyPose:
    return BodyPose(capture_ns, p_wb + world(q_wb).apply(LEVER), LEVER, q_wb, 1)


def sensors(p_wb: np.ndarray = P_WB, q_wb: np.ndarray = Q_WB, *tags: BodyPose) -> Measured:
    """Gyro, accelerometer and depth of a robot at rest."""
    return Measured(np.zeros(3), world(q_wb).inv().apply([0.0, 0.0, -9.80665]), float(p_wb[2]), list(tags))


class Robot:
    """A robot at rest whose estimator is stepped tick by tick; in `rest` the tag is seen every second tick and 50 ms late."""

    def __init__(self, body: Body, parameters: Estimation = P) -> None:
        self.estimator = Estimator(body, parameters, PERIOD)
        self.tau = holding(body)
        self.tick = 0

    @property
    def time_ns(self) -> int:
        return self.tick * PERIOD

    def step(self, measured: Measured) -> Estimate:
        estimate = self.estimator.step(self.time_ns, measured, self.tau)
        self.tick += 1
        return estimate

    def rest(self, ticks: int) -> Estimate:
        for _ in range(ticks):
            seen = [tag(self.time_ns - DELAY_TICKS * PERIOD)] if self.tick % 2 else []
            estimate = self.step(sensors(P_WB, Q_WB, *seen))
        return estimate


def assert_rests(estimate: Estimate, p_wb: np.ndarray = P_WB, tolerance_m: float = 1e-3) -> None:
    np.testing.assert_allclose(estimate.p_wb, p_wb, atol=tolerance_m)
    np.testing.assert_allclose(difference(estimate.q_wb, Q_WB), 0.0, atol=5e-3)
