"""Trajectories in closed form: hold, spiral, Moebius strip, circle, Lissajous figure, line. Rest to rest.

Built before they are needed; `sample` runs in the tick and is compiled. Like the trajectories of minimum_snap they
implement `Trajectory` (core.setpoint).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from firmware_py.core import rotations
from firmware_py.core.setpoint import as_setpoint
from firmware_py.core.types import Setpoint


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """Stay at one pose."""

    setpoint: Setpoint
    duration_s: float = 0.0

    def sample(self, t_s: float) -> Setpoint:
        """The pose; ignores `t_s`."""
        return self.setpoint


@njit("UniTuple(float64, 3)(float64, float64)", cache=True)
def progress(tau, ramp):  # type: ignore[no-untyped-def]
    """Share of the way, its first and second derivative, at the share `tau` of the time (0 to 1), rest to rest.

    Speed rises over the share `ramp` of the time (at most a half) as the fifth-degree smooth step, stays constant, and falls
    in the same way: velocity, acceleration and jerk vanish at both ends and jerk is continuous in between.
    """
    if tau <= 0.0:
        return 0.0, 0.0, 0.0
    if tau >= 1.0:
        return 1.0, 0.0, 0.0
    top = 1.0 / (1.0 - ramp)
    x = min(tau, 1.0 - tau) / ramp
    if x >= 1.0:
        return top * (tau - 0.5 * ramp), top, 0.0
    s = top * ramp * x**4 * (2.5 - 3.0 * x + x * x)
    ds = top * x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
    dds = top / ramp * 30.0 * (x * (1.0 - x)) ** 2
    return (s, ds, dds) if tau < 0.5 else (1.0 - s, ds, -dds)


@njit("float64[::1](float64[:,::1], float64[::1], float64, float64, float64, float64)", cache=True)
def _harmonic(terms, head, duration, end_phase, ramp, t):  # type: ignore[no-untyped-def]
    """(19,) p, q, v, w, a, alpha in one array. `terms`, `head`: see Harmonic."""
    s, ds, dds = progress(t / duration, ramp)
    phase, rate, change = end_phase * s, end_phase * ds / duration, end_phase * dds / duration**2
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
    first, fixed = head[6:10], head[12:16]
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
        ramp_share: share of the duration in which speed rises, and equally that in which it falls; see `progress`.
    """

    terms: np.ndarray
    head: np.ndarray
    duration_s: float
    end_phase: float
    ramp_share: float

    def sample(self, t_s: float) -> Setpoint:
        """Reference motion at `t_s`, in world NED and the reference body frame; the ends are held."""
        return as_setpoint(_harmonic(self.terms, self.head, self.duration_s, self.end_phase, self.ramp_share, t_s))


LEVEL = (1.0, 0.0, 0.0, 0.0)
"""Attitude with the body axes along the world axes."""

LONGEST_RAMP = 0.5
"""Largest ramp share: speed rises for half the time and falls for the other half."""

Vector = Sequence[float] | np.ndarray


def _make(
    terms: Sequence[Sequence[float]],
    offset: Vector,
    duration_s: float,
    end_phase: float,
    ramp_share: float = LONGEST_RAMP,
    slope: Vector = (0.0, 0.0, 0.0),
    first: Vector = LEVEL,
    turning: tuple[float, float] = (0.0, 0.0),
    last: Vector = LEVEL,
) -> Harmonic:
    if not duration_s > 0.0:
        raise ValueError(f"a trajectory needs a duration above zero, not {duration_s} s")
    if not 0.0 < ramp_share <= LONGEST_RAMP:
        raise ValueError(f"the ramp share is above 0 and at most {LONGEST_RAMP}, not {ramp_share}")
    before, after = (rotations.normalise(np.array(q, dtype=np.float64)) for q in (first, last))
    head = np.concatenate([np.asarray(offset, float), np.asarray(slope, float), before, turning, after])
    table = np.array(terms, dtype=np.float64).reshape(-1, 4)
    return Harmonic(table, head, float(duration_s), float(end_phase), float(ramp_share))


def _sine(axis: int, amplitude: float, frequency: float) -> list[float]:
    return [axis, amplitude, frequency, -0.5 * math.pi]


