"""The Kalman filter of `estimator`: moves beliefs on through the stored measurements, and fuses tags and assumptions into them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from firmware_py.core import observation
from firmware_py.core.body import CRUISE_M_S, Body
from firmware_py.core.history import History
from firmware_py.core.propagation import ERRORS, STATES, Error, Nominal
from firmware_py.core.rotations import rotate
from firmware_py.core.topology import down_of
from firmware_py.core.types import BodyPose
from firmware_py.description.parameters import Estimation

STILL_DENSITY = 0.0003
"""Noise density of the zero-velocity pseudo-measurement that is fused while adrift, m^2/s: 0.17 m/s in a tick at 100 Hz."""
NORTH_DENSITY = 1e-4
"""Noise density of the heading pseudo-measurement before the first tag, rad^2 s. Until then the believed heading defines north, so it is
known by definition. Without this the filter fitted the heading to noise: a bump turned the estimate by a third of a circle."""
UNDER_WAY_S = 0.01
"""Sample period for which `accel_under_way` gives the error of one sample. A wrong mass causes the same error in all samples within that
time, so that more samples carry no more information."""
INITIAL_SIGMA = (0.02, 0.05, 0.2, 0.3, 0.02, 0.1, 0.1, 0.3, 0.1)
"""Initial sigma of position m, attitude rad, velocity m/s, rate rad/s, gyro bias, accelerometer bias, disturbance force over mass,
disturbance moment over inertia, depth bias."""


class Belief(NamedTuple):
    """State (32,) and covariance (28, 28) at a time, in the order of core.propagation."""

    x: np.ndarray
    covariance: np.ndarray
    time_ns: int


class KalmanFilter:
    """The filter of one body with its noise; the state is the caller's."""

    def __init__(self, body: Body, parameters: Estimation, history: History) -> None:
        self._body, self._history = body, history
        self._plant = body.plant
        self._dt = history.period_ns * 1e-9
        self.retune(parameters)

    def retune(self, parameters: Estimation) -> None:
        """Applies new noise parameters."""
        p = self._p = parameters
        self._density = process_noise(p, self._body)
        drag_walk = p.current_walk * self._body.drag.cruise_slope / CRUISE_M_S
        reach_m = self._body.reach_m
        accel = p.accel_under_way * math.sqrt(UNDER_WAY_S / self._dt)
        self._under_way = np.array([drag_walk, drag_walk * reach_m, p.alpha_turning, accel, accel * reach_m])
        self._inertial_sigma = np.array([p.gyro_sigma, p.accel_sigma, p.depth_sigma_m])
        self._tag_variance = np.repeat([p.tag_sigma_m, p.tag_sigma_axis_m, p.tag_sigma_rad], [2, 1, 3]) ** 2

    def started(self, pose: BodyPose) -> Belief:
        """Returns the belief in a body at rest at `pose`, with INITIAL_SIGMA."""
        x = np.zeros(STATES)
        x[Nominal.ATTITUDE] = pose.q_wb
        x[Nominal.POSITION] = pose.p_wt - rotate(pose.q_wb, pose.lever_b)
        x[Nominal.DOWN] = down_of(x)
        inertia = np.diag(self._body.mass)
        sigma = np.r_[np.repeat(np.array(INITIAL_SIGMA), [3, 3, 3, 3, 3, 3, 3, 3, 1]), self._body.righting_sigma]
        sigma[18:24] *= inertia
        return Belief(x, np.diag(sigma**2), pose.capture_ns)

    def advanced(self, start: Belief, to_ns: int) -> Belief:
        """Returns the belief advanced to `to_ns`, with the inertial and depth measurements on the way fused."""
        if to_ns <= start.time_ns:
            return start
        index = self._history.first_after(start.time_ns)
        first_ns = self._history.time_of(index)
        periods, rest_ns = divmod(to_ns - first_ns, self._history.period_ns)
        count = periods + 1  # samples up to `to_ns`
        if count == 0:  # the first is later
            rest_ns = to_ns - start.time_ns
        x, covariance = observation.advance(
            start.x, start.covariance, *self._history.since(index), (first_ns - start.time_ns) * 1e-9, count, self._dt, rest_ns * 1e-9,
            self._density, self._under_way, self._inertial_sigma, *self._plant,
        )  # fmt: skip
        return Belief(x, covariance, to_ns)

    def with_tag(self, at: Belief, pose: BodyPose, gate: float) -> tuple[float, Belief]:
        """Returns the normalised innovation squared of a picture, and the belief with the picture fused if that is within `gate`."""
        seen = (pose.p_wt, pose.lever_b, pose.q_wb, self._tag_variance, pose.tags)
        nis, x, covariance = observation.fuse_tag(at.x, at.covariance, *seen, gate)
        return nis, Belief(x, covariance, at.time_ns)

    def stilled(self, at: Belief, axes: int, north: bool) -> Belief:
        """Returns the belief with zero velocity over ground fused, along the first `axes` axes of the world, and the heading if `north`."""
        north_variance = NORTH_DENSITY / self._dt if north else math.inf
        x, covariance = observation.fuse_stillness(at.x, at.covariance, STILL_DENSITY / self._dt, axes, north_variance)
        return Belief(x, covariance, at.time_ns)

    def carried(self, start: Belief, time_ns: int) -> tuple[np.ndarray, np.ndarray, bool]:
        """Returns the state carried to `time_ns` by wrenches and gyro, sigma (6,) of its pose, and whether state and sigma are sound."""
        index = self._history.first_after(start.time_ns)
        taus, gyros, _ = self._history.since(index)
        until_first = (self._history.time_of(index) - start.time_ns) * 1e-9
        lag, rate_variance = (time_ns - start.time_ns) * 1e-9, self._p.gyro_sigma**2 * self._dt
        carried: tuple[np.ndarray, np.ndarray, bool] = observation.carried(
            start.x, start.covariance, taus, gyros, self._dt, until_first, self._density, lag, rate_variance, *self._plant
        )
        return carried


def process_noise(p: Estimation, body: Body) -> np.ndarray:
    """Spectral density (28,) of the process noise of a body at rest, per second."""
    inertia = np.diag(body.mass)
    density = np.zeros(ERRORS)
    density[Error.VELOCITY] = p.accel_process
    density[Error.RATE] = p.alpha_process
    density[Error.GYRO_BIAS] = p.gyro_bias_walk
    density[Error.ACCEL_BIAS] = p.accel_bias_walk
    density[Error.FORCE] = p.force_walk * inertia[:3]
    density[Error.MOMENT] = p.moment_walk * inertia[3:]
    density[Error.DEPTH_BIAS] = p.depth_bias_walk
    density[Error.RIGHTING] = p.righting_walk * body.righting_sigma
    return density**2
