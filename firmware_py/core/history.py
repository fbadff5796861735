"""The estimator's buffer of the last half second: per tick the thruster wrench and the inertial and depth
measurements.
"""

from __future__ import annotations

import numpy as np

WINDOW_NS = 500_000_000
"""Length of the buffer. The bus already refuses older tag poses."""


class History:
    """Ring buffer of samples, one per tick, stored twice so that the newest k are always one contiguous slice."""

    def __init__(self, period_ns: int) -> None:
        self.period_ns = period_ns
        self.length = WINDOW_NS // period_ns + 2
        self._tau = np.zeros((2 * self.length, 6))
        self._gyro = np.full((2 * self.length, 3), np.nan)
        self._accel_depth = np.full((2 * self.length, 4), np.nan)
        self.newest = -1
        """Index of the newest sample, counted from the start."""
        self.newest_ns = 0

    def push(
        self, time_ns: int, tau: np.ndarray, gyro: np.ndarray | None, accel: np.ndarray | None, depth_m: float | None
    ) -> None:
        """Appends the sample of the tick at `time_ns`. Fills skipped ticks with the same wrench and no
        measurements.
        """
        periods = (time_ns - self.newest_ns + self.period_ns // 2) // self.period_ns  # rounded: a tick may be early or late
        missed = min(periods - 1, self.length) if self.newest >= 0 else 0
        for _ in range(missed):
            self._write(self.newest_ns + self.period_ns, tau, None, None, None)
        self._write(time_ns, tau, gyro, accel, depth_m)

    def _write(
        self, time_ns: int, tau: np.ndarray, gyro: np.ndarray | None, accel: np.ndarray | None, depth_m: float | None
    ) -> None:
        self.newest += 1
        self.newest_ns = time_ns
        both = slice(self.newest % self.length, None, self.length)
        self._tau[both] = tau
        self._gyro[both] = np.nan if gyro is None else gyro
        self._accel_depth[both, :3] = np.nan if accel is None else accel
        self._accel_depth[both, 3] = np.nan if depth_m is None else depth_m

    def forget_depths(self, depth_m: float, most_m: float) -> None:
        """Drops the kept depth readings that differ from a depth by more than `most_m`, both m: no estimate judged them when they came."""
        self._accel_depth[np.abs(self._accel_depth[:, 3] - depth_m) > most_m, 3] = np.nan

    def time_of(self, index: int) -> int:
        """Returns the time of sample `index`, ns, counted back from the newest at the nominal period."""
        return self.newest_ns - (self.newest - index) * self.period_ns

    def first_after(self, time_ns: int) -> int:
        """Returns the index of the first stored sample later than `time_ns`; one beyond the newest if none is later."""
        later = (self.newest_ns - time_ns - 1) // self.period_ns + 1 if time_ns < self.newest_ns else 0
        return self.newest + 1 - min(later, self.length)

    def since(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns wrenches (k, 6), gyro readings (k, 3), and accelerometer and depth (k, 4) of the samples from `index` to the newest."""
        last = self.newest % self.length + self.length + 1
        first = last - (self.newest - index + 1)
        return self._tau[first:last], self._gyro[first:last], self._accel_depth[first:last]
