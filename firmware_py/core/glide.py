"""A straight glide from rest to rest: how a body moves away after it was let go."""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core.types import Setpoint

GLIDE_SPEED_M_S = 0.06
"""Peak speed of a glide."""


class Glide:
    """From one set-point at rest along a vector, attitude kept; the quintic with zero velocity and acceleration at
    both ends.
    """

    def __init__(self, start: Setpoint, by_w: np.ndarray, peak_m_s: float = GLIDE_SPEED_M_S) -> None:
        """`by_w`: (3,) displacement, world, m."""
        self._start = start
        self._by_w = by_w
        # the quintic's peak speed is 15/8 of its mean
        self.duration_s = max(15.0 / 8.0 * math.sqrt(float(by_w @ by_w)) / peak_m_s, 1e-3)

    def sample(self, t_s: float) -> Setpoint:
        """The set-point at `t_s`; the ends are held."""
        u = min(max(t_s / self.duration_s, 0.0), 1.0)
        share = u**3 * (10.0 + u * (6.0 * u - 15.0))
        rate = 30.0 * (u * (1.0 - u)) ** 2 / self.duration_s
        change = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / self.duration_s**2
        start = self._start
        return start._replace(p_wb=start.p_wb + share * self._by_w, v_w=rate * self._by_w, a_w=change * self._by_w)
