"""Finds a thruster whose force is missing from the motion, whatever its ESC reports. Part of `faults`.

The wrench residual, measured by the motion minus commanded and modelled, is averaged over blocks of a tenth of a second. If it
changes, and the lost force of one thruster explains the change in all six components, that thruster lies. Slow changes (current,
trim, buoyancy) are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import BUOYANCY_SIGMA_N, CRUISE_M_S, Body
from firmware_py.core.modelled_wrench import across, add_motion, add_tick
from firmware_py.core.rotations import M, V, rotate_back
from firmware_py.core.thruster_trial import ThrusterTrial
from firmware_py.core.trial_handover import Held, carried_over
from firmware_py.core.types import Estimate, Measured
from firmware_py.description.failsafe_parameters import Faults
from firmware_py.description.water import GRAVITY

DOWN = np.array([0.0, 0.0, 1.0])
BLOCK_NS = 100_000_000
"""Length of an averaging block."""
SAMPLE_NS = 10_000_000
"""Longest time for which a sample of the accelerometer stands, or a tick if that is longer: an IMU may be slower than the tick."""
RECENT, GAP, BASE = 5, 12, 30
"""Numbers of blocks: the mean of the last half second is compared with the mean of three seconds that ended 1.2 s before now."""
LEAST_BASE = 5
"""Whole blocks needed in the base."""
SIGMA_FORCE_N, SIGMA_TILT, SIGMA_YAW = 0.15, 0.006, 0.010
"""Sigma of the half-second mean of a healthy module, N, N m of roll and pitch, N m of yaw: accelerometer tilt and noise, gains, gusts
(measured on the bench)."""
GUST_M_S, GUST_LEVER_M = 0.0135, 0.03
"""Change of the water's speed within seconds that counts as noise, for its effect on the drag of a body under way, and the lever arm of
that force about the centre. For a module the force is the 0.15 N measured above, for a BlueROV2 Heavy 0.7 N."""
DRIFT_M_S = 0.04
"""Assumed speed of the water. A body that turns or reverses meets it from another side within seconds, so its drag may be off by this speed
times the slope of the drag. The force acts at the body's middle and makes no moment, so moments are trusted more under way."""
MODEL_SHARE = 0.12
"""Model error as a share of the acting wrench, from mass, drag and gain errors; counts as additional noise. For the Coriolis wrench the
share by which the water's drift changes the speed is added."""
EXPLAINED = 0.8
"""Share of the change (squared, in sigmas) that one thruster must explain."""
MAX_UNEXPLAINED = 9.2
"""Squared sigmas that a thruster may leave unexplained: the 90 % quantile of chi-squared noise in the five axes that its loss does not
determine. A wall, a hand or a rope pushes nearly as some thruster would, but seldom so exactly."""
RUNNER_UP = 0.5
"""Largest residual of the best thruster as a share of that of the next best."""
SIGNIFICANT = 20.0
"""Squared sigmas that a thruster must explain."""
CROSS_SHARE = 1.0 / 9.0
"""Mean square distance of the hull from a rotation axis, as a share of the body's squared reach: L^2 / 12 for a cube of edge L. A body
that turns under way meets the water faster on one side than on the other; the drag's slope times this brakes the turn, which no model of
the firmware includes. For a module that makes 0.20 N m per m/s and rad/s; tools/identify.py finds 0.14 to 0.21. That is the mean over both
directions of flow; how much more a long hull is braked by flow across it, `across` tells."""
RESIDUAL, ACTED, DOWN_B, CORIOLIS, CROSSED, MUNK = slice(6), slice(6, 12), slice(12, 15), slice(15, 21), slice(21, 24), slice(24, 27)
"""Columns of a block, a row of means over its ticks: wrench residual, NaN unless the block is whole; wrench of the thrusters; down, body
frame, at the block's end; Coriolis wrench; the two halves of FLOW."""
FLOW = slice(CROSSED.start, MUNK.stop)
"""Output of `add_flow`: speeds across times rates, products of speeds."""
FORCES, TILT_SIGMA, SPEED = slice(MUNK.stop, -2), -2, -1
"""The remaining columns: force of each thruster, sigma of the attitude, speed."""
FRESH_NS = 500_000_000
"""Age of the newest tag at which judging stops: without tags, tilt and speed of a tumbling robot are known too poorly."""
MOST = 2.6
"""Largest loss of a thruster as a multiple of its force; 2 means reversed."""
ACQUITTALS = 2
"""How often a thruster may be acquitted until the body is armed again. One that is stuck may look innocent, and must not come and go for
the rest of the flight."""