def spiral(
    centre: Vector,
    radius_m: float,
    climb_m: float,
    turns: float,
    duration_s: float,
    attitude: Vector = LEVEL,
) -> Harmonic:
    """The paper's cylindrical spiral, clockwise seen from above, starting in the north and holding its attitude.

    Args:
        centre: (3,) centre of the lowest turn, world NED, m.
        radius_m: of the cylinder.
        climb_m: rise from start to end (up, so z falls by it).
        turns: number of turns.
        duration_s: rest to rest.
        attitude: (4,) q_wb held all the way.
    """
    end = 2.0 * math.pi * turns
    terms = [[0, radius_m, 1.0, 0.0], _sine(1, radius_m, 1.0)]
    slope = [0.0, 0.0, -climb_m / end]
    return _make(terms, centre, duration_s, end, slope=slope, first=attitude)


def circle(centre: Vector, radius_m: float, turns: float, duration_s: float) -> Harmonic:
    """A level circle: a spiral that does not climb."""
    return spiral(centre, radius_m, 0.0, turns, duration_s)


def moebius(
    centre: Vector,
    duration_s: float = 60.0,
    radius_m: float = 1.0,
    half_width_m: float = 0.3,
    laps: float = 2.0,
    ramp_share: float = LONGEST_RAMP,
) -> Harmonic:
    """Along the rim of a Moebius strip; the body turns with the strip and rolls by 180 deg a lap.

    Point at angle u: r = (R + h cos(u/2)) e_r + h sin(u/2) e_z; body axes x = e_u along the centre circle,
    y = -(cos(u/2) e_r + sin(u/2) e_z) across the strip towards it, z its normal, down at u = 0.

    Args:
        centre: (3,) world NED, m.
        duration_s: rest to rest.
        radius_m: of the centre circle, R.
        half_width_m: of the strip, h; 0 follows the centre circle.
        laps: two close it.
        ramp_share: see `progress`.
    """
    h = half_width_m
    terms = [[0, radius_m, 1.0, 0.0], _sine(1, radius_m, 1.0)]
    terms += [[0, 0.5 * h, 1.5, 0.0], [0, 0.5 * h, 0.5, 0.0], _sine(1, 0.5 * h, 1.5), _sine(1, 0.5 * h, 0.5)]
    terms += [_sine(2, h, 0.5)]
    first = rotations.from_euler(0.0, 0.0, 0.5 * math.pi)
    end = 2.0 * math.pi * laps
    return _make(terms, centre, duration_s, end, ramp_share, first=first, turning=(1.0, -0.5))


def lissajous(
    centre: Vector,
    amplitude_m: Vector,
    frequency: Vector,
    duration_s: float,
    turns: float = 1.0,
    attitude: Vector = LEVEL,
    turning: tuple[float, float] = (0.0, 0.0),
) -> Harmonic:
    """p_k = centre_k + amplitude_k sin(frequency_k u), u from 0 to 2 pi turns: closed where they are whole.

    Args:
        centre, amplitude_m, frequency: (3,) per world axis.
        duration_s: rest to rest.
        turns: of the phase u.
        attitude: (4,) q_wb at the start.
        turning: yaw and then roll, rad per rad of u, about world-down and the body's x axis.
    """
    terms = [_sine(k, float(amplitude_m[k]), float(frequency[k])) for k in range(3)]
    end = 2.0 * math.pi * turns
    return _make(terms, centre, duration_s, end, turning=turning, last=attitude)


def line(start: Setpoint, end: Setpoint, duration_s: float) -> Harmonic:
    """A straight line from pose to pose that turns about one axis on the way; ignores the motion of the set-points."""
    turn = rotations.difference(end.q_wb, start.q_wb)
    angle = float(np.linalg.norm(turn))
    align = _x_axis_to(turn / angle) if angle > 0.0 else np.array(LEVEL)
    first = rotations.multiply(start.q_wb, align)
    last = rotations.conjugate(align)
    slope = end.p_wb - start.p_wb
    return _make([], start.p_wb, duration_s, 1.0, slope=slope, first=first, turning=(0.0, angle), last=last)


def _x_axis_to(axis: np.ndarray) -> np.ndarray:
    """Unit quaternion that rotates the x axis onto a unit vector, by the half-way vector."""
    if axis[0] < -1.0 + 1e-12:
        return np.array([0.0, 0.0, 0.0, 1.0])
    return np.asarray(rotations.normalise(np.array([1.0 + axis[0], 0.0, -axis[2], axis[1]])))
