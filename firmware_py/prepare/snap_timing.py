"""The timing of a path: as fast at each place as speed, acceleration and turning permit there.

Minimum snap meets its limits at one place of a path and is slower everywhere else. The path is kept here, and the fastest pace along it
found (time-optimal path parameterisation: Bobrow, Dubowsky and Gibson 1985; in the square of the pace it is a linear program: Verscheure
et al. 2009). That pace jumps in acceleration, so the result is the minimum snap through places of the path at their new times.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
import scipy.sparse as sparse
from scipy.optimize import linprog

from firmware_py.prepare.piecewise import Piecewise
from firmware_py.prepare.snap_limits import Limits, largest, towards_ends
from firmware_py.prepare.snap_spline import Knots, System, solve

_POINTS = 128
"""Intervals of each piece in which the pace is found, denser near its ends."""
_LEAST_PACE, _GREATEST_PACE = 1e-3, 1e2
"""Bounds of the pace, times that of the path: at a rest nothing else bounds it."""
_SHARES = (0.9, 0.7, 0.5)
"""Shares of the permitted accelerations that are tried: interpolation rounds the jumps of the pace, and overshoots where it does."""
_RISE_S = 2.0
"""Least time in which full speed, and full rate of turning, is reached. Interpolation overshoots where it is less, and all is slowed."""
_KNOT_S = 1.0
"""Time between places that are interpolated. At 0.1 m/s^2 the path then moves by a millimetre, and by more where it bends more sharply."""
MOVED_M = 0.002
"""By how much the path may move."""
_DENSER = 5
"""How often places are put between those where the path has moved further: each halves the time between them."""
_STEADY, _LONGEST = 0.02, 3
"""Share of the permitted acceleration below which a motion is steady. Of the places within it only every third is interpolated."""
_CHECK_POINTS = 48
_PROBES = 4
"""Parts of a piece between which it is seen whether the path has moved."""
_HALVINGS = 8
"""Steps in which the least slowing is found that the thrusters need: to less than a hundredth of the time that was gained."""


class Timed(NamedTuple):
    """A path with another timing.

    Attributes:
        path: the same path, within MOVED_M.
        at_s: (k + 1,) s, when it is at each of the breaks of the path before.
    """

    path: Piecewise
    at_s: np.ndarray

    def slowed(self, factor: float) -> Timed:
        """Every duration times `factor`."""
        return Timed(self.path.slowed(factor), factor * self.at_s)


class _Pace(NamedTuple):
    """How fast a path is followed."""

    times: np.ndarray
    """(n,) s, of the path."""
    new: np.ndarray
    """(n,) s, when it is there now."""
    pace: np.ndarray
    """(n,) seconds of the path per new second; in between it is linear in the new time."""

    def times_at(self, new: np.ndarray) -> np.ndarray:
        """Times of the path, s, at `new` times, s."""
        k = np.clip(np.searchsorted(self.new, new, side="right") - 1, 0, len(self.new) - 2)
        passed = new - self.new[k]
        change = (self.pace[k + 1] - self.pace[k]) / (self.new[k + 1] - self.new[k])
        return np.asarray(np.minimum(self.times[k] + passed * (self.pace[k] + 0.5 * change * passed), self.times[k + 1]))


class _Motion(NamedTuple):
    """The motion along a path, as it was timed."""

    times: np.ndarray
    """(n,) s."""
    velocity: np.ndarray
    """(n, 6) along each axis of the world, m/s, then about each of the body, rad/s."""
    acceleration: np.ndarray
    """(n, 6) the same, m/s^2 and rad/s^2."""

    @classmethod
    def at(cls, path: Piecewise, times: np.ndarray) -> Self:
        points = [path.sample(time) for time in times.tolist()]
        velocity = np.array([np.concatenate([point.v_w, point.w_b]) for point in points])
        return cls(times, velocity, np.array([np.concatenate([point.a_w, point.alpha_b]) for point in points]))

    @classmethod
    def along(cls, path: Piecewise) -> Self:
        """At _POINTS of each piece, its beginning among them, and at the end."""
        shares = towards_ends(np.arange(_POINTS) / _POINTS)
        return cls.at(path, np.append(path.breaks[:-1, None] + np.diff(path.breaks)[:, None] * shares, path.breaks[-1]))


class _Bounds(NamedTuple):
    """Bounds of a motion; infinite where there is none."""

    speed: float
    """m/s, in any direction."""
    rate: float
    """rad/s."""
    acceleration: np.ndarray
    """(6,) along each axis of the world, m/s^2, then about each of the body, rad/s^2."""

    @classmethod
    def of(cls, speed_m_s: float, limits: Limits) -> Self:
        pushed = np.full(3, math.inf) if limits.acceleration is None else limits.acceleration
        twisted = math.inf if limits.angular_acceleration is None else limits.angular_acceleration
        rate = math.inf if limits.angular_rate is None else limits.angular_rate
        return cls(speed_m_s, rate, np.concatenate([pushed, np.full(3, twisted)]))

    def eased(self, share: float) -> Self:
        """With a share of the acceleration, and no more than reaches full speed in _RISE_S."""
        reached = np.repeat([self.speed, self.rate], 3) / _RISE_S
        return self._replace(acceleration=np.minimum(share * self.acceleration, reached))

    def stretch(self, path: Piecewise) -> float:
        """The factor by which all durations of a path may be multiplied for it to just keep the bounds."""
        grid = path.grid(_CHECK_POINTS)
        speed, rate, twist = (largest(np.linalg.norm(grid[..., k : k + 3], axis=-1))[0] for k in (7, 10, 16))
        push, _ = largest(np.max(np.abs(grid[..., 13:16]) / self.acceleration[:3], axis=-1))
        return max(speed / self.speed, rate / self.rate, math.sqrt(push), math.sqrt(twist / float(self.acceleration[3])))


def stretch_within(path: Piecewise, speed_m_s: float, limits: Limits) -> float:
    """The factor by which all durations of a path may be multiplied for it to just keep what `hastened` keeps."""
    return _Bounds.of(speed_m_s, limits).stretch(path)


def hastened(path: Piecewise, speed_m_s: float, limits: Limits, is_flyable: Callable[[Piecewise], bool]) -> Timed:
    """The path in the shortest time found; as it was where nothing is gained.

    Args:
        path: from rest to rest; it keeps the limits and is flyable.
        speed_m_s: largest speed, in any direction.
        limits: acceleration, angular_rate and angular_acceleration hold; the others are not looked at.
        is_flyable: whether the robot can fly a path.
    """
    best, bounds, motion = Timed(path, path.breaks), _Bounds.of(speed_m_s, limits), _Motion.along(path)
    as_before = min(speed_m_s, largest(np.linalg.norm(path.grid(_CHECK_POINTS)[..., 7:10], axis=-1))[0]) or speed_m_s
    for speed in sorted({as_before, speed_m_s}):  # thrusters may permit no more than before
        for share in _SHARES:
            eased = bounds._replace(speed=speed).eased(share)
            timed = _interpolated(path, _fastest(motion, eased), eased)
            if timed is None:
                continue
            timed = timed.slowed(bounds.stretch(timed.path))
            longest = best.path.duration_s / timed.path.duration_s
            if longest > 1.0:
                best = _least_slowed(timed, longest, is_flyable) or best
    return best


def _least_slowed(timed: Timed, longest: float, is_flyable: Callable[[Piecewise], bool]) -> Timed | None:
    """`timed`, slowed by the least flyable factor from 1 to below `longest`; None where none was found."""
    if is_flyable(timed.path):
        return timed
    low, high, found = 0.0, 1.0, None
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        slower = timed.slowed(longest**middle)
        if is_flyable(slower.path):
            found, high = slower, middle
        else:
            low = middle
    return found


def _fastest(motion: _Motion, bounds: _Bounds) -> _Pace:
    """The fastest pace within the bounds.

    With z the square of the pace, new velocity is v sqrt(z), and new acceleration a z + v z'/2, with z' the derivative in the path's time.
    """
    times, velocity, acceleration = motion
    speed, rate = np.linalg.norm(velocity[:, :3], axis=1), np.linalg.norm(velocity[:, 3:], axis=1)
    least = np.maximum(speed / bounds.speed, rate / bounds.rate)
    most = np.clip(1.0 / np.maximum(least, 1.0 / _GREATEST_PACE), _LEAST_PACE, None) ** 2
    step = np.diff(times)
    rows, ends = [], []
    for axis in np.flatnonzero(np.isfinite(bounds.acceleration) & np.any(velocity != 0.0, axis=0)):
        a, v = (0.5 * (each[1:, axis] + each[:-1, axis]) for each in (acceleration, velocity))
        row = sparse.diags_array([0.5 * (a - v / step), 0.5 * (a + v / step)], offsets=[0, 1], shape=(len(step), len(times)))
        rows += [row, -row]
        ends += [np.full(2 * len(step), bounds.acceleration[axis])]
    found = linprog(
        -np.convolve(step, [0.5, 0.5]) / np.sqrt(most),
        A_ub=sparse.vstack(rows, format="csr") if rows else None,
        b_ub=np.concatenate(ends) if rows else None,
        bounds=np.stack([np.full(len(times), _LEAST_PACE**2), most], axis=1),
        method="highs",
    )
    pace = np.sqrt(found.x) if found.status == 0 else np.ones(len(times))
    return _Pace(times, np.concatenate([[0.0], np.cumsum(2.0 * step / (pace[1:] + pace[:-1]))]), pace)


def _interpolated(path: Piecewise, pace: _Pace, bounds: _Bounds) -> Timed | None:
    """The minimum snap through places of the path, at the pace; None where it would leave the path."""
    breaks = pace.new[np.searchsorted(pace.times, path.breaks)]
    counts = np.maximum(1, np.round(np.diff(breaks) / _KNOT_S)).astype(int)
    own = np.concatenate([[0], np.cumsum(counts)])
    knots = np.interp(np.arange(own[-1] + 1), own, breaks)
    knots = knots[_worth_keeping(path, knots, pace.times_at(knots), own, bounds)]
    for _ in range(_DENSER + 1):
        found = _through(path, pace, knots)
        has_moved = _moved(path, pace, found) > MOVED_M
        if not has_moved.any():
            return Timed(found, breaks)
        knots = np.sort(np.concatenate([knots, 0.5 * (knots[1:] + knots[:-1])[has_moved]]))
    return None


def _through(path: Piecewise, pace: _Pace, knots: np.ndarray) -> Piecewise:
    """The minimum snap through where the path is, at the pace, at the new times `knots`, s."""
    poses = [path.sample(time) for time in pace.times_at(knots).tolist()]
    position, attitude = np.array([pose.p_wb for pose in poses]), np.array([pose.q_wb for pose in poses])
    attitude[1:] *= np.cumprod(np.where(np.sum(attitude[1:] * attitude[:-1], axis=1) < 0.0, -1.0, 1.0))[:, None]
    system = System.of(np.diff(knots))
    coefficients = [system.coefficients(value, solve(system, Knots.at_rest(value))) for value in (position, attitude)]
    return Piecewise(np.ascontiguousarray(np.concatenate(coefficients, axis=2)), knots, "timed")


def _moved(path: Piecewise, pace: _Pace, found: Piecewise) -> np.ndarray:
    """(n,) m, by how much each piece of `found` is off the path: ahead or behind on it does not count."""
    shares = np.arange(_PROBES + 1) / _PROBES
    times = pace.times_at(found.breaks[:-1, None] + np.diff(found.breaks)[:, None] * shares)
    places, longest = found.grid(_PROBES)[..., :3].reshape(-1, 3), np.repeat(np.ptp(times, axis=1), _PROBES + 1)
    motion = [path.sample(time) for time in times.ravel().tolist()]
    velocity = np.array([point.v_w for point in motion])
    off = places - np.array([point.p_wb for point in motion])
    ahead = np.sum(off * velocity, axis=1) / np.maximum(np.sum(velocity**2, axis=1), np.finfo(float).tiny)
    beside = times.ravel() + np.clip(ahead, -longest, longest)
    nearer = places - np.array([path.sample(time).p_wb for time in beside.tolist()])
    least = np.minimum(np.linalg.norm(off, axis=1), np.linalg.norm(nearer, axis=1))
    return np.asarray(least.reshape(-1, _PROBES + 1).max(axis=1))


def _worth_keeping(path: Piecewise, knots: np.ndarray, times: np.ndarray, own: np.ndarray, bounds: _Bounds) -> np.ndarray:
    """(n,) whether a place is to be interpolated: not those in the middle of a steady motion, except the path's `own` and every third.

    Args:
        knots, times: (n,) s, new times and those of the path.
        own: indices of the path's breaks.
    """
    velocity = _Motion.at(path, times).velocity * np.gradient(times, knots)[:, None]
    changing = np.any(np.abs(np.gradient(velocity, knots, axis=0)) > _STEADY * bounds.acceleration, axis=1)
    keep = changing.copy()
    keep[1:] |= changing[:-1]
    keep[:-1] |= changing[1:]
    keep[own] = True
    for k in range(_LONGEST, len(keep)):
        keep[k] |= not keep[k - _LONGEST + 1 : k].any()
    return np.asarray(keep)