class MissingThrust:
    """Watches the motion of one body for missing thrust."""

    def __init__(self, body: Body, parameters: Faults, period_ns: int) -> None:
        t = body.thrusters
        self._body, self.parameters = body, parameters
        self._plant = (body.mass, body.righting, body.drag.nodes, body.drag.rotational, body.drag.linear)
        self._columns = t.matrix.T.copy()
        self._across = across(body)
        self._ticks, self._sample_ticks = (max(1, round(ns / period_ns)) for ns in (BLOCK_NS, SAMPLE_NS))
        count = len(body.modules)
        gust = GUST_M_S * body.drag.cruise_slope
        moment = np.hypot(np.array([SIGMA_TILT, SIGMA_TILT, SIGMA_YAW]) * count, GUST_LEVER_M * gust)
        self._healthy = (
            np.r_[np.full(3, max(SIGMA_FORCE_N * np.sqrt(count), gust)), moment],
            np.r_[BUOYANCY_SIGMA_N * np.sqrt(count), body.righting_sigma],
            np.repeat([float(body.mass[0, 0]) * GRAVITY, 0.0], 3),
            np.repeat([DRIFT_M_S * body.drag.cruise_slope / CRUISE_M_S, 0.0], 3),
            np.repeat([CROSS_SHARE * body.reach_m**2 * body.drag.cruise_slope / CRUISE_M_S, MODEL_SHARE * float(body.mass[0, 0])], 3),
        )  # fmt: skip
        """Arguments noise_sigma, buoyancy_sigma, sigma_per_tilt, sigma_per_speed and flow_sigma of `explain`."""
        self._period_s = period_ns * 1e-9
        self.acquitted: int | None = None
        """Thruster that was left out because of its motion, and that this tick showed to be innocent."""
        self._mean_residual, self._whole = np.zeros(6), 0
        """Running mean of the wrench residual, and the number of whole blocks in it, at most BASE."""
        self.reset()
        self.forget()

    def reset(self) -> None:
        """Drops any suspicion; keeps the blocks, so that the motion of the disarmed body serves as the base."""
        self._suspect, self._count = -1, 0
        self._trial: ThrusterTrial | None = None
        self._acquittals = [0] * len(self._columns)

    def forget(self) -> None:
        """Drops all blocks and any suspicion, because the usable thrusters have changed. A trial goes on."""
        self._blocks = np.full((GAP + BASE, FORCES.start + self._columns.shape[0] + 2), np.nan)
        self._suspect, self._count = -1, 0
        self._start_block(None)

    def _start_block(self, gyro: np.ndarray | None) -> None:
        self._seen: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]] = []
        """Velocity, attitude, forces and specific force of each tick of the block."""
        self._first = self._last = gyro
        self._first_n = self._last_n = 0
        """First and last rates of the block, and after how many of its ticks they were measured; 0: at its start."""
        self._free, self._pulled = True, False
        """So far: no magnet acted, and the estimate was ready, in every tick; a magnet acted in some tick."""

    def step(
        self, measured: Measured, estimate: Estimate, force_n: np.ndarray, alive: np.ndarray, armed: bool, free: bool
    ) -> int | None:
        """Returns the thruster that lies, once it is certain; else None.

        Args:
            force_n: (n,) believed mean forces since the last tick, N.
            free: no magnet pulls at another body, nor pushes a module of this one away.
        """
        self.acquitted = None
        self._add(measured, estimate, force_n)
        self._free, self._pulled = self._free and free and estimate.ready, self._pulled or not free
        if len(self._seen) < self._ticks:
            return None
        full, pulled = self._close(estimate), self._pulled
        self._start_block(self._last if self._last_n == len(self._seen) else None)
        if not pulled:  # magnets pull for longer than a trial's patience: it waits for the dock, or its end
            self._judge_trial(full)
        if not (full and armed):
            self._count = 0
            return None
        return self._decide(alive)

    def _add(self, measured: Measured, estimate: Estimate, force_n: np.ndarray) -> None:
        """Adds one tick to the block."""
        self._seen.append((estimate.nu, estimate.q_wb, force_n, measured.accel))
        if measured.gyro is not None:
            if self._first is None:
                self._first, self._first_n = measured.gyro, len(self._seen)
            self._last, self._last_n = measured.gyro, len(self._seen)

    def _close(self, estimate: Estimate) -> bool:
        """Ends the block and stores it; returns whether it is whole, that is, can be judged."""
        n, accels, told, last, speed = len(self._seen), 0, 0, 0, 0.0
        acceleration, model, coriolis, flow, forces = np.zeros(3), np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(self._columns.shape[0])
        for tick, (nu, q_wb, force_n, accel) in enumerate(self._seen, 1):  # in one batch, while the code is in the processor's cache
            speed += add_tick(nu, q_wb, force_n, *self._plant, self._across, model, coriolis, flow, forces)
            if accel is not None:
                accels, told, last = accels + 1, told + min(tick - last, self._sample_ticks), tick
                add_motion(accel, q_wb, acceleration)
        span = (self._last_n - self._first_n) * self._period_s
        known = told >= n // 2 and self._first is not None and span >= 0.5 * n * self._period_s
        submerged = estimate.p_wb[2] > self._body.reach_m  # forces at the surface are not modelled here
        whole = known and submerged and self._free and estimate.tag_age_ns < FRESH_NS
        residual, acted = np.full(6, np.nan), self._columns.T @ (forces / n)
        if whole and self._last is not None and self._first is not None:
            motion = np.concatenate((acceleration / accels, (self._last - self._first) / span))
            residual = self._body.mass @ motion - acted - (model + coriolis) / n
            self._whole = min(self._whole + 1, BASE)
            self._mean_residual = self._mean_residual + (residual - self._mean_residual) / self._whole
        down_b = rotate_back(estimate.q_wb, DOWN)
        self._blocks[:-1] = self._blocks[1:]
        now = self._blocks[-1]
        now[RESIDUAL], now[ACTED], now[DOWN_B], now[CORIOLIS], now[FLOW] = residual, acted, down_b, coriolis / n, flow / n
        now[FORCES], now[TILT_SIGMA], now[SPEED] = forces / n, max(estimate.sigma_q.tolist()), speed / n
        return whole

    def _decide(self, alive: np.ndarray) -> int | None:
        """Judges the change; returns a thruster that was suspected in enough blocks in a row."""
        best = self._explain(alive)
        if best < 0 or best != self._suspect:
            self._suspect, self._count = best, int(best >= 0)
            return None
        self._count += 1
        if self._count < self.parameters.lie_count:
            return None
        self._trial = self._accuse(best)
        return best

    def _accuse(self, thruster: int) -> ThrusterTrial:
        """Begins the trial of a thruster that is being left out. It may have lost its force since the base, and is then missed no more;
        or all along, and is then missed no more in the base either.
        """
        whole = ~np.isnan(self._blocks[:, 0])
        base, recent = (self._blocks[part][whole[part]].mean(axis=0) for part in (slice(BASE), slice(-RECENT, None)))
        wall, column, sigma = (recent - base)[RESIDUAL], self._columns[thruster], self._healthy[0]
        liar, missed = [np.zeros(6)], (base - recent)[FORCES][thruster] * column
        share = (missed / sigma) @ (wall / sigma) / max((missed / sigma) @ (missed / sigma), 1e-12)
        if self.parameters.lie_share <= share <= MOST:
            liar.append(share * base[FORCES][thruster] * column)
        return ThrusterTrial(thruster, base[RESIDUAL], wall, liar, sigma)

    def _judge_trial(self, full: bool) -> None:
        """Shows the latest block to the trial under way; a thruster may be acquitted so many times."""
        verdict = None if self._trial is None else self._trial.is_innocent(self._blocks[-1, RESIDUAL] if full else None)
        if self._trial is None or verdict is None:
            return
        thruster, self._trial = self._trial.thruster, None
        if verdict and self._acquittals[thruster] < ACQUITTALS:
            self._acquittals[thruster] += 1
            self.acquitted = thruster

    def inherit(self, thruster: int, before: MissingThrust, number: int) -> None:
        """Takes over how often `thruster` was acquitted, as number `number` of the body before."""
        self._acquittals[thruster] = before._acquittals[number]

    def take_over(self, before: Sequence[MissingThrust]) -> None:
        """Goes on with a trial of the body that parts, or of those that join (trial_handover)."""
        self._trial = carried_over([other._held() for other in before], self._body, self._healthy[0])

    def _held(self) -> Held:
        return Held(self._body, self._trial, self._mean_residual if self._whole >= LEAST_BASE else None)

    def _explain(self, alive: np.ndarray) -> int:
        """Returns the one thruster that explains the change, or -1."""
        return int(explain(self._blocks, self._columns, alive, *self._healthy, self.parameters.lie_share))


