"""All capability figures of one layout: both frames, all normalisations, with degenerate cases named."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from firmware_py.description.vehicle import AXES
from firmware_py.prepare.capability.ellipsoid import Ellipsoid, largest_inscribed
from firmware_py.prepare.capability.facets import subsets
from firmware_py.prepare.capability.layout import FRAMES, Layout
from firmware_py.prepare.capability.morphology import Harmonics, Shape
from firmware_py.prepare.capability.power import PowerSpace, power_space
from firmware_py.prepare.capability.programs import ProgramSpace, reach_by_programs
from firmware_py.prepare.capability.sphere import fibonacci
from firmware_py.prepare.capability.wrench import Section, WrenchSpace, embed

DIRECTIONS = 1000
"""Directions over the sphere, as in the paper's drag table."""

FACET_SUBSETS = 250_000
"""Largest number of column subsets (32 thrusters, 1 s) with which all facets are listed; beyond it, linear programs find a section."""


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Reachable wrenches of one frame under one normalisation.

    Attributes:
        degenerate: whether the layout cannot push in some direction of the frame, so that the volume is zero.
        section: the polytope, None where degenerate.
        ellipsoid: the largest inscribed ellipsoid, None where degenerate.
        volume: of the ellipsoid, N^d or (N m)^d, d the frame's free components; 0 where degenerate.
        worst: smallest lambda over all directions, N or N m.
        radius: (k,) lambda over the directions of `Capability.directions`; zeros where not reachable.
        shape: energies of that surface, None where degenerate or not a surface in three dimensions.
    """

    degenerate: bool
    section: Section | None
    ellipsoid: Ellipsoid | None
    volume: float
    worst: float
    radius: np.ndarray
    shape: Shape | None


@dataclass(frozen=True, slots=True, eq=False)
class Capability:
    """Capability of one layout.

    Attributes:
        layout: the layout itself.
        rank: of its matrix.
        unreachable: degrees of freedom that cannot be pushed alone, of all six.
        directions: (k, 3).
        reach: by frame and normalisation.
        declared: the same with the passive degrees of freedom declared; empty where there are none.
        power, power_shape: by frame.
        programs_differ: largest relative difference of linear programs from facets over both frames, NaN if not run.
        axes: (6, 2) largest push along and against each component alone, N and N m; passive components may take any value meanwhile.
    """

    layout: Layout
    rank: int
    unreachable: tuple[str, ...]
    directions: np.ndarray
    reach: dict[str, dict[str, Reach]]
    declared: dict[str, dict[str, Reach]]
    power: dict[str, PowerSpace]
    power_shape: dict[str, Shape]
    programs_differ: float
    axes: np.ndarray
    notes: tuple[str, ...] = field(default=())


def characterise(
    layout: Layout,
    count: int = DIRECTIONS,
    sizes: dict[str, float] | None = None,
    programs: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Capability:
    """The capability of one layout in both frames.

    Args:
        count: number of directions over the sphere, at least 121.
        sizes: |w| of the power space by frame; 1 N and 1 N m when left out.
        programs: whether to solve the linear programs too and compare.
        progress: called with a description of the next step.
    """
    directions = fibonacci(count)
    harmonics = Harmonics(directions)
    say = progress or (lambda text: None)
    rest = layout.with_passive_declared()
    space = wrench_space(rest)
    reach: dict[str, dict[str, Reach]] = {}
    power: dict[str, PowerSpace] = {}
    differ = 0.0 if programs else math.nan
    for frame in FRAMES:
        say(f"{frame}: facets and inscribed ellipsoid")
        reach[frame] = _all_normalisations(layout, frame, directions, harmonics)
        power[frame] = power_space(layout, frame, directions, (sizes or {}).get(frame, 1.0))
        if programs:
            say(f"{frame}: {count} linear programs")
            differ = max(differ, _difference(layout, frame, directions, reach[frame]["physical"].radius))
    declared = {frame: _all_normalisations(rest, frame, directions, harmonics) for frame in FRAMES if layout.passive}
    return Capability(
        layout=layout,
        rank=layout.rank,
        unreachable=layout.unreachable(),
        directions=directions,
        reach=reach,
        declared=declared,
        power=power,
        power_shape={frame: harmonics.shape(_known(power[frame].power_w)) for frame in FRAMES},
        programs_differ=differ,
        axes=np.stack([space.reach(np.eye(6)), space.reach(-np.eye(6))], axis=1),
        notes=_notes(layout),
    )


def wrench_space(layout: Layout) -> WrenchSpace | ProgramSpace:
    """The wrench space of a layout, by facets, or by linear programs where there are too many thrusters for all facets."""
    return WrenchSpace(layout) if subsets(layout) <= FACET_SUBSETS else ProgramSpace(layout)


def _known(power_w: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(power_w), power_w, 0.0)


def _all_normalisations(layout: Layout, frame: str, directions: np.ndarray, harmonics: Harmonics) -> dict[str, Reach]:
    def found(how: str) -> Reach:
        return _reach(wrench_space(layout.normalised(how)), frame, directions, harmonics)

    physical, unit = found("physical"), found("unit_thrust")
    share = float(layout.normalised("equal_total_thrust").f_max[0])
    return {"physical": physical, "unit_thrust": unit, "equal_total_thrust": _scaled(unit, share)}


def _scaled(reach: Reach, share: float) -> Reach:
    """The reach with all force limits multiplied by `share`."""
    section, ellipsoid, shape = reach.section, reach.ellipsoid, reach.shape
    return Reach(
        degenerate=reach.degenerate,
        section=section and dataclasses.replace(section, offsets=share * section.offsets),
        ellipsoid=ellipsoid and Ellipsoid(share * ellipsoid.shape, share * ellipsoid.centre),
        volume=reach.volume * (share ** len(ellipsoid.centre) if ellipsoid else 0.0),
        worst=share * reach.worst,
        radius=share * reach.radius,
        shape=shape and dataclasses.replace(shape, dirichlet=share**2 * shape.dirichlet),
    )


def _reach(space: WrenchSpace | ProgramSpace, frame: str, directions: np.ndarray, harmonics: Harmonics) -> Reach:
    section = space.section(frame)
    full = section is not None and len(section.components) == 3
    radius = section.reach(directions) if section and full else space.reach(embed(directions, FRAMES[frame]))
    if section is None:
        return Reach(True, None, None, 0.0, 0.0, radius, None)
    ellipsoid = largest_inscribed(section.normals, section.offsets)
    shape = harmonics.shape(radius) if full else None
    return Reach(False, section, ellipsoid, ellipsoid.volume, section.worst(), radius, shape)


def _difference(layout: Layout, frame: str, directions: np.ndarray, exact: np.ndarray) -> float:
    """Largest |program - facet| relative to the facets' figure, or to the largest figure where a direction is out of reach."""
    programs = reach_by_programs(layout, embed(directions, FRAMES[frame]))
    scale = np.where(exact > 0.0, exact, max(float(exact.max()), float(layout.f_max.max())))
    return float(np.max(np.abs(programs - exact) / scale))


