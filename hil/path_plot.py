"""The path of a flight in its tank, in three dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.plot_style import COMMAND, REFERENCE, TRUTH
from hil.signals import Flight

SMALL = 0.25
"""Share of the tank's longest edge below which a path is drawn on its own scale, without the tank."""
LEAST_M = 0.02
"""Least edge of a path that is drawn so."""
TANK_COLOUR = "#9fb4c7"
ROUND = np.linspace(0.0, 2.0 * np.pi, 73)
"""Bearings at which the rim of a cylindrical tank is drawn."""


def path_3d(axes: Any, flight: Flight, tank_m: np.ndarray, inside: np.ndarray, tank: str) -> None:
    """Draws reference and truth into 3D axes, with the tank, or, where the path is short, on its own scale.

    Args:
        tank_m: (2, 3) lowest and highest corner of the tank, world, m. inside: (k,) judged ticks.
        tank: `box` or `cylinder`.
    """
    others = apart(flight)
    wanted = flight.firmware["setpoint_p_wb"][inside]
    low, high, is_small = _limits([flight.p_wb, wanted, *others], tank_m)
    axes.computed_zorder = False  # in the order of drawing, so that the truth does not hide the reference
    for line in () if is_small else _edges(tank_m, tank):
        axes.plot(*line.T, color=TANK_COLOUR, linewidth=0.9)
    axes.plot(*flight.p_wb.T, color=TRUTH, linewidth=2.4, alpha=0.6, label="truth")
    for index, path in enumerate(others):
        axes.plot(*path.T, color=COMMAND, linewidth=1.2, label=None if index else "truth, another module")
    axes.plot(*wanted.T, color=REFERENCE, linestyle="--", linewidth=1.1, label="reference")
    axes.scatter(*flight.p_wb[0], color=TRUTH, s=28, label="start")
    for which, text in (("x", "north x (m)"), ("y", "east y (m)"), ("z", "down z (m)")):
        getattr(axes, f"set_{which}label")(text, labelpad=7)
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), zlim=(high[2], low[2]))
    # y is reversed together with z: reversing only one of them would mirror the picture.
    axes.set_box_aspect(high - low, zoom=0.93)
    axes.locator_params(nbins=4 if is_small else 5)
    axes.view_init(elev=22, azim=-58)
    axes.set_title("Path, enlarged: the tank is left out" if is_small else "Path in the tank")
    axes.legend(loc="upper left", fontsize=9)


def _limits(paths: Sequence[np.ndarray], tank_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Lowest and highest corner of what is shown, and whether that is a cube about the paths in place of the tank."""
    points = np.concatenate(paths)
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    edge = max(float((high - low).max()), LEAST_M)
    if edge > SMALL * float((tank_m[1] - tank_m[0]).max()):
        return tank_m[0], tank_m[1], False
    middle = 0.5 * (low + high)
    return middle - 0.55 * edge, middle + 0.55 * edge, True


def _edges(tank_m: np.ndarray, tank: str) -> list[np.ndarray]:
    """(n, 3) lines of the tank's edges; of a cylinder its two rims and four lines down its wall."""
    low, high = tank_m
    if tank == "cylinder":
        middle, radius = 0.5 * (low + high), 0.5 * float(high[0] - low[0])
        rims = [np.column_stack([middle[0] + radius * np.cos(ROUND), middle[1] + radius * np.sin(ROUND), np.full(ROUND.shape, z)])
                for z in (low[2], high[2])]  # fmt: skip
        return [*rims, *(np.stack([rim[at] for rim in rims]) for at in range(0, len(ROUND) - 1, 18))]
    lines = []
    for fixed in range(3):
        a, b = (i for i in range(3) if i != fixed)
        for corner_a in (low[a], high[a]):
            for corner_b in (low[b], high[b]):
                line = np.empty((2, 3))
                line[:, fixed], line[:, a], line[:, b] = (low[fixed], high[fixed]), corner_a, corner_b
                lines.append(line)
    return lines


def apart(flight: Flight) -> list[np.ndarray]:
    """(k, 3) paths of the modules that are outside the body at some time; NaN while they are inside."""
    outside = flight.truth["member"] == 0.0
    return [np.where(outside[:, [m]], module["p_wm"], np.nan) for m, module in enumerate(flight.modules) if outside[:, m].any()]
