"""Stage 2 of a tick: an error-state Kalman filter of pose, velocity, sensor biases, one lumped disturbance, and the righting vector.

The filter state is kept at the anchor: the capture time of the newest tag picture, or half a second ago when none came. Each measurement is
fused once, in the order of its time; from the anchor the state is carried to now through the stored thruster wrenches and gyro readings.
While no tag comes, measurements are not held back for half a second: a second belief, the head, runs ahead of the anchor, and the state is
carried from there.

Until the first tags come, the estimate is levelled by gravity (`alignment`): attitude except for the heading, and depth. After a long time
without tags the body is adrift: the filter assumes zero velocity over ground, and accepts tags again only once ten of them agree.

The process model is that of `propagation`; the accelerometer measures what that model leaves out (`observation.fuse_inertial`). The
velocity estimate therefore follows the robot rather than the command, which gains 15 degrees of phase (docs/estimator.md).
"""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core import observation
from firmware_py.core.alignment import AGREE_RAD, TagAgreement, tilt_between, upright
from firmware_py.core.body import Body
from firmware_py.core.depth_gate import MOST_STEP_M
from firmware_py.core.history import WINDOW_NS, History
from firmware_py.core.kalman_filter import INITIAL_SIGMA, Belief, KalmanFilter
from firmware_py.core.measurements import FLIP_RAD
from firmware_py.core.propagation import ERRORS, STATES, Error, Nominal
from firmware_py.core.rigid_body import restoring_moment
from firmware_py.core.rotations import heading, multiply, to_matrix
from firmware_py.core.topology import Motion
from firmware_py.core.types import NEVER_NS, BodyPose, Estimate, ExpectedDepth, Measured
from firmware_py.description.parameters import Estimation

READY_AFTER = 10
"""Tag observations to accept before the pose counts as valid."""
NOWHERE = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
"""Position and attitude that are believed before anything is measured."""
UNKNOWN_SIGMA = np.full(6, 1e3)
"""Sigma of the pose before the first tag, m and rad."""
UPRIGHT_AFTER_S = 1.0
"""Time without a tag after which the attitude is taken from gravity: the mean specific force of the last `GRAVITY_WINDOW_NS`."""
GRAVITY_WINDOW_NS = 200_000_000
BLIND_NS = 250_000_000
"""Time without a tag, fifteen pictures, after which the head leaves the anchor; also the time without a depth reading after which depth
counts as unmeasured."""
CATCH_UP = 4
"""Most samples that the head processes in a tick; it has caught up with the present after half a second."""
ADRIFT_NS = 10_000_000_000
"""Time without a tag after which the velocity over ground counts as unknown. The accelerometer cannot tell a disturbance force from drag:
the velocity estimate would grow, to 15 m/s within a minute of half stick, and spoil the tilt."""
KEPT_STATES = np.r_[Nominal.RATE, Nominal.GYRO_BIAS, Nominal.ACCEL_BIAS, Nominal.VERTICAL_FORCE, Nominal.MOMENT, Nominal.RIGHTING]
"""Indices of what survives in the state when tags relocate a body that was adrift, because it does not depend on the heading."""
LEARNT, LEARNT_ERRORS, LEARNT_SIGMAS = np.r_[Nominal.MOMENT, Nominal.RIGHTING], np.r_[Error.MOMENT, Error.RIGHTING], 5.0
"""Indices of moment and righting vector in the state and in the error, and the limit in initial sigmas within which they are kept when the
filter restarts because it refused too many tags. A wrong position does not spoil them; but a value outside the limit may be the very reason
why tags were refused. Biases and vertical force are not kept: while tags are refused, they absorb whatever does not fit."""
SPEED_SIGMA = 0.5
"""Sigma of the velocity of a body that was adrift, when tags relocate it, m/s: the speed of a module at half stick."""
NO_ACCEL_LIMIT_NS = 2_000_000_000
"""Time without an accelerometer after which a body that is adrift loses its attitude too: four times the delay of the fail-safe
`imu_lost`."""
RESET_AFTER = 30
"""Consecutive refused observations (half a second) after which the filter restarts from the tag."""