def _notes(layout: Layout) -> tuple[str, ...]:
    notes = []
    if layout.rank < 6:
        held = ", ".join(AXES[c] for c in layout.passive) or "none declared"
        left = [name for name in layout.with_passive_declared().unreachable() if AXES.index(name) not in layout.passive]
        lost = f", cannot push {', '.join(left)} alone" if left else ""
        notes.append(f"degenerate: rank {layout.rank}{lost}; passive: {held}")
    if layout.assumption:
        notes.append(f"assumption: {layout.assumption}")
    return tuple(notes)


def to_plain(result: Capability) -> dict[str, Any]:
    """The figures alone, for JSON; units are in the names."""
    return {
        "name": result.layout.name,
        "thrusters": result.layout.count,
        "rank": result.rank,
        "unreachable": list(result.unreachable),
        "passive": [AXES[c] for c in result.layout.passive],
        "assumption": result.layout.assumption,
        "directions": len(result.directions),
        "axes_positive_negative": result.axes.tolist(),
        "programs_differ": _number(result.programs_differ),
        "wrench": _plain_reaches(result.reach),
        "wrench_passive_declared": _plain_reaches(result.declared),
        "power": {frame: _plain_power(result.power[frame], result.power_shape[frame]) for frame in FRAMES},
    }


def _number(value: float) -> float | None:
    """None for NaN and infinity, which JSON lacks."""
    return float(value) if math.isfinite(value) else None


def _plain_reaches(reaches: dict[str, dict[str, Reach]]) -> dict[str, Any]:
    return {frame: {how: _plain_reach(reach) for how, reach in by.items()} for frame, by in reaches.items()}


def _plain_reach(reach: Reach) -> dict[str, Any]:
    ellipsoid = reach.ellipsoid
    return {
        "degenerate": reach.degenerate,
        "max_inscribed_ellipsoid_volume": _number(reach.volume),
        "ellipsoid": ellipsoid and {"shape": ellipsoid.shape.tolist(), "centre": ellipsoid.centre.tolist()},
        "worst_direction": _number(reach.worst),
        "facets": len(reach.section.offsets) if reach.section else 0,
        "surface": reach.shape and _plain_shape(reach.shape),
    }


def _plain_power(space: PowerSpace, shape: Shape) -> dict[str, Any]:
    return {
        "wrench_size": space.size,
        "mean_power_w": _number(float(np.mean(space.power_w))),
        "largest_residual": _number(space.residual),
        "share_over_limits": space.over_limit,
        "thrust_variance_n2": space.variance,
        "surface": _plain_shape(shape),
    }


def _plain_shape(shape: Shape) -> dict[str, Any]:
    return {
        "dirichlet_energy": _number(shape.dirichlet),
        "dirichlet_scale_free": _number(shape.dirichlet_scale_free),
        "willmore_energy": _number(shape.willmore),
        "willmore_refused": shape.refused,
        "total_curvature": _number(shape.total_curvature),
        "fit_misfit_share": _number(shape.misfit),
    }
