"""The paper's estimator: a constant-velocity Kalman filter on tag poses alone. Replaces `estimator` with `--controller paper`."""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.estimator import READY_AFTER, RESET_AFTER
from firmware_py.core.propagation import ERRORS, STATES, Error, Nominal
from firmware_py.core.rotations import difference, exp, multiply, rotate, rotate_back, to_matrix
from firmware_py.core.topology import Motion
from firmware_py.core.types import NEVER_NS, BodyPose, Estimate, Measured
from firmware_py.description.parameters import Estimation

PAPER_ACCEL_DENSITY = 0.05
"""Acceleration noise of the constant-velocity model, m/s^2/sqrt(Hz); synthetic, the paper gives none."""
PAPER_ALPHA_DENSITY = 0.5
"""The same for angular acceleration, rad/s^2/sqrt(Hz); synthetic."""
PAPER_FLIP_RAD = 0.5
"""Attitude jump beyond which a tag counts as flipped. Any working tag tracker refuses such a tag, and restarts if the jump persists."""
PLACED = np.ix_(np.r_[Error.POSITION, Error.VELOCITY], np.r_[Error.POSITION, Error.VELOCITY])
TURNED = np.ix_(np.r_[Error.ATTITUDE, Error.RATE], np.r_[Error.ATTITUDE, Error.RATE])
"""Indices of position with velocity, and of attitude with rate, in a covariance (28, 28)."""


