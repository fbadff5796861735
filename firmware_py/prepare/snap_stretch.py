"""The smallest stretch of all durations of a path at which it is feasible, found by doubling and bisection."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from firmware_py.prepare.piecewise import Piecewise
from firmware_py.prepare.snap_check import UnreachableError
from firmware_py.prepare.snap_limits import InfeasibleError

_LONGEST_STRETCH = 1024.0
_STRETCH_TOLERANCE = 2e-3


def least_stretched(attempt: Callable[[float], Piecewise], free: bool, both_ways: bool = False) -> Piecewise:
    """The trajectory with the smallest feasible stretch of all durations.

    Args:
        attempt: the trajectory at a stretch; raises InfeasibleError.
        free: whether the stretch may be below 1.
        both_ways: whether stretches below 1 may be feasible where none above 1 is.
    """
    high, best = _first_feasible(attempt, both_ways)
    if high == 1.0 and not free:
        return best
    low = 0.5 * high if high > 1.0 else high
    while low == high:
        shorter = _feasible(attempt, 0.5 * low)
        if shorter is None:
            low *= 0.5
        else:
            best, low, high = shorter, 0.5 * low, 0.5 * high
    while high > (1.0 + _STRETCH_TOLERANCE) * low:
        middle = math.sqrt(low * high)
        tried = _feasible(attempt, middle)
        if tried is None:
            low = middle
        else:
            best, high = tried, middle
    return replace(best, stretch=1.0) if free else best


def _first_feasible(attempt: Callable[[float], Piecewise], both_ways: bool) -> tuple[float, Piecewise]:
    """The first feasible stretch out of 1, 2, 4, ..., or out of 1, 2, 1/2, 4, 1/4, ..., and its trajectory."""
    factor = 1.0
    while factor <= _LONGEST_STRETCH:
        for tried in (factor, 1.0 / factor) if both_ways and factor > 1.0 else (factor,):
            if (found := _feasible(attempt, tried)) is not None:
                return tried, found
        factor *= 2.0
    return _LONGEST_STRETCH, attempt(_LONGEST_STRETCH)


def _feasible(attempt: Callable[[float], Piecewise], factor: float) -> Piecewise | None:
    """The trajectory at a stretch, or None where it is infeasible but longer durations may help."""
    try:
        return attempt(factor)
    except InfeasibleError as error:
        if isinstance(error, UnreachableError) and factor >= 1.0:
            raise
        return None
