"""Trajectories in closed form: hold, spiral, Moebius strip, circle, Lissajous figure, line. Rest to rest.

Made before they are needed; `sample` runs in the tick and is compiled. Others (minimum_snap) are the same
`Trajectory`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from firmware_py.core import rotations
from firmware_py.core.types import Setpoint


class Trajectory(Protocol):
    """Wanted motion over time."""

    @property
    def duration_s(self) -> float:
        """Time from start to end; before and after it the ends are held."""
        ...

    def sample(self, t_s: float) -> Setpoint:
        """Wanted motion `t_s` after the start; cheap enough for a tick, any number of times."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """Stay at one pose."""

    setpoint: Setpoint
    duration_s: float = 0.0

    def sample(self, t_s: float) -> Setpoint:
        """The pose; `t_s` does not matter."""
        return self.setpoint


def hold(setpoint: Setpoint, duration_s: float = 0.0) -> Hold:
    """Stay at `setpoint`."""
    return Hold(setpoint, duration_s)


def at_rest(p_wb: Sequence[float] | np.ndarray, q_wb: Sequence[float] | np.ndarray = (1.0, 0.0, 0.0, 0.0)) -> Setpoint:
    """Set-point without motion."""
    q = rotations.normalise(np.array(q_wb, dtype=np.float64))
    return Setpoint(np.array(p_wb, dtype=np.float64), q, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))


@njit("float64[::1](float64[:,::1], float64[::1], float64, float64, float64)", cache=True)
def _harmonic(terms, head, duration, end_phase, t):  # type: ignore[no-untyped-def]
    """(19,) p, q, v, w, a, alpha in one array. `terms`, `head`: see Harmonic."""
    tau = min(max(t / duration, 0.0), 1.0)
    # Rest to rest: the septic with zero velocity, acceleration and jerk at both ends.
    s = tau**4 * (35.0 + tau * (-84.0 + tau * (70.0 - 20.0 * tau)))
    ds = 140.0 * (tau * (1.0 - tau)) ** 3 / duration
    dds = 420.0 * (tau * (1.0 - tau)) ** 2 * (1.0 - 2.0 * tau) / duration**2
    phase, rate, change = end_phase * s, end_phase * ds, end_phase * dds
    out = np.zeros(19)
    for k in range(3):
        p, dp, ddp = head[k] + head[3 + k] * phase, head[3 + k], 0.0
        for term in range(terms.shape[0]):
            if int(terms[term, 0]) == k:
                f, angle = terms[term, 2], terms[term, 2] * phase + terms[term, 3]
                p += terms[term, 1] * math.cos(angle)
                dp -= terms[term, 1] * f * math.sin(angle)
                ddp -= terms[term, 1] * f * f * math.cos(angle)
        out[k] = p
        out[7 + k] = dp * rate
        out[13 + k] = ddp * rate * rate + dp * change
    yaw_rate, roll_rate = head[10], head[11]
    half_yaw, roll = 0.5 * yaw_rate * phase, roll_rate * phase
    qz = np.array([math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw)])
    qx = np.array([math.cos(0.5 * roll), math.sin(0.5 * roll), 0.0, 0.0])
    fixed = head[12:16].copy()
    first = head[6:10].copy()
    out[3:7] = rotations.multiply(rotations.multiply(rotations.multiply(first, qz), qx), fixed)
    c, d = math.cos(roll), math.sin(roll)
    w = np.array([roll_rate, yaw_rate * d, yaw_rate * c])
    dw = np.array([0.0, yaw_rate * roll_rate * c, -yaw_rate * roll_rate * d])
    out[10:13] = rotations.rotate_back(fixed, rate * w)
    out[16:19] = rotations.rotate_back(fixed, change * w + rate * rate * dw)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Harmonic:
    """A curve whose coordinates are sums of cosines of one phase, and whose attitude yaws and rolls with it.

    The phase runs from 0 to `end_phase`, rest to rest (velocity, acceleration and jerk vanish at both ends).

    Attributes:
        terms: (n, 4) axis, amplitude m, frequency (per phase), angle at phase zero rad.
        head: (16,) offset (3) m; slope (3) m per rad of phase; quaternion (4) before yaw; yaw and roll per phase;
            quaternion (4) after them: q_wb = first * q_z(yaw phase) * q_x(roll phase) * last.
        duration_s: from rest to rest.
        end_phase: rad.
    """

    terms: np.ndarray
    head: np.ndarray
    duration_s: float
    end_phase: float

    def sample(self, t_s: float) -> Setpoint:
        """Wanted motion at `t_s`, world NED and wanted body frame; the ends are held."""
        x = _harmonic(self.terms, self.head, self.duration_s, self.end_phase, t_s)
        return Setpoint(x[0:3], x[3:7], x[7:10], x[10:13], x[13:16], x[16:19])


_LEVEL = (1.0, 0.0, 0.0, 0.0)


def _make(
    terms: Sequence[Sequence[float]],
    offset: Sequence[float] | np.ndarray,
    slope: Sequence[float] | np.ndarray,
    duration_s: float,
    end_phase: float,
    first: Sequence[float] | np.ndarray = _LEVEL,
    turning: tuple[float, float] = (0.0, 0.0),
    last: Sequence[float] | np.ndarray = _LEVEL,
) -> Harmonic:
    if not duration_s > 0.0:
        raise ValueError(f"a trajectory needs a duration above zero, not {duration_s} s")
    before, after = (rotations.normalise(np.array(q, dtype=np.float64)) for q in (first, last))
    head = np.concatenate([np.asarray(offset, float), np.asarray(slope, float), before, turning, after])
    return Harmonic(np.array(terms, dtype=np.float64).reshape(-1, 4), head, float(duration_s), float(end_phase))


def spiral(
    centre: Sequence[float] | np.ndarray,
    radius_m: float,
    climb_m: float,
    turns: float,
    duration_s: float,
    start_angle_rad: float = 0.0,
    attitude: Sequence[float] | np.ndarray = _LEVEL,
) -> Harmonic:
    """The paper's cylindrical spiral, clockwise seen from above, holding its attitude.

    Args:
        centre: (3,) centre of the lowest turn, world NED, m.
        radius_m: of the cylinder.
        climb_m: rise from start to end (up, so z falls by it).
        turns: number of turns.
        duration_s: rest to rest.
        start_angle_rad: where on the circle it starts, from north towards east.
        attitude: (4,) q_wb held all the way.
    """
    end = 2.0 * math.pi * turns
    terms = [[0, radius_m, 1.0, start_angle_rad], [1, radius_m, 1.0, start_angle_rad - 0.5 * math.pi]]
    return _make(terms, centre, [0.0, 0.0, -climb_m / end], duration_s, end, first=attitude)
