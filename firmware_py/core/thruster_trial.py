"""Gives a thruster back that the motion alone convicted, if the wrench that it was blamed for is still missing without it. Part of
`missing_thrust`.

A wall, a hand or a rope may push just as the loss of one thruster would. The two differ once that thruster is left out: the lost force of
a liar is then no longer commanded, so it is no longer missed, while the push of a wall stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

SETTLE, JUDGED = 5, 10
"""Numbers of blocks after a thruster was left out: those that thruster lag and controller need to settle, and those then averaged."""
PATIENCE = 2 * (SETTLE + JUDGED)
"""Blocks after which a trial ends without acquittal, because too many of them told nothing."""
DISTINCT = 9.0
"""Least squared distance, in sigmas, between the outcomes for a wall and for a liar. Closer ones cannot be told apart, and the thruster
stays left out."""


class ThrusterTrial:
    """The trial of one thruster that was left out."""

    def __init__(self, thruster: int, base: np.ndarray, wall: np.ndarray, liar: Sequence[np.ndarray], sigma: np.ndarray) -> None:
        """Begins when `thruster` is left out.

        Args:
            base: (6,) wrench residual before the change that the thruster was blamed for, N and N m, body frame.
            wall: (6,) what the residual will differ from that if something else pushes: the same change.
            liar: the same, (6,) each, for every way in which the thruster may have lied.
            sigma: (6,) standard deviation of the residual of a healthy body.
        """
        self.thruster = thruster
        self.base, self._sigma = base, sigma
        self._wall, self._liar = wall / sigma, np.array(liar).reshape(-1, 6) / sigma
        self._seen: list[np.ndarray] = []
        self._blocks = 0

    def again(self, thruster: int, moved: np.ndarray, base: np.ndarray, sigma: np.ndarray) -> ThrusterTrial:
        """Returns the same trial at its beginning, in another body (trial_handover).

        Args:
            thruster: its number there.
            moved: (6, 6) matrix that takes a wrench from this body to that one.
            base, sigma: those of that body.
        """
        return ThrusterTrial(thruster, base, moved @ (self._wall * self._sigma), [moved @ (way * self._sigma) for way in self._liar], sigma)

    def is_innocent(self, residual: np.ndarray | None) -> bool | None:
        """Judges by the residual (6,) of one more block, None where that could not be measured; returns None while there are too few.

        With the same noise in every outcome, the nearest one is the most likely.
        """
        self._blocks += 1
        if residual is not None:
            self._seen.append((residual - self.base) / self._sigma)
        if len(self._seen) < SETTLE + JUDGED:
            return False if self._blocks >= PATIENCE else None
        outcome = np.mean(self._seen[SETTLE:], axis=0)
        is_wall = np.sum((outcome - self._wall) ** 2) < np.sum((outcome - self._liar) ** 2, axis=1)
        return bool(np.all(is_wall & (np.sum((self._wall - self._liar) ** 2, axis=1) >= DISTINCT)))
