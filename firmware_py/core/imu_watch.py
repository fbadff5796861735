"""Notices an inertial sensor that repeats its last sample: noise never does that for long. Stands before stage 1 of a tick.

What it finds frozen is not measured with; the body flies on by tags, depth and its model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from firmware_py.core.topology import in_both
from firmware_py.core.types import ModuleInputs

REPEATS = 10
"""Samples in a row that are the same in all six numbers. A quiet sensor of one count of noise does that once in a day of 100 Hz."""


class ImuWatch:
    """Watches the IMUs of one body.

    Attributes:
        frozen: of each module, whether its IMU is not to be believed now.
    """

    def __init__(self, modules: Sequence[int]) -> None:
        self._modules = tuple(modules)
        self._last: list[tuple[bytes, np.ndarray]] = [(b"", np.zeros(0))] * len(self._modules)
        self._repeats = [0] * len(self._modules)
        self.frozen = [False] * len(self._modules)

    def take_over(self, before: Sequence[ImuWatch]) -> None:
        """Goes on from the bodies that this one is made of, or was part of."""
        for other in before:
            for i, j in in_both(self._modules, other._modules):
                self._last[i], self._repeats[i], self.frozen[i] = other._last[j], other._repeats[j], other.frozen[j]

    def step(self, modules: Sequence[ModuleInputs]) -> bool:
        """Whether any IMU that is to be believed gave a sample in this tick. `modules`: by fleet index."""
        heard = False
        for i, index in enumerate(self._modules):
            gyro, accel = modules[index].gyro, modules[index].accel
            if gyro is None or accel is None:
                continue
            rate, (last_rate, last_accel) = gyro.tobytes(), self._last[i]
            repeats = rate == last_rate and accel.tobytes() == last_accel.tobytes()
            self._repeats[i] = self._repeats[i] + 1 if repeats else 0
            self._last[i] = rate, accel
            self.frozen[i] = self._repeats[i] >= REPEATS
            heard = heard or not self.frozen[i]
        return heard
