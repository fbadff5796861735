"""What a set-point is made of: trajectories that are sampled, and a glider that moves smoothly to a place or by a speed.

Used by `guidance_modes`, stage 4 of a tick.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from firmware_py.core.rotations import difference, exp, multiply, normalise, rotate
from firmware_py.core.types import Estimate, Setpoint

LOOP_SHARE = 4.0 / 27.0
"""Gain of the way over the bandwidth of the speed: s (s + w)^2 + k w^2 has a double real root just there."""


class Trajectory(Protocol):
    """A motion over time. Built by `prepare.paths`; sampled in the tick."""

    @property
    def duration_s(self) -> float:
        """Time from start to end."""
        ...

    def sample(self, t_s: float) -> Setpoint:
        """The set-point at `t_s`; before 0 and after `duration_s` it rests at the ends."""
        ...


def rest_at(p_wb: np.ndarray, q_wb: np.ndarray) -> Setpoint:
    """Standing still."""
    zero = np.zeros(3)
    return Setpoint(np.ascontiguousarray(p_wb), np.ascontiguousarray(q_wb), zero, zero, zero, zero)


def at_estimate(estimate: Estimate) -> Setpoint:
    """Moving as the body is believed to move, without acceleration."""
    v_w = np.asarray(rotate(estimate.q_wb, np.ascontiguousarray(estimate.nu[:3])))
    zero = np.zeros(3)
    return Setpoint(estimate.p_wb.copy(), estimate.q_wb.copy(), v_w, estimate.nu[3:].copy(), zero, zero)


class Wish(NamedTuple):
    """Where a glider is to go."""

    v_w: np.ndarray
    """(3,) speed, world; added to what leads to `p_wb`."""
    w_b: np.ndarray
    """(3,) turning rate, body; added to what leads to `q_wb`."""
    p_wb: np.ndarray | None = None
    """(3,) place, or None: speed alone. An axis that is NaN goes by speed alone."""
    q_wb: np.ndarray | None = None
    """(4,) attitude, or None: rate alone."""


class Glider:
    """A set-point that takes up speeds smoothly: position, attitude and their first two derivatives never jump but when it is put.

    Speed and rate follow what is wished through a critically damped filter of second order.
    """

    def __init__(self, bandwidth: float, speed: float, rate: float) -> None:
        self._w = bandwidth
        self._speed, self._rate = speed, rate
        self.at = rest_at(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def put(self, setpoint: Setpoint) -> None:
        """Go on from `setpoint`."""
        self.at = setpoint

    def step(self, wish: Wish, dt_s: float) -> Setpoint:
        """Moves on by `dt_s`."""
        at, k = self.at, self._w * LOOP_SHARE
        v = wish.v_w
        if wish.p_wb is not None:
            gap = wish.p_wb - at.p_wb
            v = v + limited(k * np.where(np.isnan(gap), 0.0, gap), self._speed)
        w = wish.w_b
        if wish.q_wb is not None:
            w = w + limited(k * np.asarray(difference(np.ascontiguousarray(wish.q_wb), at.q_wb)), self._rate)
        v_w, a_w, way = self._follow(at.v_w, at.a_w, v, dt_s)
        w_b, alpha_b, turn = self._follow(at.w_b, at.alpha_b, w, dt_s)
        self.at = Setpoint(at.p_wb + way, normalise(multiply(at.q_wb, exp(turn))), v_w, w_b, a_w, alpha_b)
        return self.at

    def _follow(self, v: np.ndarray, a: np.ndarray, wanted: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
        """Speed, acceleration and way after `dt`: exact answer of v'' = w^2 (wanted - v) - 2 w v' to a step."""
        w = self._w
        decay = np.exp(-w * dt)
        gap = v - wanted
        slope = a + w * gap
        new_gap = (gap + slope * dt) * decay
        new_a = (a - w * slope * dt) * decay
        # integral of (gap + slope t) e^(-wt) from 0 to dt
        way = wanted * dt + gap * (1.0 - decay) / w + slope * (1.0 - decay * (1.0 + w * dt)) / w**2
        return wanted + new_gap, new_a, way


def limited(vector: np.ndarray, size: float) -> np.ndarray:
    """`vector`, shortened to `size`."""
    norm = float(np.linalg.norm(vector))
    return vector if norm <= size else vector * (size / norm)


def ahead_of(setpoint: Setpoint, lead_s: float) -> Setpoint:
    """The set-point `lead_s` later, by its own derivatives; place and attitude, which feed nothing forward, stay."""
    return setpoint._replace(v_w=setpoint.v_w + lead_s * setpoint.a_w, w_b=setpoint.w_b + lead_s * setpoint.alpha_b)
