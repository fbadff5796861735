"""Stage 1 of a tick: fuses the sensors of all modules of a body into one set of measurements in the body frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.rotations import M, V, conjugate, cross, difference, exp, multiply, skew, to_matrix
from firmware_py.core.sensor_offsets import SensorOffsets
from firmware_py.core.types import BodyPose, Measured, ModuleInputs, TagObservation
from firmware_py.description.water import ATMOSPHERE_PA, PA_PER_M

FLIP_RAD = 0.35
"""Attitude difference beyond which a tag counts as flipped and is left out (20 deg; noise is 0.5): against the largest group of agreeing
tags in its picture, and, before any tag was accepted, against the tilt by gravity."""
SECOND_HAND = 0
"""Quality of a tag whose pose was measured relative to another one, by a camera on a module: the other's errors add to its own."""
SECOND_HAND_WEIGHT = 1.0 / 9.0
"""Weight of a second-hand tag: half a degree of the carrier over half a metre is three times a tag's own noise."""
CENTRED_M = 1e-9
"""Distance of the mean IMU position from the centre of mass below which the IMUs count as centred: the rest is rounding."""
ALPHA_S = 0.03
"""Averaging time of the gyro's differences: at 0.3 m of lever their noise makes 0.02 m/s^2; without averaging 0.1 at 100 Hz."""
GAP_NS = 15_000_000
"""Longest time between two gyro readings, or a tick if that is longer, over which their difference tells the angular acceleration: an IMU
may be slower than the tick, as one of 100 Hz, which by its own clock comes a tick late at 200 Hz."""
GYRO_BIASES, ACCEL_BIASES, DEPTH_BIASES = 0.1, 1.0, 0.5
"""Largest plausible deviation of a sensor from the mean of all, rad/s, m/s^2, m: twenty sigmas and more of the bench's draw of biases. A
failed sensor reads zeros or its limit, off by gravity, until it is found."""
PRESSURE_SILENT_NS = 100_000_000
"""Time without a reading, while others are heard, after which a pressure sensor counts as silent: five times its period (DEPTH comes at
50 Hz, can_dbc/modcube.dbc)."""
STILL_RAD_S = 0.05
"""Angular rate below which centripetal acceleration is negligible at any IMU in the body: 0.75 mm/s^2 over 0.3 m."""


Seen = list[tuple[TagObservation, int]]
"""Tags of one picture, each with its index among the body's tags."""


