"""Power space and thrust variance: the cost of a wrench of declared size in every direction, with f = J^+ w.

P(d) = sum [P(f_i) - P(0)] with the thrusters' measured power; the idle power of the electronics is not included. The
paper's own figure is proportional to the number of thrusters, so it measures idle power.
"""

from __future__ import annotations

from ctypes import c_int
from dataclasses import dataclass

import daqp
import numpy as np

from firmware_py.prepare.capability.layout import FRAMES, Layout
from firmware_py.prepare.capability.wrench import embed

_EQUALITY = 5
"""daqp's mark of an equality row."""

_SOLVED = 1
"""daqp's exit flag for optimal."""


@dataclass(frozen=True, slots=True, eq=False)
class PowerSpace:
    """One layout in one frame.

    Attributes:
        size: |w| of the declared wrench, N or N m.
        directions: (k, 3) unit vectors.
        forces: (k, n) N.
        power_w: (k,) W; NaN where the thrusters' power is not known.
        residual: largest |J f - w| over the directions, N and N m together; zero where the layout spans the frame.
        over_limit: share of the directions in which some thruster exceeds its limits.
        variance: of a thruster's force over all thrusters and the whole sphere, N^2, in closed form.
    """

    size: float
    directions: np.ndarray
    forces: np.ndarray
    power_w: np.ndarray
    residual: float
    over_limit: float
    variance: float


def power_space(layout: Layout, frame: str, directions: np.ndarray, size: float = 1.0) -> PowerSpace:
    """The power space of a layout.

    Args:
        frame: of layout.FRAMES.
        directions: (k, 3) unit vectors over the frame's components, whatever the thrusters cannot make among them.
        size: |w|, N or N m.
    """
    components = FRAMES[frame]
    wrenches = size * embed(directions, components)
    pinv = np.linalg.pinv(layout.matrix, rcond=1e-9)
    forces = wrenches @ pinv.T
    residual = np.linalg.norm(forces @ layout.matrix.T - wrenches, axis=1)
    over = np.any((forces > layout.f_max + 1e-9) | (forces < layout.f_min - 1e-9), axis=1)
    # A unit vector in three dimensions has mean zero and second moment 1/3 in each component.
    mean_square = float(np.sum(pinv[:, components] ** 2)) / len(components)
    return PowerSpace(
        size=size,
        directions=directions,
        forces=forces,
        power_w=electrical_power(layout, forces),
        residual=float(residual.max()),
        over_limit=float(over.mean()),
        variance=size**2 * mean_square / layout.count,
    )


def electrical_power(layout: Layout, forces: np.ndarray) -> np.ndarray:
    """(k,) power above idle of (k, n) forces, W; NaN where the layout has no power curve."""
    if not layout.power_forward.shape[1]:
        return np.full(len(forces), np.nan)
    size = np.abs(forces)
    total = np.zeros(forces.shape)
    coefficients = np.where(forces[..., None] > 0.0, layout.power_forward, layout.power_reverse)
    for order in range(coefficients.shape[-1] - 1, -1, -1):
        total = (total + coefficients[..., order]) * size
    return np.asarray(total.sum(axis=1))


def least_squares_forces(layout: Layout, wrenches: np.ndarray) -> np.ndarray:
    """(k, n) least-squares forces within limits for (k, 6) wrenches; J^+ w where a wrench is out of reach."""
    forces = wrenches @ np.linalg.pinv(layout.matrix, rcond=1e-9).T
    n = layout.count
    sense = np.array([0] * n + [_EQUALITY] * 6, dtype=c_int)
    matrix = np.ascontiguousarray(layout.matrix)
    over = np.any((forces > layout.f_max) | (forces < layout.f_min), axis=1)
    for k in np.flatnonzero(over):
        upper, lower = np.r_[layout.f_max, wrenches[k]], np.r_[layout.f_min, wrenches[k]]
        x, _, flag, _ = daqp.solve(2.0 * np.eye(n), np.zeros(n), matrix, upper, lower, sense)
        if flag == _SOLVED:
            forces[k] = x
    return np.asarray(forces)
