"""Drawing data for each space of one vehicle, for PNG and HTML: polygons of the surface and of the inscribed ellipsoid, and a caption."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from firmware_py.description.vehicle import AXES
from firmware_py.prepare.capability.layout import UNITS
from firmware_py.prepare.capability.power import electrical_power
from firmware_py.prepare.capability.sphere import grid
from firmware_py.prepare.capability.summary import Capability, Reach
from firmware_py.prepare.capability.wrench import embed

SPACES = (("power", "force"), ("power", "torque"), ("wrench", "force"), ("wrench", "torque"))
NORMALISATION = "equal_total_thrust"
"""Normalisation of the drawn wrench spaces: shows vehicles of any size on one scale."""
FLAT = 1e-6
"""Share of the other frame's extent up to which a space counts as degenerate: nothing but rounding errors."""
_POLAR, _AZIMUTH, _ELLIPSOID = 33, 65, (13, 25)
_TURN = 120


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One space of one vehicle.

    Attributes:
        space, frame: of SPACES.
        unit: of the coordinates.
        title: of the row.
        caption: for people.
        polygons: (k, 3) corners in order, of a closed surface or of one flat piece; empty where nothing can be reached.
        ellipsoid: likewise.
        declared: whether the passive degree of freedom is declared.
        limit: largest coordinate, for a common scale; 0: degenerate, nothing can be drawn.
    """

    space: str
    frame: str
    unit: str
    title: str
    caption: str
    polygons: list[np.ndarray]
    ellipsoid: list[np.ndarray]
    declared: bool
    limit: float


def pictures(result: Capability) -> dict[tuple[str, str], Picture]:
    """All four spaces of one vehicle."""
    found = {(s, f): _power(result, f) if s == "power" else _wrench(result, f) for s, f in SPACES}
    for space, frame in SPACES:
        picture, other = found[space, frame], found[space, "torque" if frame == "force" else "force"]
        if picture.limit <= FLAT * other.limit:
            found[space, frame] = dataclasses.replace(picture, polygons=[], ellipsoid=[], limit=0.0)
    return found


def _power(result: Capability, frame: str) -> Picture:
    space = result.power[frame]
    directions = grid(_POLAR, _AZIMUTH)
    flat = directions.reshape(-1, 3)
    wrenches = space.size * embed(flat, (0, 1, 2) if frame == "force" else (3, 4, 5))
    forces = wrenches @ np.linalg.pinv(result.layout.matrix, rcond=1e-9).T
    power = electrical_power(result.layout, forces).reshape(_POLAR, _AZIMUTH, 1)
    known = bool(np.all(np.isfinite(power)))
    caption = f"mean {space.power_w.mean():.3g} W, Dirichlet energy {result.power_shape[frame].dirichlet:.4g} W$^2$"
    if space.residual > 1e-6:
        caption += f"\ndegenerate: |J f - w| up to {space.residual:.2g}"
    title = f"power for {space.size:g} {UNITS[frame]}, W ({frame} frame)"
    limit = float(power.max()) if known else 1.0
    return Picture("power", frame, "W", title, caption, _mesh(power * directions) if known else [], [], False, limit)


def _wrench(result: Capability, frame: str) -> Picture:
    reach = result.reach[frame][NORMALISATION]
    unit = UNITS[frame]
    title = f"reachable wrench, {unit} ({frame} frame)\n8 N of thrust in all"
    declared = reach.degenerate and bool(result.declared)
    if declared:
        reach = result.declared[frame][NORMALISATION]
    if reach.section is None or reach.ellipsoid is None:
        return Picture("wrench", frame, unit, title, "degenerate: V = 0", [], [], False, 0.0)
    polygons, ellipsoid = _outline(reach)
    limit = max(float(np.abs(polygon).max()) for polygon in polygons)
    size = f"({unit})$^{len(reach.section.components)}$" if " " in unit else f"{unit}$^{len(reach.section.components)}$"
    caption = f"V {reach.volume:.4g} {size}, worst {reach.worst:.3g} {unit}"
    if declared:
        caption = f"degenerate: V = 0; {', '.join(AXES[c] for c in result.layout.passive)} declared:\n{caption}"
    return Picture("wrench", frame, unit, title, caption, polygons, ellipsoid, declared, limit)


def _outline(reach: Reach) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Facets, or the border where two components are left and the line where one is, and those of the ellipsoid, in all three axes."""
    assert reach.section is not None and reach.ellipsoid is not None
    shape, centre = reach.ellipsoid.shape, reach.ellipsoid.centre
    polygons = reach.section.polygons()
    if len(centre) == 3:
        return polygons, _mesh(grid(*_ELLIPSOID) @ shape + centre)
    turn = 2.0 * np.pi * np.arange(_TURN) / _TURN
    kept = [c % 3 for c in reach.section.components]
    border, inner = np.zeros((len(polygons[0]), 3)), np.zeros((_TURN, 3))
    border[:, kept] = polygons[0]
    inner[:, kept] = np.stack([np.cos(turn), np.sin(turn)], axis=1)[:, : len(kept)] @ shape + centre
    return [border], [inner]


def _mesh(points: np.ndarray) -> list[np.ndarray]:
    """Quadrilaterals of a (p, a, 3) grid."""
    corners = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], axis=2)
    return list(corners.reshape(-1, 4, 3))