class Measurements:
    """Fuses the sensor readings of one body's modules. Holds geometry, learnt sensor offsets, and the angular acceleration."""

    def __init__(self, body: Body, period_ns: int) -> None:
        self._modules = body.modules
        self._rotations = np.stack([to_matrix(np.ascontiguousarray(q)) for q in body.q_bm], axis=1)
        self._mean_of_all = self._rotations.reshape(3, -1) / len(body.modules)
        self._r_bi, self._mean_r_bi = body.r_bi, body.r_bi.mean(axis=0)
        self._centred = bool(np.abs(self._mean_r_bi).max() < CENTRED_M)
        self._most_gap, self._per_s = max(1, GAP_NS // period_ns), 1e9 / period_ns
        self._alpha_shares = [1.0 - math.exp(-ticks * period_ns * 1e-9 / ALPHA_S) for ticks in range(self._most_gap + 1)]
        """Weight of a new difference, by the ticks that it is over."""
        count = len(body.modules)
        self._deviation_matrix = np.kron(np.ones((count, 1)), -self._mean_of_all)
        """(3 count, 3 count) matrix from the readings of all modules to the difference of each from their mean, body frame."""
        for i in range(count):
            self._deviation_matrix[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += self._rotations[:, i]
        self._gyro_offsets = SensorOffsets(count, 3, GYRO_BIASES, period_ns)
        self._accel_offsets = SensorOffsets(count, 3, ACCEL_BIASES, period_ns)
        self._depth_offsets = SensorOffsets(count, 1, DEPTH_BIASES, period_ns)
        self._pressure_silent_ticks = max(1, PRESSURE_SILENT_NS // period_ns)
        self._depths_m, self._depth_age = np.zeros(count), np.full(count, self._pressure_silent_ticks)
        """Last depth of each sensor, and ticks with any depth reading since then."""
        self._no_swing = np.zeros(3 * count)
        self._accel_from_rate_change = self._per_s * -np.vstack([skew(r) for r in self._r_bi - self._mean_r_bi])
        """(3 count, 3) matrix from the rate change within a tick to the resulting difference of each accelerometer from their mean."""
        self._is_still = False
        """Whether the body, of several modules, turned so slowly at the last gyro reading that differences of its sensors tell their
        offsets.
        """
        self._gap = 0
        """Ticks since the last gyro reading."""
        self._last_gyro: np.ndarray | None = None
        self._alpha = np.zeros(3)
        """(3,) smoothed angular acceleration, body frame, rad/s^2. Kept up only where the IMUs heard may be off the centre of mass."""
        self._tags = {(int(m), int(i)): k for k, (m, i) in enumerate(zip(body.tag_module, body.tag_ids, strict=True))}
        self._levers = np.ascontiguousarray(body.r_bt)
        self._q_tb = np.array([conjugate(np.ascontiguousarray(q)) for q in body.q_bt]).reshape(-1, 4)

    def fuse(self, modules: Sequence[ModuleInputs], q_wb: np.ndarray) -> Measured:
        """Returns one measurement of each kind.

        Args:
            modules: inputs of the whole fleet, by fleet index.
            q_wb: (4,) latest attitude, for the height of each pressure sensor above the centre of mass, and to break ties between tags.
        """
        mine = [modules[i] for i in self._modules]
        self._gap += 1
        gyro = self._mean([m.gyro for m in mine], self._gyro_offsets, self._no_swing if self._is_still else None)
        if gyro is not None:
            self._is_still = len(mine) > 1 and float(gyro @ gyro) < STILL_RAD_S**2
        elif self._gap >= self._most_gap:
            self._is_still = False
        accel = self._accel([m.accel for m in mine], gyro)
        self._gap = self._gap if gyro is None else 0
        return Measured(gyro, accel, self._depth(mine, q_wb), self._poses(mine, q_wb))

    def _mean(self, readings: list[np.ndarray | None], offsets: SensorOffsets, swing: np.ndarray | None) -> np.ndarray | None:
        """Returns the mean over all modules, (3,) in the body frame. Corrects it by the learnt offsets where some modules were not heard.

        Args:
            readings: reading of each module (3,), in its own frame; None: not heard.
            swing: (3 count,) difference of each reading from the mean caused by the body's motion; the rest are offsets, which are learnt.
                None: unknown, nothing is learnt.
        """
        heard = [value for value in readings if value is not None]
        if not heard:
            return None
        stacked = heard[0] if len(heard) == 1 else np.concatenate(heard)
        if len(heard) < len(readings):
            which = [value is not None for value in readings]
            return np.asarray(self._rotations[:, which].reshape(3, -1) @ stacked / len(heard) - offsets.mean_offset(which))
        if swing is not None:
            offsets.learn((self._deviation_matrix @ stacked - swing).reshape(-1, 3))
        return np.asarray(self._mean_of_all.dot(stacked))

    def _accel(self, readings: list[np.ndarray | None], gyro: np.ndarray | None) -> np.ndarray | None:
        """Returns the mean specific force (3,); if a gyro is heard, less the effect of rotation at the mean position of the IMUs heard."""
        swing, heard = self._swing(gyro), [value is not None for value in readings]
        accel = self._mean(readings, self._accel_offsets, swing)
        if not self._centred or len(heard) > 1:
            self._update_alpha(gyro)
        if accel is None or gyro is None or (self._centred and all(heard)):
            return accel
        lever = self._lever(heard)
        return np.asarray(accel - cross(self._alpha, lever) - cross(gyro, cross(gyro, lever)))

    def _swing(self, gyro: np.ndarray | None) -> np.ndarray | None:
        """Returns (3 count,) difference of each accelerometer from their mean due to angular acceleration, m/s^2. None unless the body is
        nearly still, because otherwise its angular rate matters too.

        Computed from the gyro's last change, unsmoothed: its noise is large, but averages out over the many ticks over which
        offsets are learnt, and it has no lag.
        """
        if not self._is_still or gyro is None or self._last_gyro is None:
            return None
        return np.asarray(self._accel_from_rate_change @ (gyro - self._last_gyro)) / self._gap

    def _update_alpha(self, gyro: np.ndarray | None) -> None:
        """Updates the angular acceleration, rad/s^2: smoothed, from one gyro reading to the next; zero after `GAP_NS` without one."""
        if gyro is None and self._gap < self._most_gap:
            return
        if gyro is None or self._last_gyro is None:
            self._alpha = np.zeros(3)
        else:
            share = self._alpha_shares[self._gap]
            self._alpha = self._alpha + share * self._per_s / self._gap * (gyro - self._last_gyro) - share * self._alpha
        self._last_gyro = gyro

    def _lever(self, heard: list[bool]) -> np.ndarray:
        """Returns (3,) mean position of the sensors that were heard, from the centre of mass, body frame."""
        return self._mean_r_bi if all(heard) else np.asarray(self._r_bi[heard].mean(axis=0))

    def _depth(self, mine: list[ModuleInputs], q_wb: np.ndarray) -> float | None:
        """Returns the depth of the centre of mass by the mean pressure, m; None where no sensor was heard."""
        heard = [m.pressure_pa for m in mine if m.pressure_pa is not None]
        if not heard:
            return None
        which, down = [m.pressure_pa is not None for m in mine], to_matrix(q_wb)[2]
        pressure, below = sum(heard) / len(heard), float(self._lever(which).dot(down))
        depth_m = (pressure - ATMOSPHERE_PA) / PA_PER_M - below
        if len(mine) > 1:
            each_m = (np.array(heard) - ATMOSPHERE_PA) / PA_PER_M - self._r_bi[which] @ down
            depth_m -= self._depth_offset(which, each_m)
        return depth_m

    def _depth_offset(self, which: list[bool], each_m: np.ndarray) -> float:
        """Returns the correction to subtract from the mean depth of the sensors heard in this tick, m: its offset from the mean of all.

        Healthy sensors take turns, a few ticks apart, and some may have fallen silent; the estimator learns the bias of the mean of all.

        Args:
            which: per module of the body, whether its sensor was heard. each_m: (heard,) depth of the centre of mass by each of those.
        """
        self._depth_age += 1
        self._depth_age[which], self._depths_m[which] = 0, each_m
        if self._is_still and self._depth_age.max() <= self._pressure_silent_ticks:
            self._depth_offsets.learn((self._depths_m - self._depths_m.mean()).reshape(-1, 1))
        return 0.0 if all(which) else float(self._depth_offsets.mean_offset(which)[0])

    def _poses(self, mine: list[ModuleInputs], q_wb: np.ndarray) -> list[BodyPose]:
        """Returns one pose per picture, oldest first."""
        pictures: dict[int, Seen] = {}
        for index, module in enumerate(mine):
            for tag in module.tags:
                known = self._tags.get((index, tag.tag_id))
                if known is not None:
                    pictures.setdefault(tag.capture_ns, []).append((tag, known))
        return [self._one_pose(capture, seen, q_wb) for capture, seen in sorted(pictures.items())]

    def _one_pose(self, capture_ns: int, seen: Seen, q_wb: np.ndarray) -> BodyPose:
        """Returns the weighted mean of the tags of one picture; tags that disagree with the largest group are left out as flipped."""
        if len(seen) == 1:
            tag, k = seen[0]
            return BodyPose(capture_ns, tag.p_wt, self._levers[k], multiply(tag.q_wt, self._q_tb[k]), _weight(tag))
        p_wt, q_wt = (np.concatenate(parts).reshape(len(seen), -1) for parts in ([t.p_wt for t, _ in seen], [t.q_wt for t, _ in seen]))
        known, weights = np.array([k for _, k in seen]), np.array([_weight(tag) for tag, _ in seen])
        mean_p_wt, lever, attitude = np.zeros(3), np.zeros(3), np.zeros(4)
        weight = fuse_picture(p_wt, q_wt, self._levers[known], self._q_tb[known], weights, q_wb, mean_p_wt, lever, attitude)
        return BodyPose(capture_ns, mean_p_wt, lever, attitude, weight)


def _weight(tag: TagObservation) -> float:
    """Returns the weight of an observation, in tags of full quality."""
    return SECOND_HAND_WEIGHT if tag.quality == SECOND_HAND else 1.0


@njit(f"float64({M},{M},{M},{M},{V},{V},{V},{V},{V})", cache=True)
def fuse_picture(p_wt, q_wt, levers, q_tb, weights, q_near, mean_p_wt, mean_lever, mean_q_wb):  # type: ignore[no-untyped-def]
    """Writes the weighted means of the largest group of tags that agree on the attitude; of equal groups, the one nearest to `q_near`.

    Args:
        p_wt, q_wt: (k, 3), (k, 4) poses of the tags in the world; levers, q_tb: (k, 3) their positions in the body, and (k, 4) body frame
            to tag frame; weights: (k,), positive.
        mean_p_wt, mean_lever, mean_q_wb: outputs, (3,), (3,), (4,).

    Returns the weight of the group.
    """
    count = p_wt.shape[0]
    q_wb = np.empty((count, 4))
    for i in range(count):
        q_wb[i] = multiply(q_wt[i], q_tb[i])
    agreement = np.abs(q_wb @ q_wb.T) > math.cos(0.5 * FLIP_RAD)
    group = agreement[np.argmax(agreement.sum(axis=1) + 0.5 * np.abs(q_wb @ q_near))]
    first = np.argmax(group * weights)  # the heaviest of the group: rotations are averaged relative to it
    reference, weight, total, turn = q_wb[first], 0.0, 0.0, np.zeros(3)
    for i in range(count):
        if group[i]:
            weight += weights[i]
            total += weights[i] / weights[first]  # equal weights count as one each, without rounding
    for i in range(count):
        if group[i]:
            share = weights[i] / weights[first]
            turn += share * difference(q_wb[i], reference) / total
            mean_p_wt += share * p_wt[i] / total
            mean_lever += share * levers[i] / total
    mean_q_wb[:] = multiply(reference, exp(turn))
    return weight
