"""Sources of set-points: trajectories that are sampled, and a glider that moves smoothly to a place or at a speed.

Used by `guidance_modes`, stage 5 of a tick.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit

from firmware_py.core.rotations import V, difference, exp, multiply, normalise, rotate
from firmware_py.core.types import Estimate, Setpoint

LOOP_SHARE = 4.0 / 27.0
"""Position gain over the bandwidth of the speed filter: at this value s (s + w)^2 + k w^2 has a double real root."""


LEASH_M = 1.0
"""Largest distance, per axis, between the body and a set-point that moves at a given speed. If the body cannot reach that speed, or is held
back, the set-point would run away, and the body would follow it long after it was told to stop. The shipped gains ask a module for its
full force in its worst direction (22.9 N) at 0.14 m, so a longer leash would not make it any faster."""
LEASH_RAD = 2.0
"""The same for an attitude that turns at a given rate: more than half a turn ahead of a held body, it would turn the body backwards."""


class Trajectory(Protocol):
    """A motion over time. Built by `prepare.paths` and `prepare.minimum_snap`; sampled in the tick, any number of times."""

    @property
    def duration_s(self) -> float:
        """Time from start to end."""
        ...

    def sample(self, t_s: float) -> Setpoint:
        """The set-point at `t_s`; at rest at the ends before 0 and after `duration_s`."""
        ...


def as_setpoint(x: np.ndarray) -> Setpoint:
    """A Setpoint of views into the array (19,) p, q, v, w, a, alpha that compiled functions write."""
    return Setpoint(x[0:3], x[3:7], x[7:10], x[10:13], x[13:16], x[16:19])


def rest_at(p_wb: np.ndarray, q_wb: np.ndarray) -> Setpoint:
    """The set-point that stands still at a pose."""
    zero = np.zeros(3)
    return Setpoint(np.ascontiguousarray(p_wb), np.ascontiguousarray(q_wb), zero, zero, zero, zero)


def at_estimate(estimate: Estimate) -> Setpoint:
    """The set-point at the estimated pose and velocity, without acceleration."""
    v_w = np.asarray(rotate(estimate.q_wb, np.ascontiguousarray(estimate.nu[:3])))
    zero = np.zeros(3)
    return Setpoint(estimate.p_wb.copy(), estimate.q_wb.copy(), v_w, estimate.nu[3:].copy(), zero, zero)


class Wish(NamedTuple):
    """Target of a glider: velocities, and optionally a place and an attitude."""

    v_w: np.ndarray
    """(3,) velocity, world; added to the velocity that leads to `p_wb`."""
    w_b: np.ndarray
    """(3,) turning rate, body; added to the rate that leads to `q_wb`."""
    p_wb: np.ndarray | None = None
    """(3,) place, or None: velocity only. An axis that is NaN moves by velocity only."""
    q_wb: np.ndarray | None = None
    """(4,) attitude, or None: rate only."""
    rate_rad_s: float | None = None
    """Largest turning rate to `q_wb`; None: the glider's."""


REST = Wish(np.zeros(3), np.zeros(3))
"""Wish to come to rest, at any place."""
UNKNOWN = np.full(4, np.nan)
"""Stands for no place or no attitude."""


@njit(f"{V}({V},float64)", cache=True)
def limited(vector, size):  # type: ignore[no-untyped-def]
    """`vector` (3,), shortened to the length `size` if it is longer."""
    norm = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    return vector.copy() if norm <= size else vector * (size / norm)


@njit(cache=True)
def _follow(v, a, wanted, w, dt):  # type: ignore[no-untyped-def]
    """Speed, acceleration and distance after `dt`: exact step response of v'' = w^2 (wanted - v) - 2 w v'."""
    decay = math.exp(-w * dt)
    gap = v - wanted
    slope = a + w * gap
    new_gap = (gap + slope * dt) * decay
    new_a = (a - w * slope * dt) * decay
    # integral of (gap + slope t) e^(-wt) from 0 to dt
    way = wanted * dt + gap * ((1.0 - decay) / w) + slope * ((1.0 - decay * (1.0 + w * dt)) / w**2)
    return wanted + new_gap, new_a, way


