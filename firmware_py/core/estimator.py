"""Stage 2 of a tick: an error-state Kalman filter of pose, velocity, sensor biases and one lumped disturbance.

The filter stands at its anchor: the time of the newest tag picture, or half a second ago when none came. Everything is fused once, in the
order in which it happened; from the anchor the state is carried to now through the stored thruster wrenches and gyro readings.

The body moves by the model of `propagation`, and the accelerometer measures what that model left out (`observation.fuse_inertial`): so the
velocity follows the robot and not the command, which is worth 15 degrees of phase (docs/tuning.md).
"""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core import observation
from firmware_py.core.body import CRUISE_M_S, Body
from firmware_py.core.history import WINDOW_S, History
from firmware_py.core.propagation import ERRORS, STATES
from firmware_py.core.rotations import rotate
from firmware_py.core.topology import Motion
from firmware_py.core.types import BodyPose, Estimate, Measured
from firmware_py.description.parameters import Estimation

NEVER_NS = 1 << 60
"""Age of the last tag before the first one."""
READY_AFTER = 10
"""Tag observations to accept before the pose is believed."""
UNKNOWN_SIGMA = np.full(6, 1e3)
"""Of the pose before the first tag, m and rad."""
RESET_AFTER = 30
"""Observations refused one after the other (half a second) until the filter believes them and not itself."""
INITIAL_SIGMA = (0.02, 0.05, 0.2, 0.3, 0.02, 0.1, 0.1, 0.3, 0.1)
"""Of position m, attitude rad, velocity m/s, rate rad/s, gyro bias, accelerometer bias, disturbance over mass, over inertia, depth bias."""


