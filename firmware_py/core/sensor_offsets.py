"""Offset of each module's sensor from the mean over the body, so that the mean does not jump when some sensors fall silent.

Every sensor has its own bias. The estimator slowly learns the bias of their mean. When some sensors fall silent, the mean of the others
has a different bias: the robot would mistake the jump for a push, and lean and drift until it has learnt the new bias.
"""

from __future__ import annotations

import numpy as np

REMEMBERED_S = 30.0
"""Averaging time of the differences. Within it, biases walk by less than a tenth of their differences."""


class SensorOffsets:
    """Offsets of one kind of sensor."""

    def __init__(self, modules: int, numbers: int, most: float, period_ns: int) -> None:
        """`numbers`: length of a reading. `most`: no two biases differ by more. `period_ns`: time between two readings."""
        self._most = most
        self._longest = max(1, round(REMEMBERED_S * 1e9 / period_ns))
        self._count = 0
        self._offsets = np.zeros((modules, numbers))

    def learn(self, differences: np.ndarray) -> None:
        """Updates the offsets with one tick's `differences` (modules, numbers) of each reading from the mean of all, in the body's axes.

        A difference larger than any bias indicates a failed sensor, which spoils the mean, so nothing is learnt from that tick.
        """
        if float(np.abs(differences).max()) > self._most:
            return
        self._count = min(self._count + 1, self._longest)
        self._offsets += (differences - self._offsets) / self._count

    def mean_offset(self, heard: list[bool]) -> np.ndarray:
        """(numbers,) offset of the mean of the sensors in `heard` from the mean of all."""
        return np.asarray(self._offsets[heard].mean(axis=0))
