"""Box-constrained least squares with six equality constraints, which the allocator solves when thrusters saturate.

    min 1/2 sum_i w_i (x_i - g_i)^2   subject to   sum_i a_i x_i = 0 (6,)   and   l <= x <= u

Solved in its dual, which has six unknowns y for any number of thrusters: x_i(y) = clip(g_i + a_i y / w_i) minimises the
Lagrangian, and sum_i a_i x_i(y) is the gradient of a convex, piecewise quadratic function of y. Newton steps with exact
line searches end in its lowest piece (Li and Swetits, A new algorithm for solving strictly convex quadratic programs,
SIAM J. Optim. 7, 1997). Work and memory are bounded; no state is kept between calls.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from firmware_py.core.rotations import M, V

RESIDUAL = 1e-8
"""Largest sum, in magnitude, at which the point counts as a solution."""
MOST_STEPS = 60
"""Limit of Newton steps; 8 to 13 are usual, and 37 was the most in 4000 draws."""
MOST_TRIALS = 60
"""Limit of iterations of one line search; 25 are usual."""
EXACT = 1e-9
"""A line search ends where the slope has fallen to this share of its first value."""
RIDGE = 1e-13
"""Regularisation of the curvature, as a share of its trace without the box: the curvature is singular where all thrusters of a direction
are at their limits."""


@njit(f"float64({M},{V},{V},{V},{V},{V},{V},{M})", cache=True)
def _look(rows, weights, free, low, high, x, gradient, curvature):  # type: ignore[no-untyped-def]
    """Writes x(y), gradient and curvature from `free`, x(y) without the box; returns the largest component of the gradient."""
    gradient[:], curvature[:] = 0.0, 0.0
    for i in range(free.size):
        x[i] = min(max(free[i], low[i]), high[i])
        inside = low[i] < free[i] < high[i]
        for k in range(6):
            gradient[k] += rows[i, k] * x[i]
            if inside:
                for j in range(k + 1):
                    curvature[k, j] += rows[i, k] * rows[i, j] / weights[i]
    return np.abs(gradient).max()


@njit(cache=True)
def _newton(curvature, ridge, gradient, step):  # type: ignore[no-untyped-def]
    """Writes -(curvature + ridge)^-1 gradient into `step`. The Cholesky factor overwrites the lower half of `curvature`."""
    for k in range(6):
        for j in range(k + 1):
            for m in range(j):
                curvature[k, j] -= curvature[k, m] * curvature[j, m]
            curvature[k, j] = curvature[k, j] / curvature[j, j] if j < k else math.sqrt(max(curvature[k, k] + ridge, ridge))
    for k in range(6):
        step[k] = -gradient[k]
        for j in range(k):
            step[k] -= curvature[k, j] * step[j]
        step[k] /= curvature[k, k]
    for k in range(5, -1, -1):
        for j in range(k + 1, 6):
            step[k] -= curvature[j, k] * step[j]
        step[k] /= curvature[k, k]


@njit(cache=True)
def _lowest(weights, free, slope, low, high):  # type: ignore[no-untyped-def]
    """Returns the step length along `slope` from `free` to the minimum of the line: the zero of the derivative, which only rises."""
    first, shortest, longest, length = 0.0, 0.0, math.inf, 1.0
    for i in range(free.size):
        first += weights[i] * slope[i] * min(max(free[i], low[i]), high[i])
    for _ in range(MOST_TRIALS):
        derivative, bend = 0.0, 0.0
        for i in range(free.size):
            x, pull = free[i] + length * slope[i], weights[i] * slope[i]
            if low[i] < x < high[i]:
                bend += pull * slope[i]
            derivative += pull * min(max(x, low[i]), high[i])
        if abs(derivative) <= EXACT * abs(first):
            break
        if derivative < 0.0:
            shortest = length
        else:
            longest = length
        guess = length - derivative / bend if bend > 0.0 else math.inf
        middle = 0.5 * (shortest + longest) if longest < math.inf else 10.0 * shortest
        length = guess if shortest < guess < longest else middle
    return length


@njit(f"float64({M},{V},{V},{V},{V},{V})", cache=True)
def nearest(rows, weights, goal, low, high, x):  # type: ignore[no-untyped-def]
    """Writes the solution (n,) into `x`; returns the largest remaining sum of the six, at most `RESIDUAL` when a solution is found.

    Args:
        rows: (n, 6) a_i. weights, goal, low, high: (n,) w, g, l, u; weights > 0, and x = 0 within the box.
    """
    free = goal.copy()
    slope, gradient, step, curvature = np.empty(free.size), np.empty(6), np.empty(6), np.empty((6, 6))
    left = _look(rows, weights, free, low, high, x, gradient, curvature)
    ridge = RIDGE * float((rows * rows).sum(axis=1) @ (1.0 / weights))
    for _ in range(MOST_STEPS):
        if left <= RESIDUAL:
            break
        _newton(curvature, ridge, gradient, step)
        for i in range(free.size):
            slope[i] = 0.0
            for k in range(6):
                slope[i] += rows[i, k] * step[k] / weights[i]
        length = _lowest(weights, free, slope, low, high)
        for i in range(free.size):
            free[i] += length * slope[i]
        left = _look(rows, weights, free, low, high, x, gradient, curvature)
    return left