class TagOnlyEstimator:
    """Constant-velocity Kalman filter on tag poses alone, without delay compensation or disturbance. State: pose, velocity.

    Two filters share F (`_f`) and H (`_h`): one of position and velocity in the world, `_pv_w` (6,), with P and Q in `_pv_covariance` and
    `_pv_noise`; one of the errors of attitude and rate in the body, whose state is zero between its updates.
    """

    fused = ()
    """No pictures to compare pressures with: this filter takes no depth."""

    def __init__(self, body: Body, parameters: Estimation, period_ns: int) -> None:
        from filterpy.kalman import predict, update  # imports scipy.stats: 0.4 s and 45 MB that no other estimator needs

        self._predict, self._update = predict, update
        self._p = parameters
        self._dt = dt = period_ns * 1e-9
        self._f = np.eye(6)
        self._f[:3, 3:] = dt * np.eye(3)
        shape = np.block([[dt**3 / 3 * np.eye(3), dt**2 / 2 * np.eye(3)], [dt**2 / 2 * np.eye(3), dt * np.eye(3)]])
        self._pv_noise = shape * PAPER_ACCEL_DENSITY**2
        self._turn_noise = shape * PAPER_ALPHA_DENSITY**2
        self._h = np.eye(3, 6)
        self._pv_w = np.zeros(6)
        self._pv_covariance = np.eye(6)
        self._turn_covariance = np.eye(6)
        self._q_wb = np.array([1.0, 0.0, 0.0, 0.0])
        self._rate_b = np.zeros(3)
        self._accepted = 0
        self._rejected = self._refused_in_row = self._starts = 0
        self._last_tag_ns = NEVER_NS

    def retune(self, parameters: Estimation) -> None:
        """Applies new noise parameters from the next tick on."""
        self._p = parameters

    @property
    def q_wb(self) -> np.ndarray:
        """(4,) latest attitude."""
        return self._q_wb

    def expected_depth(self, time_ns: int) -> None:
        """No depth: this filter takes none."""

    @property
    def motion(self) -> Motion:
        """Current state and covariance, for a body that docks or undocks. Biases and disturbance, which this filter does not estimate,
        are zero with zero variance.
        """
        x = np.zeros(STATES)
        x[Nominal.POSITION], x[Nominal.ATTITUDE], x[Nominal.NU] = self._pv_w[:3], self._q_wb, self._nu
        covariance = np.zeros((ERRORS, ERRORS))
        covariance[PLACED] = _turned(self._pv_covariance, to_matrix(self._q_wb).T)
        covariance[TURNED] = self._turn_covariance
        return Motion(x, covariance, self._accepted, self._last_tag_ns)

    def restart(self, time_ns: int, motion: Motion) -> Estimate:
        """Restarts from `motion` at `time_ns`; returns the estimate of the same tick."""
        x = motion.x
        self._q_wb = x[Nominal.ATTITUDE].copy()
        self._pv_w = np.concatenate([x[Nominal.POSITION], rotate(self._q_wb, x[Nominal.NU][:3].copy())])
        self._rate_b = x[Nominal.RATE].copy()
        self._pv_covariance = _turned(motion.covariance[PLACED], to_matrix(self._q_wb))
        self._turn_covariance = motion.covariance[TURNED].copy()
        self._accepted, self._last_tag_ns = motion.accepted, motion.tag_ns
        self._refused_in_row = 0
        return self._estimate(time_ns)

    def step(self, time_ns: int, measured: Measured, tau: np.ndarray) -> Estimate:
        """Returns the estimate at `time_ns` from the tags of `measured` alone."""
        if self._accepted:
            self._pv_w, self._pv_covariance = self._predict(self._pv_w, self._pv_covariance, self._f, self._pv_noise)
            self._q_wb = multiply(self._q_wb, exp(self._rate_b * self._dt))
            _, self._turn_covariance = self._predict(np.zeros(6), self._turn_covariance, self._f, self._turn_noise)
        for pose in measured.tags:
            self._fuse(pose)
        return self._estimate(time_ns)

    @property
    def _nu(self) -> np.ndarray:
        """(6,) velocity and angular rate, body frame."""
        return np.concatenate([rotate_back(self._q_wb, self._pv_w[3:].copy()), self._rate_b])

    def _estimate(self, time_ns: int) -> Estimate:
        return Estimate(
            p_wb=self._pv_w[:3].copy(),
            q_wb=self._q_wb.copy(),
            nu=self._nu,
            force_w=np.zeros(3),
            moment_b=np.zeros(3),
            sigma_p=np.sqrt(self._pv_covariance.diagonal()[:3]),
            sigma_q=np.sqrt(self._turn_covariance.diagonal()[:3]),
            tag_age_ns=time_ns - self._last_tag_ns,
            nis=math.nan,
            nis_dof=0,
            rejected=self._rejected,
            ready=self._accepted >= READY_AFTER,
            starts=self._starts,
        )

    def _start(self, p_wb: np.ndarray, q_wb: np.ndarray, capture_ns: int) -> None:
        self._starts += 1
        self._pv_w, self._q_wb, self._rate_b = np.concatenate([p_wb, np.zeros(3)]), q_wb, np.zeros(3)
        self._pv_covariance, self._turn_covariance = np.eye(6), np.eye(6)
        self._accepted, self._refused_in_row = 1, 0
        self._last_tag_ns = capture_ns

    def _fuse(self, pose: BodyPose) -> None:
        p_wb = pose.p_wt - rotate(pose.q_wb, pose.lever_b)
        if not self._accepted:
            self._start(p_wb, pose.q_wb, pose.capture_ns)
            return
        turn = difference(pose.q_wb, self._q_wb)
        if float(np.linalg.norm(turn)) > PAPER_FLIP_RAD and self._accepted >= READY_AFTER:
            self._rejected += 1
            self._refused_in_row += 1
            if self._refused_in_row >= RESET_AFTER:
                self._start(p_wb, pose.q_wb, pose.capture_ns)
            return
        self._refused_in_row = 0
        p = self._p
        r_position, r_attitude = np.diag(np.array([p.tag_sigma_m, p.tag_sigma_m, p.tag_sigma_axis_m]) ** 2), np.eye(3) * p.tag_sigma_rad**2
        self._pv_w, self._pv_covariance = self._update(self._pv_w, self._pv_covariance, p_wb, r_position, self._h)
        error, self._turn_covariance = self._update(np.zeros(6), self._turn_covariance, turn, r_attitude, self._h)
        self._q_wb = multiply(self._q_wb, exp(error[:3].copy()))
        self._rate_b = self._rate_b + error[3:]
        self._accepted += 1
        self._last_tag_ns = pose.capture_ns


def _turned(covariance: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Returns the (6, 6) covariance of position and velocity with the velocity rotated into other axes by `turn` (3, 3)."""
    whole = np.eye(6)
    whole[3:, 3:] = turn
    return np.asarray(whole @ covariance @ whole.T)
