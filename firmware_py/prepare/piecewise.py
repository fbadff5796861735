"""A trajectory of polynomial pieces in position and attitude, as minimum snap produces; sampled in the tick.

Attitude is interpolated in the space of all quaternions and then normalised: it is smooth, free of singular attitudes, exact
at the waypoints, and independent of the choice of world and body axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from firmware_py.core.setpoint import as_setpoint
from firmware_py.core.types import Setpoint

_DEGREE = 9
_CLOSE = 0.1
"""Largest change of the quaternion between neighbouring points, as a share of its length, at which the points resolve how fast it turns:
less than a thousandth of a crest between them is lost."""


def _halves() -> np.ndarray:
    """(2, 10, 10) maps from coefficients in u to those in the share of the piece's first half, and of its second half."""
    power = np.arange(_DEGREE + 1)
    second = np.array([[math.comb(i, j) for i in power] for j in power], dtype=float)
    return np.asarray(np.stack([np.eye(_DEGREE + 1), second]) * 0.5**power)


_HALVES = _halves()
_HALVES.flags.writeable = False


@njit("void(float64[:,::1], float64, float64, float64[:,::1])", cache=True)
def _derivatives(c, u, rate, out):  # type: ignore[no-untyped-def]
    """Value and two time derivatives, (3, 7), of coefficients (10, 7) at u; `rate` is du/dt."""
    out[:] = 0.0
    for k in range(c.shape[0] - 1, -1, -1):
        for j in range(7):
            out[2, j] = out[2, j] * u + 2.0 * out[1, j]
            out[1, j] = out[1, j] * u + out[0, j]
            out[0, j] = out[0, j] * u + c[k, j]
    out[1] *= rate
    out[2] *= rate * rate


@njit("void(float64[:,::1], float64[::1])", cache=True)
def _motion(d, out):  # type: ignore[no-untyped-def]
    """(19,) p, q, v, w, a, alpha of derivatives (3, 7).

    With x = |x| q: w = 2 Im(q* x')/|x| and alpha = 2 Im(q* x'')/|x| - 2 w (q . x')/|x|, because the part of x' along q
    causes no rotation.
    """
    n = math.sqrt(d[0, 3] ** 2 + d[0, 4] ** 2 + d[0, 5] ** 2 + d[0, 6] ** 2)
    q0, q1, q2, q3 = d[0, 3] / n, d[0, 4] / n, d[0, 5] / n, d[0, 6] / n
    out[0:3] = d[0, 0:3]
    out[3], out[4], out[5], out[6] = q0, q1, q2, q3
    out[7:10] = d[1, 0:3]
    out[13:16] = d[2, 0:3]
    growth = 2.0 * (q0 * d[1, 3] + q1 * d[1, 4] + q2 * d[1, 5] + q3 * d[1, 6]) / n
    for order in range(1, 3):
        a, b, c, e = d[order, 3], d[order, 4], d[order, 5], d[order, 6]
        at = 10 if order == 1 else 16
        out[at] = 2.0 * (q0 * b - q1 * a - q2 * e + q3 * c) / n
        out[at + 1] = 2.0 * (q0 * c - q2 * a - q3 * b + q1 * e) / n
        out[at + 2] = 2.0 * (q0 * e - q3 * a - q1 * c + q2 * b) / n
    out[16:19] -= growth * out[10:13]


@njit("float64[::1](float64[:,:,::1], float64[::1], float64)", cache=True)
def _sample(coefficients, breaks, t):  # type: ignore[no-untyped-def]
    last = coefficients.shape[0] - 1
    low, high = 0, last
    while low < high:
        middle = (low + high + 1) // 2
        if breaks[middle] <= t:
            low = middle
        else:
            high = middle - 1
    rate = 1.0 / (breaks[low + 1] - breaks[low])
    u = (t - breaks[low]) * rate
    d = np.empty((3, 7))
    _derivatives(coefficients[low], min(max(u, 0.0), 1.0), rate, d)
    out = np.empty(19)
    _motion(d, out)
    if u < 0.0 or u > 1.0:
        out[7:19] = 0.0
    return out


