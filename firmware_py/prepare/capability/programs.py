"""Reachable wrench space by linear programs (HiGHS): checks the facets, and serves bodies with too many thrusters.

lambda(w) = max lambda so that J f = lambda w, f_min <= f <= f_max. The program's dual is the normal of a facet where w
leaves the reachable wrenches, so a section's facets can be found one by one.
"""

from __future__ import annotations

import numpy as np

from firmware_py.prepare.capability.layout import Layout
from firmware_py.prepare.capability.sphere import fibonacci
from firmware_py.prepare.capability.wrench import Section, corners_of, embed, free_components, irredundant

_BATCH = 100
"""Number of programs solved as one block-diagonal program: 0.13 ms each for 8 thrusters, 1.6 ms each when solved alone."""

_FIRST_DIRECTIONS = 40
"""Number of directions with which the search for a section's facets starts."""

_BEYOND = 1e-9
"""Relative tolerance within which a corner of the facets found so far counts as reachable."""

_MOST_ROUNDS = 100
"""Rounds of the search; six to ten are usual."""


def reach_by_programs(layout: Layout, wrenches: np.ndarray) -> np.ndarray:
    """(k,) largest factor of each of (k, 6) wrenches. Raises RuntimeError where the solver gives up."""
    return solve(layout, wrenches)[0]


def solve(layout: Layout, wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors (k,) and duals (k, 6): y . w = 1, and y . v <= factor for every reachable v."""
    wrenches = np.atleast_2d(np.asarray(wrenches, dtype=float))
    factor, dual = np.zeros(len(wrenches)), np.zeros(wrenches.shape)
    for begin in range(0, len(wrenches), _BATCH):
        part = slice(begin, begin + _BATCH)
        factor[part], dual[part] = _batch(layout, wrenches[part])
    return factor, dual


def _batch(layout: Layout, wrenches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One block-diagonal program; force in units of the largest limit, torque over the lever arm."""
    from scipy.optimize import linprog  # these take half a second to import
    from scipy.sparse import block_diag

    unit = float(max(layout.f_max.max(), -layout.f_min.min()))
    targets = wrenches / layout.levers
    sizes = np.linalg.norm(targets, axis=1)
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    targets = targets / sizes[:, None]
    k, n = len(wrenches), layout.count
    limits = np.column_stack([np.r_[layout.f_min / unit, 0.0], np.r_[layout.f_max / unit, np.inf]])
    result = linprog(
        np.tile(np.r_[np.zeros(n), -1.0], k),
        A_eq=block_diag([np.column_stack([layout.scaled, -target]) for target in targets], format="csc"),
        b_eq=np.zeros(6 * k),
        bounds=np.tile(limits, (k, 1)),
        method="highs-ds",
        options={"primal_feasibility_tolerance": 1e-9, "dual_feasibility_tolerance": 1e-9},
    )
    if result.x is None:
        raise RuntimeError(f"{layout.name}: the linear program failed: {result.message}")
    factor = np.abs(result.x.reshape(k, n + 1)[:, -1]) * unit / sizes  # HiGHS gives -0.0 for wrenches out of reach
    dual = result.eqlin.marginals.reshape(k, 6)
    along = np.sum(dual * targets, axis=1)
    return factor, dual / np.where(along == 0.0, 1.0, along)[:, None] / layout.levers / sizes[:, None]


class ProgramSpace:
    """Like wrench.WrenchSpace, for any number of thrusters: answers every query with linear programs."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout

    def reach(self, wrenches: np.ndarray) -> np.ndarray:
        """(k,) largest factor of each of (k, 6) wrenches; 0 for wrenches outside the layout's span."""
        return reach_by_programs(self.layout, wrenches)

    def section(self, frame: str) -> Section | None:
        """The polytope in one frame; None where the layout does not span it.

        Starts with the facets that a few directions hit, then tests the corners of the polytope that these enclose: an
        unreachable corner lies beyond a facet not found yet.

        Raises:
            RuntimeError: the search did not end within _MOST_ROUNDS rounds.
        """
        components = free_components(self.layout, frame)
        if not components or not self.layout.spans(components):
            return None
        dimensions = len(components)
        normals, offsets = np.zeros((0, dimensions)), np.zeros(0)
        probes = _first_directions(dimensions)
        for _ in range(_MOST_ROUNDS):
            factor, dual = solve(self.layout, embed(probes, components))
            beyond = factor < 1.0 - _BEYOND if len(normals) else np.ones(len(probes), dtype=bool)
            if not np.any(beyond):
                return Section(components, normals, offsets)
            sizes = np.linalg.norm(dual[beyond][:, components], axis=1)
            heights = _supports(self.layout, dual[beyond]) / sizes
            normals = np.concatenate([normals, dual[beyond][:, components] / sizes[:, None]])
            normals, offsets = irredundant(normals, np.concatenate([offsets, heights]))
            probes = corners_of(normals, offsets)
        raise RuntimeError(f"{self.layout.name}: the facets of the {frame} frame were not all found")


def _supports(layout: Layout, normals: np.ndarray) -> np.ndarray:
    along = normals @ layout.matrix
    return np.asarray(np.maximum(along * layout.f_max, along * layout.f_min).sum(axis=1))


def _first_directions(dimensions: int) -> np.ndarray:
    if dimensions == 3:
        return np.concatenate([np.eye(3), -np.eye(3), fibonacci(_FIRST_DIRECTIONS)])
    if dimensions == 2:
        turn = 2.0 * np.pi * np.arange(_FIRST_DIRECTIONS) / _FIRST_DIRECTIONS
        return np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.array([[1.0], [-1.0]])
