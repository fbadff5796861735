"""Compares a pressure sensor with the tags, reading by picture. For `depth_gate`, which decides what follows from it.

The estimate is no witness against a sensor that drifts, because it follows the sensor: at 3 mm a reading outweighs the tags, until the
filter refuses these. The tags alone are: each accepted picture is compared with the pressure at the time of the picture, so that neither
the motion of the body nor the filter matters. What is left is the sensor's offset, with a few millimetres of noise.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numba import njit

from firmware_py.core.rotations import V

READINGS = 32
"""Readings kept, 0.64 s of DEPTH frames: the bus refuses pictures older than half a second."""
PICTURES, LATEST = 32, 8
"""Pictures whose offsets are kept, half a second, and those of them that count as the present offset."""
USUAL_OF = 600
"""Pictures over which the usual offset is averaged, ten seconds: a healthy sensor walks 0.6 mm meanwhile."""
NOISE_M = 0.005
"""Noise of the offset by one picture for which the limits below hold, that of the bench's tags; they grow with more."""
SHIFT_M = 0.012
"""Difference of the present offset from the usual one beyond which a sensor errs. On the bench healthy sensors differ by 6 mm at most."""
MOVING_M, STEADY_M = 0.010, 0.005
"""Change of the offset from one half of the pictures to the other, a quarter of a second apart, beyond which it moves (4 cm/s), and up to
which it counts as steady. Its noise is 1.8 mm; on the bench that of healthy sensors is 7 mm at most."""
MEDIAN_STEP = 0.95
"""Median of the steps between two draws of white noise, in its standard deviations: 0.674 sqrt(2)."""


class DepthDatum:
    """Offset of one pressure sensor from the depth that the tags tell. Bounded memory."""

    def __init__(self) -> None:
        self._readings: deque[tuple[int, float]] = deque(maxlen=READINGS)
        self._offsets = np.full(PICTURES, np.nan)
        """(PICTURES,) m, by the latest pictures, oldest first; NaN until there are as many."""
        self._usual_m = math.nan
        self.shift_m = self._change_m = math.nan
        """Present offset less the usual one, and change of the offset within the pictures kept, m; NaN until known."""

    @property
    def errs(self) -> bool:
        """Whether the sensor tells another depth than it used to, or one that moves away from the tags."""
        return self._is_beyond(self.shift_m, SHIFT_M) or self._is_beyond(self._change_m, MOVING_M)

    @property
    def is_steady(self) -> bool:
        """Whether the offset stays as it is, by the last half second of pictures; true while there are too few of them."""
        return not self._is_beyond(self._change_m, STEADY_M)

    def hear(self, time_ns: int, depth_m: float) -> None:
        """Keeps a reading: depth of the sensor by its pressure."""
        self._readings.append((time_ns, depth_m))

    def compare(self, capture_ns: int, depth_m: float) -> None:
        """Compares the sensor with the depth at which a picture shows it. Leaves out pictures without a reading before and after."""
        told_m = self._told_at(capture_ns)
        if math.isnan(told_m):
            return
        offset_m = told_m - depth_m
        earlier_m, later_m, present_m = append(self._offsets, offset_m)
        if math.isnan(earlier_m):
            return
        self._change_m = later_m - earlier_m
        if math.isnan(self._usual_m) and self.is_steady:
            self._usual_m = 0.5 * (earlier_m + later_m)
        self.shift_m = present_m - self._usual_m
        if not self.errs:
            self._usual_m += (offset_m - self._usual_m) / USUAL_OF

    def take_as_usual(self) -> None:
        """Counts the present offset as the usual one, if both are known."""
        self._usual_m += self.shift_m
        self.shift_m *= 0.0  # NaN stays NaN

    def _is_beyond(self, value_m: float, limit_m: float) -> bool:
        """Whether a figure is beyond its limit, which grows with the noise of the pictures kept. A NaN is not."""
        if not abs(value_m) > limit_m:
            return False
        noise_m: float = median_step(self._offsets) / MEDIAN_STEP
        return abs(value_m) > limit_m * max(1.0, noise_m / NOISE_M)

    def _told_at(self, time_ns: int) -> float:
        """Depth by the sensor at a time between two readings, m; NaN elsewhere."""
        after_ns, after_m = math.nan, math.nan
        for at_ns, depth_m in reversed(self._readings):
            if at_ns <= time_ns:
                share = (time_ns - at_ns) / (after_ns - at_ns)
                return depth_m + share * (after_m - depth_m)
            after_ns, after_m = at_ns, depth_m
        return math.nan


@njit(f"UniTuple(float64,3)({V},float64)", cache=True)
def append(offsets, newest):  # type: ignore[no-untyped-def]
    """Appends `newest`, m, to `offsets` (PICTURES,), m, which lose their oldest.

    Returns the means of the earlier half, of the later half and of the LATEST, m; NaN where they have one.
    """
    offsets[:-1] = offsets[1:]
    offsets[-1] = newest
    return offsets[: PICTURES // 2].mean(), offsets[PICTURES // 2 :].mean(), offsets[PICTURES - LATEST :].mean()


@njit(f"float64({V})", cache=True)
def median_step(offsets):  # type: ignore[no-untyped-def]
    """Median change, m, from one of `offsets` (PICTURES,), m, to the next; NaN while there are too few."""
    return np.median(np.abs(np.diff(offsets)))
