"""Gives a thruster back that the motion alone convicted, if the wrench that it was blamed for is still missing without it. Part of
`missing_thrust`.

A wall, a hand or a rope may push just as the loss of one thruster would. The two differ once that thruster is left out: the lost force of
a liar is then no longer commanded, so it is no longer missed, while the push of a wall stays.
"""

from __future__ import annotations

import numpy as np

SETTLE, JUDGED = 5, 10
"""Numbers of blocks after a thruster was left out: those that thruster lag and controller need to settle, and those then averaged."""
PERSISTS = 0.5
"""Share of the missing wrench beyond which it persists: 0 is expected of a liar, 1 of a wall, with the same noise (likelihood ratio 1)."""


class ThrusterTrial:
    """The trial of one thruster that was left out."""

    def __init__(self, thruster: int, base: np.ndarray, change: np.ndarray, sigma: np.ndarray) -> None:
        """Begins when `thruster` is left out.

        Args:
            base: (6,) wrench residual before the change, N and N m, body frame.
            change: (6,) change of the residual that the thruster was blamed for.
            sigma: (6,) standard deviation of the residual of a healthy body.
        """
        self.thruster = thruster
        self._base, self._sigma = base, sigma
        self._blamed = change / sigma
        self._remaining: list[np.ndarray] = []

    def is_innocent(self, residual: np.ndarray) -> bool | None:
        """Judges by the residual (6,) of one more block; None while there are too few."""
        self._remaining.append((residual - self._base) / self._sigma)
        if len(self._remaining) < SETTLE + JUDGED:
            return None
        remaining = np.mean(self._remaining[SETTLE:], axis=0)
        return bool(remaining @ self._blamed > PERSISTS * (self._blamed @ self._blamed))