@njit("float64[:,:,::1](float64[:,:,::1], float64[::1], int64)", cache=True)
def _grid(coefficients, breaks, per_piece):  # type: ignore[no-untyped-def]
    out = np.empty((coefficients.shape[0], per_piece + 1, 20))
    d = np.empty((3, 7))
    for k in range(coefficients.shape[0]):
        rate = 1.0 / (breaks[k + 1] - breaks[k])
        for i in range(per_piece + 1):
            _derivatives(coefficients[k], i / per_piece, rate, d)
            _motion(d, out[k, i, :19])
            out[k, i, 19] = math.sqrt(d[0, 3] ** 2 + d[0, 4] ** 2 + d[0, 5] ** 2 + d[0, 6] ** 2)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Piecewise:
    """Polynomial pieces in time; a `Trajectory`.

    Attributes:
        coefficients: (k, 10, 7) of 1, u, ..., u^9 in the share u of each piece's duration; for x, y, z, then the four of the quaternion
            before it is normalised.
        breaks: (k + 1,) s, rising from 0.
        method: of the solution: "closed form" or "osqp"; "timed" along one of these (snap_timing).
        stretch: factor by which the requested durations were lengthened.
        snap_cost: integral of the squared snap of the position, m^2/s^7.
    """

    coefficients: np.ndarray
    breaks: np.ndarray
    method: str = "closed form"
    stretch: float = 1.0
    snap_cost: float = math.nan

    @property
    def duration_s(self) -> float:
        """Time from start to end."""
        return float(self.breaks[-1])

    def sample(self, t_s: float) -> Setpoint:
        """Reference motion at `t_s`, in world NED and the reference body frame; the ends are held at rest."""
        return as_setpoint(_sample(self.coefficients, self.breaks, t_s))

    def grid(self, per_piece: int) -> np.ndarray:
        """(k, per_piece + 1, 20) p, q, v, w, a, alpha and the length of the quaternion before normalising."""
        return np.asarray(_grid(self.coefficients, self.breaks, per_piece))

    def slowed(self, factor: float) -> Piecewise:
        """The same path in `factor` times the time."""
        return replace(self, breaks=factor * self.breaks, snap_cost=self.snap_cost / factor**7)

    def halved(self, which: np.ndarray) -> Piecewise:
        """The same path, with the pieces selected by `which` (k,) split in two."""
        parts = [_HALVES @ piece if cut else piece[None] for piece, cut in zip(self.coefficients, which, strict=True)]
        return replace(self, coefficients=np.concatenate(parts), breaks=np.sort(np.concatenate([self.breaks, self._middles[which]])))

    @property
    def _middles(self) -> np.ndarray:
        return np.asarray(0.5 * (self.breaks[:-1] + self.breaks[1:]))

    def resolved(self, per_piece: int, shortest: float) -> Piecewise:
        """The same path in pieces short enough for the points of `grid(per_piece)` to resolve its turns.

        A quaternion far longer than 1, as in a long piece beside a short one, turns within a small part of its piece.

        Args:
            per_piece: of `grid`.
            shortest: length below which a quaternion need not be resolved.
        """
        grid = self.grid(per_piece)
        length = grid[..., 19:]
        step = np.linalg.norm(np.diff(length * grid[..., 3:7], axis=1), axis=-1)
        near = np.maximum(np.minimum(length[:, :-1, 0], length[:, 1:, 0]), shortest)
        divisible = (self.breaks[:-1] < self._middles) & (self._middles < self.breaks[1:])  # neighbouring floats have no middle
        coarse = np.any(step > _CLOSE * near, axis=1) & divisible
        return self.halved(coarse).resolved(per_piece, shortest) if coarse.any() else self