@njit(f"void({V},{V},{V},{V},{V},{V},{V},{V},{V},{V},float64,float64,float64,float64,{V})", cache=True)
def _glide(p, q, v, w, a, alpha, wish_v, wish_w, place, attitude, bandwidth, speed, rate, dt, out):  # type: ignore[no-untyped-def]
    """Writes the set-point (p, q, v, w, a, alpha: as Setpoint) after `dt` to `out` (19,). Axes that are NaN move by velocity only."""
    gain = bandwidth * LOOP_SHARE
    gap, turn = np.zeros(3), np.zeros(3)
    for i in range(3):
        gap[i] = 0.0 if math.isnan(place[i]) else gain * (place[i] - p[i])
    if not math.isnan(attitude[0]):
        turn = gain * difference(attitude, q)
    wanted_v, wanted_w = wish_v + limited(gap, speed), wish_w + limited(turn, rate)
    out[7:10], out[13:16], way = _follow(v, a, wanted_v, bandwidth, dt)
    out[10:13], out[16:19], turned = _follow(w, alpha, wanted_w, bandwidth, dt)
    out[:3] = p + way
    out[3:7] = normalise(multiply(q, exp(turned)))


def way_to_rest_s(bandwidth: float) -> float:
    """Way that a set-point at speed, without acceleration, covers until it rests, over that speed, s: the integral of `_follow`'s response.
    `bandwidth`: rad/s.
    """
    return 2.0 / bandwidth


class Glider:
    """A set-point that changes speed smoothly: position, attitude and their first two derivatives jump only on `put`.

    Speed and rate follow the wish through a critically damped second-order filter.
    """

    def __init__(self, bandwidth: float, speed: float, rate: float) -> None:
        self.retune(bandwidth, speed, rate)
        self.at = rest_at(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def retune(self, bandwidth: float, speed: float, rate: float) -> None:
        """Changes bandwidth, rad/s, largest speed, m/s, and largest turning rate, rad/s, from now on."""
        self._w, self._speed, self._rate = bandwidth, speed, rate

    def put(self, setpoint: Setpoint) -> None:
        """Sets the state to `setpoint`."""
        self.at = setpoint

    def step(self, wish: Wish, dt_s: float) -> Setpoint:
        """Advances by `dt_s` towards `wish`; returns the new set-point."""
        out = np.empty(19)
        rate = self._rate if wish.rate_rad_s is None else wish.rate_rad_s
        place = UNKNOWN if wish.p_wb is None else np.ascontiguousarray(wish.p_wb)
        attitude = UNKNOWN if wish.q_wb is None else np.ascontiguousarray(wish.q_wb)
        _glide(*self.at, wish.v_w, wish.w_b, place, attitude, self._w, self._speed, rate, dt_s, out)
        self.at = as_setpoint(out)
        return self.at


def on_leash(setpoint: Setpoint, estimate: Estimate) -> Setpoint:
    """The set-point with place and attitude limited to LEASH_M and LEASH_RAD from the body."""
    return setpoint._replace(p_wb=leashed(setpoint.p_wb, estimate.p_wb), q_wb=leashed_turn(setpoint.q_wb, estimate.q_wb))


def leashed(place: np.ndarray, p_wb: np.ndarray) -> np.ndarray:
    """The place (3,), limited along each axis to LEASH_M from the body at `p_wb` (3,)."""
    return np.asarray(np.clip(place, p_wb - LEASH_M, p_wb + LEASH_M))


def leashed_turn(attitude: np.ndarray, q_wb: np.ndarray) -> np.ndarray:
    """The attitude (4,), limited to a turn of LEASH_RAD from the body at `q_wb` (4,)."""
    turn = difference(attitude, q_wb)
    return attitude if turn @ turn <= LEASH_RAD**2 else np.asarray(normalise(multiply(q_wb, exp(limited(turn, LEASH_RAD)))))


def ahead_of(setpoint: Setpoint, lead_s: float) -> Setpoint:
    """The set-point `lead_s` ahead, by its own derivatives. Place and attitude stay, as no feed-forward depends on them."""
    return setpoint._replace(v_w=setpoint.v_w + lead_s * setpoint.a_w, w_b=setpoint.w_b + lead_s * setpoint.alpha_b)
