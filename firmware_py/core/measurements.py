"""Stage 1 of a tick: the sensors of all modules of a body become one set of measurements in the body frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.observation import GRAVITY
from firmware_py.core.rotations import M, V, conjugate, cross, difference, exp, multiply, skew, to_matrix
from firmware_py.core.sensor_offsets import SensorOffsets
from firmware_py.core.types import BodyPose, Measured, ModuleInputs, TagObservation
from firmware_py.description.water import WATER_DENSITY

ATMOSPHERE_PA = 101_325.0
"""Standard atmosphere; what the weather adds is the estimator's depth bias."""
FLIP_RAD = 0.35
"""Tags of one picture that disagree by more with the most that agree are flipped and left out (20 deg; noise is 0.5); so is one that tells
of such a tilt against gravity before any was believed."""

SECOND_HAND = 0
"""Quality of a tag whose place was told through another one, by a camera that a module carries: the other's errors add to its own."""
SECOND_HAND_WEIGHT = 1.0 / 9.0
"""What such a tag is worth: half a degree of the carrier over half a metre is three times a tag's own noise."""
CENTRED_M = 1e-9
"""IMUs whose mean is nearer to the centre of mass stand around it: what is left is rounding."""
ALPHA_S = 0.03
"""Time over which the gyro's differences are averaged: over 0.3 m of lever their noise makes 0.02 m/s^2, without it 0.1 at 100 Hz."""
GYRO_BIASES, ACCEL_BIASES, DEPTH_BIASES = 0.1, 1.0, 0.5
"""By how much a sensor may be off the mean of all, rad/s, m/s^2, m: twenty sigmas and more of the bench's draw of biases. One that fails
tells zeros or its limit: gravity off, for as long as it takes to be found."""
TURN_NS = 100_000_000
"""Within so long each pressure sensor is heard, five times over (DEPTH comes at 50 Hz, DESIGN's bus); who is not is silent."""
STILL_RAD_S = 0.05
"""Slower than that the rate makes no difference to an IMU anywhere in the body: 0.75 mm/s^2 over 0.3 m."""


Seen = list[tuple[TagObservation, int]]
"""Tags of one picture, and which of the body's tags each is."""


