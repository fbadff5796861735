"""Stage 1 of a tick: the sensors of all modules of a body become one set of measurements in the body frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.observation import GRAVITY
from firmware_py.core.rotations import conjugate, difference, exp, multiply, to_matrix
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


class Measurements:
    """Fuses what the modules of one body say. Holds nothing but geometry."""

    def __init__(self, body: Body) -> None:
        self._modules = body.modules
        self._rotations = [to_matrix(np.ascontiguousarray(q)) for q in body.q_bm]
        self._r_bi = body.r_bi
        self._tags = {
            (int(m), int(i)): (np.ascontiguousarray(r), conjugate(np.ascontiguousarray(q)))
            for m, i, r, q in zip(body.tag_module, body.tag_ids, body.r_bt, body.q_bt, strict=True)
        }

    def fuse(self, modules: Sequence[ModuleInputs], q_wb: np.ndarray) -> Measured:
        """One measurement of each kind.

        Args:
            modules: inputs of the whole fleet, by fleet index.
            q_wb: (4,) latest attitude, for the height of each pressure sensor above the centre of mass.
        """
        mine = [modules[i] for i in self._modules]
        gyro, accel = self._mean([m.gyro for m in mine]), self._mean([m.accel for m in mine])
        return Measured(gyro, accel, self._depth(mine, q_wb), self._poses(mine, q_wb))

    def _mean(self, readings: list[np.ndarray | None]) -> np.ndarray | None:
        """Mean over the modules that were heard, body frame."""
        total: np.ndarray | None = None
        heard = 0
        for rotation, value in zip(self._rotations, readings, strict=True):
            if value is not None:
                turned = rotation @ value
                total = turned if total is None else total + turned
                heard += 1
        return None if total is None else total / heard

    def _depth(self, mine: list[ModuleInputs], q_wb: np.ndarray) -> float | None:
        heard = [(i, m.pressure_pa) for i, m in enumerate(mine) if m.pressure_pa is not None]
        if not heard:
            return None
        down_b = to_matrix(q_wb)[2]
        below = sum(float(self._r_bi[i] @ down_b) for i, _ in heard) / len(heard)
        pressure = sum(p for _, p in heard) / len(heard)
        return (pressure - ATMOSPHERE_PA) / (WATER_DENSITY * GRAVITY) - below

    def _poses(self, mine: list[ModuleInputs], q_wb: np.ndarray) -> list[BodyPose]:
        """One pose for each picture, oldest first."""
        pictures: dict[int, list[tuple[TagObservation, np.ndarray, np.ndarray]]] = {}
        for index, module in enumerate(mine):
            for tag in module.tags:
                known = self._tags.get((index, tag.tag_id))
                if known is not None:
                    pictures.setdefault(tag.capture_ns, []).append((tag, known[0], multiply(tag.q_wt, known[1])))
        return [_one_pose(capture, seen, q_wb) for capture, seen in sorted(pictures.items())]


Seen = list[tuple[TagObservation, np.ndarray, np.ndarray]]
"""Tag, its place in the body (3,), and the body's attitude by it (4,)."""


def _one_pose(capture_ns: int, seen: Seen, q_wb: np.ndarray) -> BodyPose:
    """Mean of the tags of one picture; those that stand alone against the others are left out as flipped."""
    if len(seen) > 1:
        seen = _agreeing(seen, q_wb)
    if len(seen) == 1:
        tag, lever, q_wb = seen[0]
        return BodyPose(capture_ns, tag.p_wt, lever, q_wb, _weight(tag))
    reference = seen[0][2]
    mean = np.mean([difference(q, reference) for _, _, q in seen], axis=0)
    q_wb = multiply(reference, exp(mean))
    p_wt = np.mean([t.p_wt for t, _, _ in seen], axis=0)
    return BodyPose(capture_ns, p_wt, np.mean([r for _, r, _ in seen], axis=0), q_wb, sum(_weight(tag) for tag, _, _ in seen))


def _weight(tag: TagObservation) -> float:
    """How many tags of full quality an observation is worth."""
    return SECOND_HAND_WEIGHT if tag.quality == SECOND_HAND else 1.0


def _agreeing(seen: Seen, q_wb: np.ndarray) -> Seen:
    """The largest group of tags that agree on the attitude; of equal groups the one nearest to the estimate `q_wb`."""
    attitudes = np.array([q for _, _, q in seen])
    agreement = np.abs(attitudes @ attitudes.T) > np.cos(0.5 * FLIP_RAD)
    votes = agreement.sum(axis=1) + 0.5 * np.abs(attitudes @ q_wb)
    return [s for s, ok in zip(seen, agreement[int(np.argmax(votes))], strict=True) if ok]
