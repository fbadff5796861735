"""Stage 2 of a tick: an error-state Kalman filter of pose, velocity, sensor biases, one lumped disturbance, and what turns a body upright.

The filter stands at its anchor: the time of the newest tag picture, or half a second ago when none came. Everything is fused once, in the
order in which it happened; from the anchor the state is carried to now through the stored thruster wrenches and gyro readings. While no
tag comes, what would be half a second old is not waited for: a head runs on ahead of the anchor, and the state is carried from there.

Until the first tags come it stands upright by gravity (`alignment`): attitude but for the heading, and depth. Without any for long it is
adrift: it makes up that it stands still, and believes only tags that tell the same ten times.

The body moves by the model of `propagation`, and the accelerometer measures what that model left out (`observation.fuse_inertial`): so the
velocity follows the robot and not the command, which is worth 15 degrees of phase (docs/estimator.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from firmware_py.core import observation
from firmware_py.core.alignment import FirstSight, upright
from firmware_py.core.body import CRUISE_M_S, Body
from firmware_py.core.history import WINDOW_NS, History
from firmware_py.core.propagation import ERRORS, STATES
from firmware_py.core.rigid_body import restoring_moment
from firmware_py.core.rotations import heading, multiply, rotate, to_matrix
from firmware_py.core.topology import Motion, down_of
from firmware_py.core.types import NEVER_NS, BodyPose, Estimate, Measured
from firmware_py.description.parameters import Estimation

READY_AFTER = 10
"""Tag observations to accept before the pose is believed."""
UNKNOWN_SIGMA = np.full(6, 1e3)
"""Of the pose before the first tag, m and rad."""
UPRIGHT_AFTER_S = 1.0
"""Without a tag, until gravity has to do: its mean over the last `FELT_NS`."""
FELT_NS = 200_000_000
BLIND_NS = 250_000_000
"""Without a tag, until the head leaves the anchor: fifteen pictures. Without a depth, until none tells."""
CATCH_UP = 4
"""Samples that the head takes in a tick at most: it is with the present after half a second."""
ADRIFT_NS = 10_000_000_000
"""Without a tag, until nobody knows how the body moves over ground. What pushes it and what the water takes of its speed are the same to
the accelerometer: the speed that is believed would grow, to 15 m/s within a minute of half stick, and spoil the tilt."""
STILL_DENSITY = 0.0003
"""Of the noise of the speed that is made up then, m^2/s: 0.17 m/s in a tick at 100 Hz."""
NORTH_DENSITY = 1e-4
"""Of the noise of the heading before the first tag, rad^2 s: it says where north is, and so is known. What the filter else took for
knowledge of it was noise: a bump turned the belief by a third of a circle."""
KEPT, MOVING, GYROS = np.r_[10:19, 21:25, 26:29], slice(6, 9), slice(12, 15)
"""What is kept when a body that was adrift is placed anew. KEPT, of the state: rates, biases, vertical force, moment and righting, which
do not depend on the heading. Of the error: MOVING is the velocity, which becomes unsure; GYROS are the gyro biases, which stay as sure as
they were: with a larger variance the filter would take the next bump, which no model knows, for a bias."""
WAY_S = 0.01
"""For which `accel_under_way` tells what a sample errs. A wrong mass errs alike in all samples of that time: more of them tell no more."""
LEARNT, LEARNT_ERRORS, LEARNT_SIGMAS = np.r_[22:25, 26:29], np.r_[21:24, 25:28], 5.0
"""Where moment and righting stand in the state and in its error, and within how many initial sigmas they are kept when the filter begins
anew because it refused too many tags. A place that was wrong has not spoilt them; but a value that a fresh filter would not believe may be
the very reason why tags were refused. Biases and vertical force are not kept: while tags are refused they take up all that does not fit."""
SPEED_SIGMA = 0.5
"""Of one that was adrift, when tags come, m/s: what a module swims at half stick."""
FELT_LIMIT_NS = 2_000_000_000
"""Without an accelerometer, until one that is adrift does not know its attitude either: four times what the fail-safe `imu_lost` waits."""
RESET_AFTER = 30
"""Observations refused one after the other (half a second) until the filter believes them and not itself."""
INITIAL_SIGMA = (0.02, 0.05, 0.2, 0.3, 0.02, 0.1, 0.1, 0.3, 0.1)
"""Of position m, attitude rad, velocity m/s, rate rad/s, gyro bias, accelerometer bias, disturbance over mass, over inertia, depth bias."""


class Belief(NamedTuple):
    """State (32,) and covariance (28, 28) at a time, as core.propagation orders them."""

    x: np.ndarray
    covariance: np.ndarray
    time_ns: int


class Estimator:
    """One body's estimator. Same inputs, same outputs; time comes in."""

    def __init__(self, body: Body, parameters: Estimation, period_ns: int) -> None:
        self._body = body
        self._plant = body.plant
        self._dt = period_ns * 1e-9
        self._history = History(period_ns)
        self._now = np.eye(1, STATES, 3)[0]
        self._anchor: Belief
        self._head: Belief
        self._forget()
        self.retune(parameters)
        self._refused_in_row = 0
        self._rejected = 0
        self._last_tag_ns, self._taken_ns = NEVER_NS, 0
        self._first_sight, self._felt_ns, self._depth_ns = FirstSight(), 0, 0
        self._nis = math.nan
        self._nis_dof = 0

    def retune(self, parameters: Estimation) -> None:
        """Takes other noise figures from the next tick on; the estimate stays."""
        p = self._p = parameters
        self._density = self._process_noise()
        drag_walk = p.current_walk * self._body.drag.cruise_slope / CRUISE_M_S
        reach_m = self._body.reach_m
        accel_way = p.accel_under_way * math.sqrt(WAY_S / self._dt)
        self._under_way = np.array([
            drag_walk, drag_walk * reach_m, p.alpha_turning, accel_way, accel_way * reach_m,
        ])  # fmt: skip
        self._inertial_sigma = np.array([p.gyro_sigma, p.accel_sigma, p.depth_sigma_m])
        self._tag_variance = np.repeat([p.tag_sigma_m, p.tag_sigma_axis_m, p.tag_sigma_rad], [2, 1, 3]) ** 2

    @property
    def q_wb(self) -> np.ndarray:
        """(4,) latest attitude."""
        return np.asarray(self._now[3:7])

    def step(self, time_ns: int, measured: Measured, tau: np.ndarray) -> Estimate:
        """The estimate at `time_ns`.

        Args:
            time_ns: time of this tick.
            measured: fused sensors.
            tau: (6,) mean thruster wrench since the previous tick, body frame.
        """
        self._nis, self._nis_dof = math.nan, 0
        if self._history.newest >= 0 and time_ns - self._history.newest_ns > WINDOW_NS:
            self._accepted = self._waited = 0  # the process stood still: what is remembered joins on to nothing
        self._history.push(time_ns, tau, measured.gyro, measured.accel, measured.depth_m)
        self._felt_ns = time_ns if measured.accel is not None else self._felt_ns
        self._depth_ns = time_ns if measured.depth_m is not None else self._depth_ns
        for pose in measured.tags:
            self._take(pose)
        if self._is_lost(time_ns):
            self._forget()
            self._waited = round(UPRIGHT_AFTER_S / self._dt)  # it has done so already
        if not self._accepted:
            self._wait(time_ns)
        if self._accepted:
            self._anchor = self._advanced(self._anchor, time_ns - WINDOW_NS)
            self._lead(time_ns)
            if self._is_adrift:
                self._anchor, self._head = self._stilled(self._anchor), self._stilled(self._head)
        return self._estimate(time_ns)

    @property
    def motion(self) -> Motion:
        """State and covariance now, for a body that joins or parts."""
        return Motion(self._now.copy(), self._head.covariance.copy(), self._accepted, self._last_tag_ns)

    def restart(self, time_ns: int, motion: Motion) -> Estimate:
        """Goes on from `motion` at `time_ns`, as after a dock; returns the estimate of the same tick."""
        self._history.push(time_ns, np.zeros(6), None, None, None)
        self._anchor = self._head = Belief(motion.x.copy(), motion.covariance.copy(), time_ns)
        self._now = self._anchor.x
        self._felt_ns = self._depth_ns = time_ns
        self._last_tag_ns, self._taken_ns = motion.tag_ns, time_ns
        self._accepted, self._refused_in_row = motion.accepted, 0
        self._nis, self._nis_dof = math.nan, 0
        return self._estimate(time_ns)

    # ------------------------------------------------------------ fusion at the anchor

    def _take(self, pose: BodyPose) -> None:
        if not observation.are_finite(pose.p_wt, pose.q_wb):
            self._rejected += 1
        elif not self._accepted:
            self._start(pose)
        elif pose.capture_ns >= self._anchor.time_ns:
            self._anchor = self._advanced(self._anchor, min(pose.capture_ns, self._history.newest_ns))
            if self._is_adrift:
                self._place(pose)
            else:
                self._fuse_tag(pose)
        else:
            self._rejected += 1

    def _start(self, pose: BodyPose) -> None:
        x = np.zeros(STATES)
        x[3:7] = pose.q_wb
        x[:3] = pose.p_wt - rotate(pose.q_wb, pose.lever_b)
        x[29:] = down_of(x)
        inertia = np.diag(self._body.mass)
        sigma = np.r_[np.repeat(np.array(INITIAL_SIGMA), [3, 3, 3, 3, 3, 3, 3, 3, 1]), self._body.righting_sigma]
        sigma[18:24] *= inertia
        self._anchor = self._head = Belief(x, np.diag(sigma**2), pose.capture_ns)
        self._last_tag_ns, self._taken_ns = pose.capture_ns, self._history.newest_ns
        self._accepted, self._refused_in_row = 1, 0
        self._now = x

    def _wait(self, time_ns: int) -> None:
        """For a tag; after a second without any the body stands upright by gravity, where and as it was last believed to head."""
        self._waited += 1
        if self._waited * self._dt <= UPRIGHT_AFTER_S:
            return
        _, gyros, others = self._history.since(self._history.first_after(time_ns - FELT_NS))
        tilt = upright(gyros, others[:, :3])
        if tilt is None:
            return
        depths = others[~np.isnan(others[:, 3]), 3]
        place = np.r_[self._now[:2], depths.mean() if len(depths) else self._now[2]]
        self._start(BodyPose(time_ns, place, np.zeros(3), multiply(heading(self._now[3:7]), tilt), 1.0))
        self._anchor.covariance[2, 2] = INITIAL_SIGMA[-1] ** 2 if len(depths) else UNKNOWN_SIGMA[2] ** 2
        self._accepted, self._last_tag_ns = READY_AFTER, NEVER_NS

    @property
    def _has_north(self) -> bool:
        """Whether a tag has told the heading."""
        return self._last_tag_ns != NEVER_NS

    @property
    def _is_adrift(self) -> bool:
        """Whether tags have told nothing for long, or never."""
        return self._history.newest_ns - self._last_tag_ns > ADRIFT_NS

    def _is_lost(self, time_ns: int) -> bool:
        """Whether what is believed rests on too little: a few tags that no more came after, or nothing but a gyro for long."""
        few = self._accepted < READY_AFTER and time_ns - self._taken_ns > UPRIGHT_AFTER_S * 1e9
        borne_out_ns = max(self._felt_ns, self._last_tag_ns + ADRIFT_NS)
        return self._accepted > 0 and (few or time_ns - borne_out_ns > FELT_LIMIT_NS)

    def _stilled(self, at: Belief) -> Belief:
        """It is made up that the body stands still over ground, more or less (ADRIFT_NS); ArduPilot's EKF3 does the like without aiding.
        Up and down only where no depth tells.
        """
        axes = 2 if self._history.newest_ns - self._depth_ns < BLIND_NS else 3
        north = math.inf if self._has_north else NORTH_DENSITY / self._dt
        x, covariance = observation.fuse_stillness(at.x, at.covariance, STILL_DENSITY / self._dt, axes, north)
        return Belief(x, covariance, at.time_ns)

    def _place(self, pose: BodyPose) -> None:
        """The first tags for long say where the body is; what it knows of its turning and its sensors stays."""
        if not self._first_sight.agrees(pose, self._anchor.x[:3], self._anchor.x[3:7]):
            self._refuse(pose)
            return
        self._refused_in_row = 0
        if self._first_sight.count >= READY_AFTER:
            before, had_north = self._anchor, self._has_north
            self._start(pose)
            self._anchor.x[KEPT], self._accepted = before.x[KEPT], READY_AFTER
            self._anchor.covariance[MOVING, MOVING] = SPEED_SIGMA**2 * np.eye(3)
            if had_north:  # one that made its heading up is too sure of them
                self._anchor.covariance[GYROS, GYROS] = before.covariance[GYROS, GYROS]

    def _advanced(self, start: Belief, to_ns: int) -> Belief:
        """The filter at `to_ns`, the inertial and depth measurements on the way fused."""
        if to_ns <= start.time_ns:
            return start
        index = self._history.first_after(start.time_ns)
        first_ns = self._history.time_of(index)
        count, rest_ns = divmod(to_ns - first_ns, self._history.period_ns)
        count += 1
        if count == 0:
            rest_ns = to_ns - start.time_ns
        x, covariance = observation.advance(
            start.x, start.covariance, *self._history.since(index), (first_ns - start.time_ns) * 1e-9, count, self._dt, rest_ns * 1e-9,
            self._density, self._under_way, self._inertial_sigma, *self._plant,
        )  # fmt: skip
        return Belief(x, covariance, to_ns)

    def _fuse_tag(self, pose: BodyPose) -> None:
        gate, at = self._p.tag_gate**2, self._anchor
        seen = (pose.p_wt, pose.lever_b, pose.q_wb, self._tag_variance, pose.tags)
        nis, x, covariance = observation.fuse_tag(at.x, at.covariance, *seen, gate)
        self._anchor = Belief(x, covariance, at.time_ns)
        if not nis <= gate:  # also when it is NaN
            self._refuse(pose)
            return
        self._nis = nis if math.isnan(self._nis) else self._nis + nis
        self._nis_dof += 6
        self._accepted += 1
        self._refused_in_row = 0
        self._last_tag_ns, self._taken_ns = pose.capture_ns, self._history.newest_ns

    def _refuse(self, pose: BodyPose) -> None:
        self._rejected += 1
        self._refused_in_row += 1
        if self._refused_in_row >= RESET_AFTER:
            learnt = self._anchor.x[LEARNT]
            self._start(pose)
            sigma = np.sqrt(np.diag(self._anchor.covariance)[LEARNT_ERRORS])
            self._anchor.x[LEARNT] = np.where(np.abs(learnt) <= LEARNT_SIGMAS * sigma, learnt, 0.0)

    # ------------------------------------------------------------ from the anchor to now

    def _lead(self, time_ns: int) -> None:
        """Moves the head: it is the anchor while tags come, and else runs on to the sample before the newest."""
        if time_ns - self._taken_ns < BLIND_NS:
            self._head = self._anchor
            return
        start = max(self._head, self._anchor, key=lambda belief: belief.time_ns)
        period_ns = self._history.period_ns
        self._head = self._advanced(start, min(time_ns - period_ns, start.time_ns + CATCH_UP * period_ns))

    def _carry(self, time_ns: int) -> tuple[np.ndarray, bool]:
        """Brings the state to `time_ns`; returns sigma (6,) of its pose, and whether all of that is sound."""
        head = self._head
        index = self._history.first_after(head.time_ns)
        taus, gyros, _ = self._history.since(index)
        until_first = (self._history.time_of(index) - head.time_ns) * 1e-9
        lag, rate_variance = (time_ns - head.time_ns) * 1e-9, self._p.gyro_sigma**2 * self._dt
        self._now, sigma, sound = observation.carried(
            head.x, head.covariance, taus, gyros, self._dt, until_first, self._density, lag, rate_variance, *self._plant
        )
        if self._is_adrift:  # its place is made up, and before the first tag the heading
            sigma[:2] = UNKNOWN_SIGMA[:2]
        if not self._has_north:
            sigma[3:] += UNKNOWN_SIGMA[3:] * np.abs(to_matrix(self._now[3:7])[2])
        return sigma, sound

    def _forget(self) -> None:
        """Nothing is known: the filter begins anew with the next tag, or upright where it was."""
        self._accepted = self._waited = 0
        sound = observation.are_finite(self._now[:3], self._now[3:7])
        self._now = np.r_[self._now[:7] if sound else np.eye(1, 7, 3)[0], np.zeros(STATES - 7)]
        self._anchor = self._head = Belief(self._now, np.eye(ERRORS), 0)

    def _estimate(self, time_ns: int) -> Estimate:
        sigma, sound = self._carry(time_ns) if self._accepted else (UNKNOWN_SIGMA, True)
        if not sound:  # sensors have lied
            self._forget()
            sigma = UNKNOWN_SIGMA
        x = self._now.copy()
        return Estimate(
            p_wb=x[:3],
            q_wb=x[3:7],
            nu=x[7:13],
            force_w=x[19:22],
            moment_b=x[22:25] + restoring_moment(x[26:29], x[3:7]),
            sigma_p=sigma[:3],
            sigma_q=sigma[3:],
            tag_age_ns=time_ns - self._last_tag_ns,
            nis=self._nis,
            nis_dof=self._nis_dof,
            rejected=self._rejected,
            ready=self._accepted >= READY_AFTER,
        )

    def _process_noise(self) -> np.ndarray:
        """(28,) spectral density of the process noise of a body at rest, per second."""
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
        density[25:] = p.righting_walk * self._body.righting_sigma
        return density**2
