"""How the sensors of each module differ from the mean of the body's, so that the mean does not jump when some of them fall silent.

Every sensor has a bias of its own. The estimator slowly learns the bias of their mean. When some fall silent, the mean of the others has
another bias: the robot would take the jump for a push, and lean and drift until it has learnt the new one.
"""

from __future__ import annotations

import numpy as np

REMEMBERED_S = 30.0
"""Over which differences are averaged: biases walk by less than a tenth of how much they differ in that time."""


class SensorOffsets:
    """Of one kind of sensor."""

    def __init__(self, modules: int, numbers: int, most: float, period_ns: int) -> None:
        """For readings of so many numbers each. `most`: no two biases differ by more. `period_ns`: between two readings."""
        self._most = most
        self._longest = max(1, round(REMEMBERED_S * 1e9 / period_ns))
        self._count = 0
        self._offsets = np.zeros((modules, numbers))

    def learn(self, differences: np.ndarray) -> None:
        """Takes what one tick tells: (modules, numbers), by how much each reading differs from the mean of all, in the body's axes.

        A difference that is larger than any bias shows a sensor that has failed; it spoils the mean, so nothing is learnt from that tick.
        """
        if float(np.abs(differences).max()) > self._most:
            return
        self._count = min(self._count + 1, self._longest)
        self._offsets += (differences - self._offsets) / self._count

    def of(self, heard: list[bool]) -> np.ndarray:
        """(numbers,) by how much the mean of those that were heard is off the mean of all."""
        return np.asarray(self._offsets[heard].mean(axis=0))
