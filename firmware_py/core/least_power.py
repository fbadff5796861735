"""Least-power allocation: of all thruster forces that make a wrench, those that draw the least electrical power.

Stage 7 of a tick, after the wrench is known to be within limits. The forces move only within the null space of the thruster matrix,
so that the wrench stays. No thruster changes its direction, or comes closer to zero than its deadband, where its behaviour is unknown.
Within one direction power rises smoothly, and a few quadratic programs (daqp), each with the slope and curvature of the power, find the
minimum. Work and memory of a tick are bounded; no state is kept between ticks.
"""

from __future__ import annotations

import daqp
import numpy as np
from numba import njit

from firmware_py.core.body import ThrusterSet, rank_by
from firmware_py.core.rotations import M, V
from firmware_py.core.thruster import total_power

PASSES = 3
"""Quadratic programs per tick; a power curve that is quadratic in the force would need one."""
ITERATIONS = 200
"""Limit of active-set changes in one program; a 2x2 of modules needs about 40."""
LEAST_BEND = 0.02
"""Smallest curvature used, W/N^2: a fitted curve may bend down somewhere, but a program must be convex."""
SOLVED = 1
"""daqp's exit flag for optimal."""


@njit(f"void({V},{M},{M},{V},{V})", cache=True)
def slopes(force, power_forward, power_reverse, slope, bend):  # type: ignore[no-untyped-def]
    """Writes d(power)/d(force), W/N, and its derivative, W/N^2, of each thruster; (n,) each, polynomials (n, 5) over |N|."""
    for i in range(force.shape[0]):
        c = power_forward[i] if force[i] > 0.0 else power_reverse[i]
        x, first, second = abs(force[i]), 0.0, 0.0
        for k in range(c.shape[0] - 1, -1, -1):
            second = second * x + first
            first = first * x + (k + 1) * c[k]
        slope[i] = first if force[i] > 0.0 else -first
        bend[i] = max(second, LEAST_BEND)


class LeastPower:
    """Moves the thruster forces of one body within its null space."""

    def __init__(self, thrusters: ThrusterSet, alive: np.ndarray) -> None:
        """`alive`: (n,) bool, thrusters that may be used."""
        self._t = thrusters
        self._f_min, self._f_max = thrusters.f_min, thrusters.f_max
        self._used = np.flatnonzero(alive)
        self._free = _null_space(thrusters.matrix[:, self._used])
        self._slope, self._bend = np.zeros(alive.size), np.zeros(alive.size)

    def confine(self, f_min: np.ndarray, f_max: np.ndarray) -> None:
        """Sets the force limits (n,), N, from now on."""
        self._f_min, self._f_max = f_min, f_max

    def step(self, base: np.ndarray) -> np.ndarray:
        """Returns (n,) forces, N, with the wrench and limits of `base` and at most its power."""
        if not self._free.size:
            return base
        t = self._t
        forward = base > 0.0
        low = np.where(forward, np.minimum(base, t.deadband_n), self._f_min) - base
        high = np.where(forward, self._f_max, np.maximum(base, -t.deadband_n)) - base
        low, high = low[self._used], high[self._used]
        force = base
        for _ in range(PASSES):
            moved, flag = self._program(force, base, low, high)
            if flag != SOLVED:
                break
            force = moved
        return force if self.power_w(force) < self.power_w(base) else base

    def _program(self, force: np.ndarray, base: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, int]:
        """Solves min p'(f) x + 1/2 p''(f) (x - f)^2 over x = base + N z, low <= N z <= high; returns x and daqp's exit flag."""
        slopes(force, self._t.power_forward, self._t.power_reverse, self._slope, self._bend)
        used, free = self._used, self._free
        bend = self._bend[used]
        linear = free.T @ (self._slope[used] + bend * (base - force)[used])
        z, _, flag, _ = daqp.solve((free.T * bend) @ free, linear, free, high, low, iter_limit=ITERATIONS)
        moved = base.copy()
        moved[used] += np.clip(free @ z, low, high)
        return moved, flag

    def power_w(self, force: np.ndarray) -> float:
        """Returns the electrical power of all thrusters by the vehicle's curves, W."""
        return float(total_power(force, self._t.power_forward, self._t.power_reverse))


def _null_space(matrix: np.ndarray) -> np.ndarray:
    """(n, n - rank) orthonormal basis of the forces that make no wrench."""
    _, values, rows = np.linalg.svd(matrix)
    return np.ascontiguousarray(rows[rank_by(values) :].T)