class Measurements:
    """Fuses what the modules of one body say. Holds geometry, and the angular acceleration."""

    def __init__(self, body: Body, period_ns: int) -> None:
        self._modules = body.modules
        self._rotations = np.stack([to_matrix(np.ascontiguousarray(q)) for q in body.q_bm], axis=1)
        self._mean_of_all = self._rotations.reshape(3, -1) / len(body.modules)
        self._r_bi, self._mean_r_bi = body.r_bi, body.r_bi.mean(axis=0)
        self._centred = bool(np.abs(self._mean_r_bi).max() < CENTRED_M)
        self._share = 1.0 - math.exp(-period_ns * 1e-9 / ALPHA_S)
        per_s = 1e9 / period_ns
        self._gain = self._share * per_s
        count = len(body.modules)
        self._apart = np.kron(np.ones((count, 1)), -self._mean_of_all)
        """(3 count, 3 count) readings of all modules -> how each differs from their mean, body frame."""
        for i in range(count):
            self._apart[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += self._rotations[:, i]
        self._gyro_offsets = SensorOffsets(count, 3, GYRO_BIASES, period_ns)
        self._accel_offsets = SensorOffsets(count, 3, ACCEL_BIASES, period_ns)
        self._depth_offsets = SensorOffsets(count, 1, DEPTH_BIASES, period_ns)
        self._turn = max(1, TURN_NS // period_ns)
        self._depths_m, self._depth_age = np.zeros(count), np.full(count, self._turn)
        """Last depth of each sensor, and ticks with a depth since then."""
        self._no_swing = np.zeros(3 * count)
        self._swing_of = per_s * -np.vstack([skew(r) for r in self._r_bi - self._mean_r_bi])
        """(3 count, 3) change of the rate within a tick -> by how much it lets each IMU differ from their mean."""
        self._is_still = False
        self._last_gyro: np.ndarray | None = None
        self._alpha = np.zeros(3)
        self._tags = {(int(m), int(i)): k for k, (m, i) in enumerate(zip(body.tag_module, body.tag_ids, strict=True))}
        self._levers = np.ascontiguousarray(body.r_bt)
        self._q_tb = np.array([conjugate(np.ascontiguousarray(q)) for q in body.q_bt]).reshape(-1, 4)

    def fuse(self, modules: Sequence[ModuleInputs], q_wb: np.ndarray) -> Measured:
        """One measurement of each kind.

        Args:
            modules: inputs of the whole fleet, by fleet index.
            q_wb: (4,) latest attitude, for the height of each pressure sensor above the centre of mass.
        """
        mine = [modules[i] for i in self._modules]
        gyro = self._mean([m.gyro for m in mine], self._gyro_offsets, self._no_swing if self._is_still else None)
        self._is_still = len(mine) > 1 and gyro is not None and float(gyro @ gyro) < STILL_RAD_S**2
        return Measured(gyro, self._accel([m.accel for m in mine], gyro), self._depth(mine, q_wb), self._poses(mine, q_wb))

    def _mean(self, readings: list[np.ndarray | None], offsets: SensorOffsets, swing: np.ndarray | None) -> np.ndarray | None:
        """Mean over all modules, (3,) in the body frame. Where some were not heard: what the mean of all would be, by the offsets learnt.

        Args:
            readings: of each module (3,), its own frame; None: not heard.
            swing: (3 count,) by how much the readings differ from their mean because of the body's motion: what is left are offsets, and
                these are learnt. None: not known, and nothing is learnt.
        """
        heard = [value for value in readings if value is not None]
        if not heard:
            return None
        stacked = heard[0] if len(heard) == 1 else np.concatenate(heard)
        if len(heard) < len(readings):
            which = [value is not None for value in readings]
            return np.asarray(self._rotations[:, which].reshape(3, -1) @ stacked / len(heard) - offsets.of(which))
        if swing is not None:
            offsets.learn((self._apart @ stacked - swing).reshape(-1, 3))
        return np.asarray(self._mean_of_all.dot(stacked))

    def _accel(self, readings: list[np.ndarray | None], gyro: np.ndarray | None) -> np.ndarray | None:
        """Mean specific force (3,) less what turning adds at the mean place of those heard, as far as a gyro tells it."""
        swing, heard = self._swing(gyro), [value is not None for value in readings]
        accel = self._mean(readings, self._accel_offsets, swing)
        if not self._centred or len(heard) > 1:
            self._follow(gyro)
        if accel is None or gyro is None or (self._centred and all(heard)):
            return accel
        lever = self._lever(heard)
        return np.asarray(accel - cross(self._alpha, lever) - cross(gyro, cross(gyro, lever)))

    def _swing(self, gyro: np.ndarray | None) -> np.ndarray | None:
        """(3 count,) by how much the accelerometers differ from their mean because the body's rate changes, m/s^2; None unless the body is
        nearly still, for else its rate counts too.

        Taken from the gyro's change in the last tick, unsmoothed: its noise is large, but cancels in the mean over many ticks by which
        offsets are learnt, and it does not lag.
        """
        if not self._is_still or gyro is None or self._last_gyro is None:
            return None
        return np.asarray(self._swing_of @ (gyro - self._last_gyro))

    def _follow(self, gyro: np.ndarray | None) -> None:
        """Keeps the angular acceleration, rad/s^2: the gyro's change from tick to tick, smoothed; from zero after a tick without gyro."""
        if gyro is None or self._last_gyro is None:
            self._alpha = np.zeros(3)
        else:
            self._alpha = self._alpha + self._gain * (gyro - self._last_gyro) - self._share * self._alpha
        self._last_gyro = gyro

    def _lever(self, heard: list[bool]) -> np.ndarray:
        """(3,) mean place of the sensors that were heard, from the centre of mass, body frame."""
        return self._mean_r_bi if all(heard) else np.asarray(self._r_bi[heard].mean(axis=0))

    def _depth(self, mine: list[ModuleInputs], q_wb: np.ndarray) -> float | None:
        heard = [m.pressure_pa for m in mine if m.pressure_pa is not None]
        if not heard:
            return None
        which, down = [m.pressure_pa is not None for m in mine], to_matrix(q_wb)[2]
        pressure, below = sum(heard) / len(heard), float(self._lever(which).dot(down))
        depth_m = (pressure - ATMOSPHERE_PA) / (WATER_DENSITY * GRAVITY) - below
        if len(mine) > 1:
            each_m = (np.array(heard) - ATMOSPHERE_PA) / (WATER_DENSITY * GRAVITY) - self._r_bi[which] @ down
            depth_m -= self._depth_offset(which, each_m)
        return depth_m

    def _depth_offset(self, which: list[bool], each_m: np.ndarray) -> float:
        """What is to be taken off the mean of the sensors that were heard in this tick, m: where some have fallen silent, by how much it is
        off the mean of all. 0 while none has: healthy ones come in turns, a few ticks apart, and the estimator learns their mean's bias.

        Args:
            which: of each module of the body, whether its sensor was heard. each_m: (heard,) what those tell of the centre of mass.
        """
        self._depth_age += 1
        self._depth_age[which], self._depths_m[which] = 0, each_m
        if self._depth_age.max() > self._turn:
            return float(self._depth_offsets.of(which)[0])
        if self._is_still:
            self._depth_offsets.learn((self._depths_m - self._depths_m.mean()).reshape(-1, 1))
        return 0.0

    def _poses(self, mine: list[ModuleInputs], q_wb: np.ndarray) -> list[BodyPose]:
        """One pose for each picture, oldest first."""
        pictures: dict[int, Seen] = {}
        for index, module in enumerate(mine):
            for tag in module.tags:
                known = self._tags.get((index, tag.tag_id))
                if known is not None:
                    pictures.setdefault(tag.capture_ns, []).append((tag, known))
        return [self._one_pose(capture, seen, q_wb) for capture, seen in sorted(pictures.items())]

    def _one_pose(self, capture_ns: int, seen: Seen, q_wb: np.ndarray) -> BodyPose:
        """Weighted mean of the tags of one picture; those that stand alone against the others are left out as flipped."""
        if len(seen) == 1:
            tag, k = seen[0]
            return BodyPose(capture_ns, tag.p_wt, self._levers[k], multiply(tag.q_wt, self._q_tb[k]), _weight(tag))
        p_wt, q_wt = (np.concatenate(parts).reshape(len(seen), -1) for parts in ([t.p_wt for t, _ in seen], [t.q_wt for t, _ in seen]))
        known, weights = np.array([k for _, k in seen]), np.array([_weight(tag) for tag, _ in seen])
        mean_p_wt, lever, attitude = np.zeros(3), np.zeros(3), np.zeros(4)
        weight = fuse_picture(p_wt, q_wt, self._levers[known], self._q_tb[known], weights, q_wb, mean_p_wt, lever, attitude)
        return BodyPose(capture_ns, mean_p_wt, lever, attitude, weight)


def _weight(tag: TagObservation) -> float:
    """How many tags of full quality an observation is worth."""
    return SECOND_HAND_WEIGHT if tag.quality == SECOND_HAND else 1.0


@njit(f"float64({M},{M},{M},{M},{V},{V},{V},{V},{V})", cache=True)
def fuse_picture(p_wt, q_wt, levers, q_tb, weights, q_near, mean_p_wt, mean_lever, mean_q_wb):  # type: ignore[no-untyped-def]
    """Writes the weighted means of the largest group of tags that agree on the attitude; of equal groups of the one nearest to `q_near`.

    Args:
        p_wt, q_wt: (k, 3), (k, 4) poses of the tags in the world; levers, q_tb: their places in the body, body frame to
            tag frame; weights: (k,), positive.
        mean_p_wt, mean_lever, mean_q_wb: are written, (3,), (3,), (4,).

    Returns the weight of the group.
    """
    count = p_wt.shape[0]
    q_wb = np.empty((count, 4))
    for i in range(count):
        q_wb[i] = multiply(q_wt[i], q_tb[i])
    agreement = np.abs(q_wb @ q_wb.T) > math.cos(0.5 * FLIP_RAD)
    group = agreement[np.argmax(agreement.sum(axis=1) + 0.5 * np.abs(q_wb @ q_near))]
    first = np.argmax(group * weights)  # the heaviest of the group: the others' turns count from it
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