@njit(cache=True)
def _mean_of_whole(blocks):  # type: ignore[no-untyped-def]
    """Returns the mean (w,) over the whole blocks of (k, w), and their number; the residual of the others is NaN."""
    total, count = np.zeros(blocks.shape[1]), 0
    for k in range(blocks.shape[0]):
        if not math.isnan(blocks[k, 0]):
            total += blocks[k]
            count += 1
    return total / max(count, 1), count


@njit(cache=True)
def _sigma_of_change(  # type: ignore[no-untyped-def]
    change, tilt_sigma, speed, noise_sigma, buoyancy_sigma, sigma_per_tilt, sigma_per_speed, flow_sigma
):
    """Returns the sigma (6,) of the change of a healthy body's residual; see `explain` for the last five arguments.

    Args:
        change: (w,) change of a block. tilt_sigma: of the tilt, rad. speed: m/s.
    """
    acted, coriolis, crossed, munk = change[ACTED], change[CORIOLIS], change[CROSSED], change[MUNK]
    tx, ty, tz = change[DOWN_B] ** 2
    lift, lx, ly, lz = buoyancy_sigma**2
    turned = (lift * tx, lift * ty, lift * tz, ly * tz + lz * ty, lz * tx + lx * tz, lx * ty + ly * tx)
    coriolis_share = MODEL_SHARE + DRIFT_M_S / max(speed, DRIFT_M_S)
    sigma = np.empty(6)
    for i in range(6):
        model = (MODEL_SHARE * acted[i]) ** 2 + (coriolis_share * coriolis[i]) ** 2
        if i >= 3:
            model += (flow_sigma[i - 3] * crossed[i - 3]) ** 2 + (flow_sigma[i] * munk[i - 3]) ** 2
        of_tilt, of_speed = (sigma_per_tilt[i] * tilt_sigma) ** 2, (sigma_per_speed[i] * speed) ** 2
        sigma[i] = math.sqrt(noise_sigma[i] ** 2 + model + turned[i] + of_tilt + of_speed)
    return sigma