class Estimator:
    """One body's estimator. Same inputs, same outputs; time comes in."""

    def __init__(self, body: Body, parameters: Estimation, period_ns: int) -> None:
        self._body = body
        self._p = parameters
        self._plant = (
            body.mass, body.mass_inv, body.righting, body.drag.nodes, body.drag.rotational, body.drag.linear,
        )  # fmt: skip
        self._dt = period_ns * 1e-9
        self._history = History(period_ns)
        self._forget()
        self._covariance = np.eye(ERRORS)
        self.retune(parameters)
        self._anchor_ns = 0
        self._refused_in_row = 0
        self._rejected = 0
        self._last_tag_ns = -NEVER_NS
        self._nis = math.nan
        self._nis_dof = 0

    def retune(self, parameters: Estimation) -> None:
        """Takes other noise figures from the next tick on; the estimate stays."""
        p = self._p = parameters
        self._density = self._process_noise()
        drag_walk = p.current_walk * self._body.drag.cruise_slope / CRUISE_M_S
        reach_m = self._body.reach_m
        self._under_way = np.array([drag_walk, drag_walk * reach_m, p.alpha_turning, p.accel_under_way, p.accel_under_way * reach_m])
        self._inertial_sigma = np.array([p.gyro_sigma, p.accel_sigma, p.depth_sigma_m])
        self._tag_variance = np.repeat([p.tag_sigma_m, p.tag_sigma_axis_m, p.tag_sigma_rad], [2, 1, 3]) ** 2

    @property
    def q_wb(self) -> np.ndarray:
        """(4,) latest attitude."""
        return np.ascontiguousarray(self._now[3:7])

    def step(self, time_ns: int, measured: Measured, tau: np.ndarray) -> Estimate:
        """The estimate at `time_ns`.

        Args:
            time_ns: time of this tick.
            measured: fused sensors.
            tau: (6,) mean thruster wrench since the previous tick, body frame.
        """
        self._nis, self._nis_dof = math.nan, 0
        if self._history.newest >= 0 and time_ns - self._history.newest_ns > int(WINDOW_S * 1e9):
            self._accepted = 0  # the process stood still: what is remembered joins on to nothing
        self._history.push(time_ns, tau, measured.gyro, measured.accel, measured.depth_m)
        for pose in measured.tags:
            self._take(pose)
        if self._accepted:
            self._advance(time_ns - int(WINDOW_S * 1e9))
        return self._estimate(time_ns)

    @property
    def motion(self) -> Motion:
        """State and covariance now, for a body that joins or parts."""
        return Motion(self._now.copy(), self._covariance.copy(), self._accepted, self._last_tag_ns)

    def restart(self, time_ns: int, motion: Motion) -> Estimate:
        """Goes on from `motion` at `time_ns`, as after a dock; returns the estimate of the same tick."""
        self._history.push(time_ns, np.zeros(6), None, None, None)
        self._x, self._covariance = motion.x.copy(), motion.covariance.copy()
        self._now = self._x
        self._anchor_ns, self._last_tag_ns = time_ns, motion.tag_ns
        self._accepted, self._refused_in_row = motion.accepted, 0
        self._nis, self._nis_dof = math.nan, 0
        return self._estimate(time_ns)

    # ------------------------------------------------------------ fusion at the anchor

    def _take(self, pose: BodyPose) -> None:
        if not observation.are_finite(pose.p_wt, pose.q_wb):
            self._rejected += 1
        elif not self._accepted:
            self._start(pose)
        elif pose.capture_ns >= self._anchor_ns:
            self._advance(min(pose.capture_ns, self._history.newest_ns))
            self._fuse_tag(pose)
        else:
            self._rejected += 1

    def _start(self, pose: BodyPose) -> None:
        self._x = np.zeros(STATES)
        self._x[3:7] = pose.q_wb
        self._x[:3] = pose.p_wt - rotate(pose.q_wb, pose.lever_b)
        inertia = np.diag(self._body.mass)
        sigma = np.repeat(np.array(INITIAL_SIGMA), [3, 3, 3, 3, 3, 3, 3, 3, 1])
        sigma[18:24] *= inertia
        self._covariance = np.diag(sigma**2)
        self._anchor_ns = pose.capture_ns
        self._last_tag_ns = pose.capture_ns
        self._accepted, self._refused_in_row = 1, 0
        self._now = self._x

    def _advance(self, to_ns: int) -> None:
        """Moves the filter to `to_ns`, fusing the inertial and depth measurements on the way."""
        if to_ns <= self._anchor_ns:
            return
        index = self._history.first_after(self._anchor_ns)
        first_ns = self._history.time_of(index)
        count, rest_ns = divmod(to_ns - first_ns, self._history.period_ns)
        count += 1
        if count == 0:
            rest_ns = to_ns - self._anchor_ns
        self._x, self._covariance = observation.advance(
            self._x, self._covariance, *self._history.since(index), (first_ns - self._anchor_ns) * 1e-9, count, self._dt, rest_ns * 1e-9,
            self._density, self._under_way, self._inertial_sigma, *self._plant,
        )  # fmt: skip
        self._anchor_ns = to_ns

    def _fuse_tag(self, pose: BodyPose) -> None:
        variance, gate = self._tag_variance / pose.tags, self._p.tag_gate**2
        nis, self._x, self._covariance = observation.fuse_tag(
            self._x, self._covariance, pose.p_wt, pose.lever_b, pose.q_wb, variance, gate
        )
        if not nis <= gate:  # also when it is NaN
            self._refuse(pose)
            return
        self._nis = nis if math.isnan(self._nis) else self._nis + nis
        self._nis_dof += 6
        self._accepted += 1
        self._refused_in_row = 0
        self._last_tag_ns = pose.capture_ns

    def _refuse(self, pose: BodyPose) -> None:
        self._rejected += 1
        self._refused_in_row += 1
        if self._refused_in_row >= RESET_AFTER:
            self._start(pose)

    # ------------------------------------------------------------ from the anchor to now

    def _carry(self, time_ns: int) -> tuple[np.ndarray, bool]:
        """Brings the state to `time_ns`; returns sigma (6,) of its pose, and whether all of that is sound."""
        index = self._history.first_after(self._anchor_ns)
        taus, gyros, _ = self._history.since(index)
        until_first = (self._history.time_of(index) - self._anchor_ns) * 1e-9
        lag, rate_variance = (time_ns - self._anchor_ns) * 1e-9, self._p.gyro_sigma**2 * self._dt
        self._now, sigma, sound = observation.carried(
            self._x, self._covariance, taus, gyros, self._dt, until_first, self._density, lag, rate_variance, *self._plant
        )
        return sigma, sound

    def _forget(self) -> None:
        """Nothing is known: the filter begins anew with the next tag."""
        self._accepted = 0
        self._x = self._now = np.eye(1, STATES, 3)[0]

    def _estimate(self, time_ns: int) -> Estimate:
        sigma, sound = self._carry(time_ns) if self._accepted else (UNKNOWN_SIGMA, True)
        if not sound:  # sensors have lied
            self._forget()
            sigma = UNKNOWN_SIGMA
        x = self._now
        return Estimate(
            p_wb=x[:3].copy(),
            q_wb=x[3:7].copy(),
            nu=x[7:13].copy(),
            force_w=x[19:22].copy(),
            moment_b=x[22:25].copy(),
            sigma_p=sigma[:3],
            sigma_q=sigma[3:],
            tag_age_ns=time_ns - self._last_tag_ns,
            nis=self._nis,
            nis_dof=self._nis_dof,
            rejected=self._rejected,
            ready=self._accepted >= READY_AFTER,
        )

    def _process_noise(self) -> np.ndarray:
        """(25,) spectral density of the process noise of a body at rest, per second."""
        p = self._p
        inertia = np.diag(self._body.mass)
        density = np.zeros(ERRORS)
        density[6:9] = p.accel_process
        density[9:12] = p.alpha_process
        density[12:15] = p.gyro_bias_walk
        density[15:18] = p.accel_bias_walk
        density[18:21] = p.force_walk * inertia[:3]
        density[21:24] = p.moment_walk * inertia[3:]
        density[24] = p.depth_bias_walk
        return density**2
