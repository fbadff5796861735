"""Stage 1 of a tick: the sensors of all modules of a body become one set of measurements in the body frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.observation import GRAVITY
from firmware_py.core.rotations import M, V, conjugate, difference, exp, multiply, to_matrix
from firmware_py.core.types import BodyPose, Measured, ModuleInputs, TagObservation

WATER_DENSITY = 1000.0
"""kg/m^3, fresh water."""
ATMOSPHERE_PA = 101_325.0
"""Standard atmosphere; what the weather adds is the estimator's depth bias."""
FLIP_RAD = 0.35
"""Tags of one picture that disagree with their median by more are flipped and left out (20 deg; noise is 0.5)."""

SECOND_HAND = 0
"""Quality of a tag whose place was told through another one, by a camera that a module carries: the other's errors add to its own."""
SECOND_HAND_WEIGHT = 1.0 / 9.0
"""What such a tag is worth: half a degree of the carrier over half a metre is three times a tag's own noise."""


Seen = list[tuple[TagObservation, int]]
"""Tags of one picture, and which of the body's tags each is."""


class Measurements:
    """Fuses what the modules of one body say. Holds nothing but geometry."""

    def __init__(self, body: Body) -> None:
        self._modules = body.modules
        self._rotations = np.stack([to_matrix(np.ascontiguousarray(q)) for q in body.q_bm], axis=1)
        self._mean_of_all = self._rotations.reshape(3, -1) / len(body.modules)
        self._r_bi, self._mean_r_bi = body.r_bi, body.r_bi.mean(axis=0)
        self._tags = {(int(m), int(i)): k for k, (m, i) in enumerate(zip(body.tag_module, body.tag_ids, strict=True))}
        self._levers = np.ascontiguousarray(body.r_bt)
        self._q_tb = np.array([conjugate(np.ascontiguousarray(q)) for q in body.q_bt]).reshape(-1, 4)

    def fuse(self, modules: Sequence[ModuleInputs], q_wb: np.ndarray, frozen: Sequence[bool] = ()) -> Measured:
        """One measurement of each kind.

        Args:
            modules: inputs of the whole fleet, by fleet index.
            q_wb: (4,) latest attitude, for the height of each pressure sensor above the centre of mass.
            frozen: of each module of the body, whether its IMU is left out; empty: none is.
        """
        mine = [modules[i] for i in self._modules]
        gyros, accels = [m.gyro for m in mine], [m.accel for m in mine]
        if any(frozen):
            gyros = [None if still else value for still, value in zip(frozen, gyros, strict=True)]
            accels = [None if still else value for still, value in zip(frozen, accels, strict=True)]
        gyro, accel = self._mean(gyros), self._mean(accels)
        return Measured(gyro, accel, self._depth(mine, q_wb), self._poses(mine, q_wb))

    def _mean(self, readings: list[np.ndarray | None]) -> np.ndarray | None:
        """Mean over the modules that were heard, body frame."""
        heard = [value for value in readings if value is not None]
        if not heard:
            return None
        mean = self._mean_of_all
        if len(heard) < len(readings):
            mean = self._rotations[:, [value is not None for value in readings]].reshape(3, -1) / len(heard)
        return np.asarray(mean @ (heard[0] if len(heard) == 1 else np.concatenate(heard)))

    def _depth(self, mine: list[ModuleInputs], q_wb: np.ndarray) -> float | None:
        heard = [m.pressure_pa for m in mine if m.pressure_pa is not None]
        if not heard:
            return None
        lever = self._mean_r_bi
        if len(heard) < len(mine):
            lever = self._r_bi[[m.pressure_pa is not None for m in mine]].mean(axis=0)
        pressure, below = sum(heard) / len(heard), float(lever @ to_matrix(q_wb)[2])
        return (pressure - ATMOSPHERE_PA) / (WATER_DENSITY * GRAVITY) - below

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
        """Mean of the tags of one picture; those that stand alone against the others are left out as flipped."""
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
    """Writes the means of the largest group of tags that agree on the attitude; of equal groups of the one nearest to `q_near`.

    Args:
        p_wt, q_wt: (k, 3), (k, 4) poses of the tags in the world; levers, q_tb: their places in the body, body frame to
            tag frame; weights: (k,).
        mean_p_wt, mean_lever, mean_q_wb: are written, (3,), (3,), (4,).

    Returns the weight of the group.
    """
    count = p_wt.shape[0]
    q_wb = np.empty((count, 4))
    for i in range(count):
        q_wb[i] = multiply(q_wt[i], q_tb[i])
    agreement = np.abs(q_wb @ q_wb.T) > math.cos(0.5 * FLIP_RAD)
    group = agreement[np.argmax(agreement.sum(axis=1) + 0.5 * np.abs(q_wb @ q_near))]
    reference, size, weight, turn = q_wb[np.argmax(group)], np.sum(group), 0.0, np.zeros(3)
    for i in range(count):
        if group[i]:
            turn += difference(q_wb[i], reference) / size
            mean_p_wt += p_wt[i] / size
            mean_lever += levers[i] / size
            weight += weights[i]
    mean_q_wb[:] = multiply(reference, exp(turn))
    return weight