@njit(cache=True)
def _left_by(column, lost_since, lost_all_along, y, sigma, total, lie_share):  # type: ignore[no-untyped-def]
    """Returns what a liar leaves unexplained of the change `y` (6,), which is in sigmas and squared makes `total`; `total` for no liar.

    Args:
        column: (6,) wrench of its unit force. lost_since, lost_all_along: forces that it lacks if it lost them since the base, or before.
    """
    left = total
    for force in (lost_since, lost_all_along):
        size, fit = 0.0, 0.0
        for i in range(6):
            phi = -column[i] * force / sigma[i]
            size += phi * phi
            fit += phi * y[i]
        share = fit / max(size, 1e-12)
        if lie_share <= share <= MOST and size >= 1.0:
            left = min(left, total - share * fit)
    return left


@njit(f"int64({M},{M},boolean[::1],{V},{V},{V},{V},{V},float64)", cache=True)
def explain(  # type: ignore[no-untyped-def]
    blocks, columns, alive, noise_sigma, buoyancy_sigma, sigma_per_tilt, sigma_per_speed, flow_sigma, lie_share
):
    """Returns the one thruster that explains the change of the latest blocks against the oldest, or -1.

    Args:
        blocks: (GAP + BASE, w) blocks, the latest last; RESIDUAL and the names that follow it are their columns.
        columns: (n, 6) wrench of unit force. alive: (n,) thrusters that may be suspected.
        noise_sigma, sigma_per_tilt, sigma_per_speed: (6,) sigma of a healthy body's change: of noise; per radian of sigma of the tilt; per
            m/s of speed.
        flow_sigma: (6,) sigma of the moment per unit of change in the output of `add_flow`.
        buoyancy_sigma: (4,) sigma of net buoyancy, N, and of weight times the lever of buoyancy along each axis, N m.
        lie_share: smallest share of its force that a liar has lost.
    """
    old, base = _mean_of_whole(blocks[:BASE])
    new, recent = _mean_of_whole(blocks[-RECENT:])
    if base < LEAST_BASE or recent < RECENT - 1:
        return -1
    change, speed = new - old, max(old[SPEED], new[SPEED])
    sigma = _sigma_of_change(change, old[TILT_SIGMA], speed, noise_sigma, buoyancy_sigma, sigma_per_tilt, sigma_per_speed, flow_sigma)
    y, total = change[RESIDUAL] / sigma, 0.0
    for i in range(6):
        total += y[i] ** 2
    if total < SIGNIFICANT:
        return -1
    best, least, second = -1, total, total
    for t in range(alive.size):
        if not alive[t]:
            continue
        left = _left_by(columns[t], new[FORCES][t], change[FORCES][t], y, sigma, total, lie_share)
        if left < least:
            best, least, second = t, left, least
        else:
            second = min(second, left)
    sure = total - least >= SIGNIFICANT and least <= min(MAX_UNEXPLAINED, (1.0 - EXPLAINED) * total)
    return best if sure and least <= RUNNER_UP * second else -1