class Estimator:
    """Estimator of one body. Deterministic: time is an input, and the same inputs give the same outputs."""

    def __init__(self, body: Body, parameters: Estimation, period_ns: int) -> None:
        self._body = body
        self._dt = period_ns * 1e-9
        self._history = History(period_ns)
        self._filter = KalmanFilter(body, parameters, self._history)
        self._now = NOWHERE
        """State at the time of the last tick; without an estimate the last believed pose, at rest."""
        self._anchor: Belief
        self._head: Belief
        self._accepted: int
        """Tag observations accepted since the estimate started, 0: there is no estimate; a start without tags counts as READY_AFTER."""
        self._waited_ticks: int
        """Ticks without an estimate."""
        self._forget()
        self.retune(parameters)
        self._refused_in_row, self._rejected, self._starts = 0, 0, 0
        self._depth_variance = math.inf
        self._last_tag_ns, self._last_accept_ns = NEVER_NS, 0
        """Capture time of the newest accepted tag, and time of the tick in which it was accepted or the estimate started."""
        self._last_accel_ns, self._last_depth_ns = 0, 0
        self._tag_agreement = TagAgreement()
        self._nis, self._nis_dof = math.nan, 0
        self.fused: list[BodyPose] = []
        """Pictures that the last tick accepted."""

    def retune(self, parameters: Estimation) -> None:
        """Applies new noise parameters from the next tick on; the estimate stays."""
        self._p = parameters
        self._filter.retune(parameters)

    @property
    def q_wb(self) -> np.ndarray:
        """Latest attitude, (4,)."""
        return np.asarray(self._now[Nominal.ATTITUDE])

    def expected_depth(self, time_ns: int) -> ExpectedDepth | None:
        """Returns what the body's depth sensors are to tell at `time_ns`; None unless tags tell the depth.

        Without tags a push carries the body away from the estimate within half a second, and the depth sensors are right.
        """
        if not self._accepted or time_ns - self._last_tag_ns > BLIND_NS:
            return None
        sigma_m = math.sqrt(self._depth_variance + self._head.covariance[Error.DEPTH_BIAS, Error.DEPTH_BIAS] + self._p.depth_sigma_m**2)
        return ExpectedDepth(float(self._now[2] + self._now[Nominal.DEPTH_BIAS]), sigma_m, to_matrix(self.q_wb)[2].tolist())

    def step(self, time_ns: int, measured: Measured, tau: np.ndarray) -> Estimate:
        """Returns the estimate at `time_ns`.

        Args:
            time_ns: time of this tick.
            measured: fused measurements of all sensors.
            tau: (6,) mean thruster wrench since the previous tick, body frame.
        """
        self._nis, self._nis_dof, self.fused = math.nan, 0, []
        if self._history.newest >= 0 and time_ns - self._history.newest_ns > WINDOW_NS:
            self._accepted = self._waited_ticks = 0  # the process was suspended: the history does not reach back to the anchor
        self._history.push(time_ns, tau, measured.gyro, measured.accel, measured.depth_m)
        self._last_accel_ns = time_ns if measured.accel is not None else self._last_accel_ns
        self._last_depth_ns = time_ns if measured.depth_m is not None else self._last_depth_ns
        for pose in measured.tags:
            self._take(pose)
        if self._is_lost(time_ns):
            self._forget()
            self._waited_ticks = round(UPRIGHT_AFTER_S / self._dt)  # no second wait: gravity is used at once
        if not self._accepted:
            self._wait(time_ns)
        if self._accepted:
            self._anchor = self._filter.advanced(self._anchor, time_ns - WINDOW_NS)
            self._move_head(time_ns)
            if self._is_adrift:
                self._stand_still()
        return self._estimate(time_ns)

    @property
    def motion(self) -> Motion:
        """Current state, and covariance of the head, for a body that docks or undocks."""
        return Motion(self._now.copy(), self._head.covariance.copy(), self._accepted, self._last_tag_ns)

    def restart(self, time_ns: int, motion: Motion) -> Estimate:
        """Restarts from `motion` at `time_ns`, as after a dock; returns the estimate of the same tick."""
        self._history.push(time_ns, np.zeros(6), None, None, None)
        self._anchor = self._head = Belief(motion.x.copy(), motion.covariance.copy(), time_ns)
        self._now = self._anchor.x
        self._last_accel_ns = self._last_depth_ns = time_ns
        self._last_tag_ns, self._last_accept_ns = motion.tag_ns, time_ns
        self._accepted, self._refused_in_row = motion.accepted, 0
        self._nis, self._nis_dof = math.nan, 0
        return self._estimate(time_ns)

    # ------------------------------------------------------------ fusion at the anchor

    def _take(self, pose: BodyPose) -> None:
        """Starts from a tag picture, or advances the anchor to it and fuses it there; refuses one from before the anchor."""
        if not (observation.are_finite(pose.p_wt, pose.q_wb) and pose.q_wb.any()):
            self._rejected += 1
        elif not self._accepted:
            self._start(pose)
        elif pose.capture_ns >= self._anchor.time_ns:
            self._anchor = self._filter.advanced(self._anchor, min(pose.capture_ns, self._history.newest_ns))
            if self._is_adrift:
                self._relocate(pose)
            else:
                self._fuse_tag(pose)
        else:
            self._rejected += 1

    def _start(self, pose: BodyPose) -> None:
        """Starts a new estimate: a body at rest at `pose`, with INITIAL_SIGMA, and no depth readings that contradict it."""
        self._anchor = self._head = self._filter.started(pose)
        self._now = self._anchor.x
        self._history.forget_depths(float(self._now[2]), MOST_STEP_M)
        self._last_tag_ns, self._last_accept_ns = pose.capture_ns, self._history.newest_ns
        self._accepted, self._refused_in_row = 1, 0
        self._starts += 1

    def _wait(self, time_ns: int) -> None:
        """Waits for a tag; after a second without any, starts levelled by gravity, at the last believed position and heading."""
        self._waited_ticks += 1
        if self._waited_ticks * self._dt <= UPRIGHT_AFTER_S:
            return
        tilt, accels_depths = self._by_gravity()
        if tilt is None:
            return
        depths = accels_depths[:, 3][~np.isnan(accels_depths[:, 3])]
        place = np.r_[self._now[:2], depths.mean() if len(depths) else self._now[2]]
        self._start(BodyPose(time_ns, place, np.zeros(3), multiply(heading(self._now[Nominal.ATTITUDE]), tilt), 1.0))
        self._anchor.covariance[2, 2] = INITIAL_SIGMA[-1] ** 2 if len(depths) else UNKNOWN_SIGMA[2] ** 2
        self._accepted, self._last_tag_ns = READY_AFTER, NEVER_NS

    def _by_gravity(self) -> tuple[np.ndarray | None, np.ndarray]:
        """Returns the attitude (4,), heading 0, by the latest GRAVITY_WINDOW_NS, and their readings; None where gravity cannot be told."""
        _, gyros, accels_depths = self._history.since(self._history.first_after(self._history.newest_ns - GRAVITY_WINDOW_NS))
        return upright(gyros, accels_depths[:, :3]), accels_depths

    @property
    def _has_north(self) -> bool:
        """Whether a tag has ever given the heading."""
        return self._last_tag_ns != NEVER_NS

    @property
    def _is_adrift(self) -> bool:
        """Whether no tag was accepted for longer than `ADRIFT_NS`, or ever."""
        return self._history.newest_ns - self._last_tag_ns > ADRIFT_NS

    def _is_lost(self, time_ns: int) -> bool:
        """Whether the estimate rests on too little: on a few tags after which no more came, or for long on nothing but a gyro."""
        few = self._accepted < READY_AFTER and time_ns - self._last_accept_ns > UPRIGHT_AFTER_S * 1e9
        borne_out_ns = max(self._last_accel_ns, self._last_tag_ns + ADRIFT_NS)
        return self._accepted > 0 and (few or time_ns - borne_out_ns > NO_ACCEL_LIMIT_NS)

    def _stand_still(self) -> None:
        """Fuses a zero velocity over ground, with noise, as a pseudo-measurement (see ADRIFT_NS); ArduPilot's EKF3 does likewise without
        aiding. Includes the vertical velocity only while depth is unmeasured. Before the first tag, fuses the believed heading too.
        """
        axes = 2 if self._history.newest_ns - self._last_depth_ns < BLIND_NS else 3
        self._anchor, self._head = (self._filter.stilled(at, axes, not self._has_north) for at in (self._anchor, self._head))

    def _relocate(self, pose: BodyPose) -> None:
        """Relocates a body that was adrift once enough tags agree (`TagAgreement`); the state entries KEPT_STATES stay."""
        if self._contradicts_gravity(pose):
            self._rejected += 1
            return
        if not self._agrees(pose):
            self._refuse(pose)
            return
        self._refused_in_row = 0
        if self._tag_agreement.count >= READY_AFTER:
            before, had_north = self._anchor, self._has_north
            self._start(pose)
            self._anchor.x[KEPT_STATES], self._accepted = before.x[KEPT_STATES], READY_AFTER
            self._anchor.covariance[Error.VELOCITY, Error.VELOCITY] = SPEED_SIGMA**2 * np.eye(3)
            # With a larger variance of the gyro bias the filter would take the next unmodelled bump for a bias.
            if had_north:  # before the first tag the assumed heading makes that variance too small
                self._anchor.covariance[Error.GYRO_BIAS, Error.GYRO_BIAS] = before.covariance[Error.GYRO_BIAS, Error.GYRO_BIAS]

    def _fuse_tag(self, pose: BodyPose) -> None:
        """Fuses a picture at the anchor unless the gate refuses it."""
        gate = self._p.tag_gate**2
        nis, self._anchor = self._filter.with_tag(self._anchor, pose, gate)
        if not nis <= gate:  # also when it is NaN
            self._refuse(pose)
            return
        self._nis = nis if math.isnan(self._nis) else self._nis + nis
        self._nis_dof += 6
        self._accepted += 1
        self.fused.append(pose)
        self._refused_in_row = 0
        self._last_tag_ns, self._last_accept_ns = pose.capture_ns, self._history.newest_ns

    def _refuse(self, pose: BodyPose) -> None:
        """Counts a refused picture; after RESET_AFTER in a row starts anew from it, with what is learnt of the body (LEARNT).

        One that contradicts gravity is no place to start from: a robot whose camera was knocked by ten degrees, or most of whose tags were
        flipped, started anew twice a second, never had a pose, and tumbled on its way up. The new pose counts at once, by the refused
        pictures that agree; an estimate that has merely lost its place thus keeps its attitude.
        """
        self._rejected += 1
        if self._contradicts_gravity(pose):
            return
        self._refused_in_row += 1
        is_upright = self._agrees(pose)
        if self._refused_in_row < RESET_AFTER or (is_upright and self._tag_agreement.count < READY_AFTER):
            return
        learnt = self._anchor.x[LEARNT]
        self._start(pose)
        self._accepted = READY_AFTER if is_upright else 1
        sigma = np.sqrt(np.diag(self._anchor.covariance)[LEARNT_ERRORS])
        self._anchor.x[LEARNT] = np.where(np.abs(learnt) <= LEARNT_SIGMAS * sigma, learnt, 0.0)

    def _agrees(self, pose: BodyPose) -> bool:
        """Whether the estimate, if not the place, agrees with a picture (`TagAgreement`, which counts it)."""
        return self._tag_agreement.agrees(pose, self._anchor.x[Nominal.POSITION], self._anchor.x[Nominal.ATTITUDE])

    def _contradicts_gravity(self, pose: BodyPose) -> bool:
        """Whether a picture's tilt is flipped, or further than AGREE_RAD beyond the estimate's, from that by gravity; false where that
        cannot be told. An acceleration turns the gravity that is felt, but from a right estimate as far as from a right picture.
        """
        tilt, _ = self._by_gravity()
        if tilt is None:
            return False
        most_rad = AGREE_RAD + tilt_between(self._anchor.x[Nominal.ATTITUDE], tilt)
        return tilt_between(pose.q_wb, tilt) > min(FLIP_RAD, most_rad)

    # ------------------------------------------------------------ from the anchor to now

    def _move_head(self, time_ns: int) -> None:
        """Moves the head: equal to the anchor while tags come; otherwise it runs ahead, up to one period before now."""
        if time_ns - self._last_accept_ns < BLIND_NS:
            self._head = self._anchor
            return
        start = max(self._head, self._anchor, key=lambda belief: belief.time_ns)
        period_ns = self._history.period_ns
        self._head = self._filter.advanced(start, min(time_ns - period_ns, start.time_ns + CATCH_UP * period_ns))

    def _carry(self, time_ns: int) -> tuple[np.ndarray, bool]:
        """Carries the state from the head to `time_ns`; returns sigma (6,) of its pose, and whether state and sigma are sound."""
        self._now, sigma, sound = self._filter.carried(self._head, time_ns)
        if self._is_adrift:  # the horizontal position is a guess, and before the first tag the heading is too
            sigma[:2] = UNKNOWN_SIGMA[:2]
        if not self._has_north:
            sigma[3:] += UNKNOWN_SIGMA[3:] * np.abs(to_matrix(self._now[Nominal.ATTITUDE])[2])
        return sigma, sound

    def _forget(self) -> None:
        """Drops the estimate: the filter restarts from the next tag, or levelled by gravity at the last believed position."""
        self._accepted = self._waited_ticks = 0
        sound = observation.are_finite(self._now[Nominal.POSITION], self._now[Nominal.ATTITUDE])
        self._now = np.r_[self._now[: NOWHERE.size] if sound else NOWHERE, np.zeros(STATES - NOWHERE.size)]
        self._anchor = self._head = Belief(self._now, np.eye(ERRORS), 0)

    def _estimate(self, time_ns: int) -> Estimate:
        sigma, sound = self._carry(time_ns) if self._accepted else (UNKNOWN_SIGMA, True)
        if not sound:  # a sensor gave false readings
            self._forget()
            sigma = UNKNOWN_SIGMA
        self._depth_variance = float(sigma[2]) ** 2
        x = self._now.copy()
        return Estimate(
            p_wb=x[Nominal.POSITION],
            q_wb=x[Nominal.ATTITUDE],
            nu=x[Nominal.NU],
            force_w=x[Nominal.FORCE],
            moment_b=x[Nominal.MOMENT] + restoring_moment(x[Nominal.RIGHTING], x[Nominal.ATTITUDE]),
            sigma_p=sigma[:3],
            sigma_q=sigma[3:],
            tag_age_ns=time_ns - self._last_tag_ns,
            nis=self._nis,
            nis_dof=self._nis_dof,
            rejected=self._rejected,
            ready=self._accepted >= READY_AFTER,
            starts=self._starts,
        )
