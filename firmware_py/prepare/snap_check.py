"""Whether a body can fly a path that was found: how far and how fast it turns, what its thrusters give, how far it leans."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from firmware_py.core.body import Body
from firmware_py.description.vehicle import AXES
from firmware_py.prepare.piecewise import Piecewise
from firmware_py.prepare.snap_limits import InfeasibleError, Limits, Place, largest
from firmware_py.prepare.snap_thrust import divide, sag, usage

MOST_LEAN = 0.2
"""Largest lean with which a body may leave a moment to buoyancy, rad. A fifth of a force along one axis then goes into another."""

HOPELESS = 10.0
"""Use of the thrusters, as a share of their range, above which no figure is given."""
_CHECK_POINTS = 48
"""Intervals of each piece, or part of one, at whose ends attitude rates and thrusters are checked; a bound between the ends is added."""
_SHORTEST_QUATERNION = 0.3
"""Length below which the interpolated quaternion, before it is normalised, turns too far."""


class UnreachableError(InfeasibleError):
    """The body cannot fly the path, however slow."""


def check(found: Piecewise, limits: Limits, body: Body | None) -> None:
    """Refuses a trajectory that turns too far or too fast, or that the body cannot fly. Raises InfeasibleError."""
    grid, place = _resolved(found)
    _check_length(grid, place)
    _check_turning(grid, limits, place)
    if body is not None:
        _check_motion(body, limits, grid[..., :19].reshape(-1, 19), place, _CHECK_POINTS + 1)


def check_turns(found: Piecewise) -> None:
    """Refuses a trajectory that turns too far, which it does at any pace. Raises InfeasibleError."""
    _check_length(*_resolved(found))


def check_standing(attitudes: np.ndarray, limits: Limits, body: Body) -> None:
    """Refuses attitudes (n, 4) that the body cannot hold even at rest. Raises InfeasibleError."""
    still = np.zeros((len(attitudes), 19))
    still[:, 3:7] = attitudes
    _check_motion(body, limits, still, Place)


def _check_turning(grid: np.ndarray, limits: Limits, place: Callable[[int], Place]) -> None:
    """Refuses a grid (pieces, points, 20) that turns too fast; `place` as for `_check_motion`."""
    rate, change = limits.angular_rate, limits.angular_acceleration
    for bound, columns, unit in ((rate, slice(10, 13), "rad/s"), (change, slice(16, 19), "rad/s^2")):
        if bound is None:
            continue
        most, at = largest(np.linalg.norm(grid[..., columns], axis=-1))
        if most > bound:
            raise InfeasibleError(f"turning takes {most:.3g} {unit} of at most {bound:g} {unit}", place(at))


def _check_motion(body: Body, limits: Limits, motion: np.ndarray, place: Callable[[int], Place], run: int = 1) -> None:
    """Refuses (k, 19) motion that needs more than thrusters and buoyancy give; `place` describes where row k is.

    Each `run` of rows samples a smooth motion, which is checked between the rows too.
    """
    part = divide(body, motion)
    flat = int(np.argmax(np.abs(part.lacking)))
    k, axis = divmod(flat, 6)
    if lacking := abs(float(part.lacking[k, axis])):
        what = f"{lacking:.2g} {'N along' if axis < 3 else 'N m about'} the robot's {'xyz'[axis % 3]}"
        raise UnreachableError(f"neither thrusters nor buoyancy give {what}, which it takes", place(k))
    if (falling := np.flatnonzero(np.isinf(part.lean))).size:
        raise InfeasibleError("neither thrusters nor buoyancy keep the robot from falling over", place(int(falling[0])))
    lean, k = largest(part.lean.reshape(-1, run))
    if lean > MOST_LEAN:
        degrees, name = f"{math.degrees(lean):.1f} deg, of at most {math.degrees(MOST_LEAN):.1f} deg", AXES[part.axis[k]]
        rest = f"; keep it level in {name} there" if place(k).time_s is None else ""
        raise InfeasibleError(f"its thrusters give no {name}: the robot would lean by {degrees},", place(k), rest)
    share, k = usage(body, part.thrust, limits.thruster_share, sag(part.thrust, run))
    if share > limits.thruster_share:
        raise InfeasibleError(_thrust_message(share, limits.thruster_share), place(k))


def _thrust_message(share: float, limit: float) -> str:
    used, allowed = f"{100.0 * share:.0f} %" if share < HOPELESS else f"more than {100.0 * HOPELESS:.0f} %", f"{100.0 * limit:.0f} %"
    return f"the thrusters would be used to {used} of their range, of at most {allowed},"


def _resolved(found: Piecewise) -> tuple[np.ndarray, Callable[[int], Place]]:
    """A grid (pieces, points, 20) of the trajectory that resolves its turns, and what gives the place of a flat index into it."""
    fine = found.resolved(_CHECK_POINTS, _SHORTEST_QUATERNION)
    return fine.grid(_CHECK_POINTS), lambda flat: _place(found, fine, flat)


def _check_length(grid: np.ndarray, place: Callable[[int], Place]) -> None:
    """Refuses a grid (pieces, points, 20) that turns too far: its quaternion nearly vanishes. `place` as for `_check_motion`."""
    if (shortest := float(grid[..., 19].min())) < _SHORTEST_QUATERNION:
        where = place(int(np.argmin(grid[..., 19])))
        raise InfeasibleError("attitude turns too far", where, f" (length {shortest:.2f}); add a waypoint there")


def _place(found: Piecewise, fine: Piecewise, flat: int) -> Place:
    """The place in `found` of a flat index into the grid of `fine`, the same path in shorter pieces."""
    part, i = divmod(flat, _CHECK_POINTS + 1)
    time = fine.breaks[part] + i / _CHECK_POINTS * (fine.breaks[part + 1] - fine.breaks[part])
    piece = int(np.searchsorted(found.breaks, fine.breaks[part], side="right")) - 1
    return Place(piece, float(time))
