"""Reachable wrench space: how far the thrusters can push in any direction, exactly by facets and again by linear programs.

lambda(d) = max lambda so that J f = lambda [d; 0] (force frame) or lambda [0; d] (torque frame), f_min <= f <= f_max.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_py.prepare.capability import facets
from firmware_py.prepare.capability.layout import FRAMES, Layout

_BATCH = 100
"""Linear programs solved as one block-diagonal program: 0.13 ms each for 8 thrusters, 1.6 ms each when alone."""

_PARALLEL = 1e-9
"""Share of the largest below which a facet's normal does not enter a frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Wrenches along some components with all others zero: the polytope normals @ x <= offsets, without redundant rows.

    Attributes:
        components: which components of a wrench x holds.
        normals: (m, len(components)) unit vectors.
        offsets: (m,) N or N m.
    """

    components: tuple[int, ...]
    normals: np.ndarray
    offsets: np.ndarray

    def reach(self, directions: np.ndarray) -> np.ndarray:
        """(n,) lambda along (n, len(components)) directions; N or N m for unit vectors."""
        along = directions @ self.normals.T
        ratio = np.divide(self.offsets, along, out=np.full_like(along, np.inf), where=along > 1e-12)
        return np.asarray(ratio.min(axis=1))

    def worst(self) -> float:
        """Smallest lambda over all unit directions: the distance to the nearest facet, N or N m."""
        return float(max(self.offsets.min(), 0.0))


class WrenchSpace:
    """All wrenches of one layout, through the facets of its zonotope.

    Attributes:
        layout: whose.
        dead: so many thrusters give nothing, always those whose loss hurts most.
        normals: (m, 6) of facets.normals_of.

    Raises:
        ValueError: more thrusters than facets can be found for; use `reach_by_programs`.
    """

    def __init__(self, layout: Layout, dead: int = 0, normals: np.ndarray | None = None) -> None:
        self.layout = layout
        self.dead = dead
        self.normals = facets.normals_of(layout) if normals is None else normals
        self._supports = facets.supports_of(layout, self.normals, dead)

    def with_dead(self, dead: int) -> WrenchSpace:
        """The wrenches that are left whichever `dead` thrusters give nothing (exact: see there).

        A facet of what n - dead thrusters can do is spanned by some of them, so its normal is one of the full layout's; along
        it the worst loss is that of the `dead` largest contributions.
        """
        return WrenchSpace(self.layout, dead, self.normals)

    def reach(self, wrenches: np.ndarray) -> np.ndarray:
        """(k,) largest factor of each of (k, 6) wrenches; 0 for what the layout cannot push at all."""
        wrenches = np.atleast_2d(np.asarray(wrenches, dtype=float))
        factor = facets.reach(self.layout, self.normals, self._supports, wrenches)
        return np.where(_in_span(self.layout, wrenches), factor, 0.0)

    def worst(self, frame: str) -> float:
        """Smallest lambda over all directions of a frame, N or N m: the distance to the nearest facet."""
        components = free_components(self.layout, frame)
        if not components or not self.layout.spans(components):
            return 0.0
        size = np.linalg.norm(self.normals[:, components], axis=1)
        keep = size > _PARALLEL * float(size.max())
        return float((self._supports[keep] / size[keep, None]).min())

    def section(self, frame: str) -> Section | None:
        """The polytope in one frame of FRAMES; None where the layout does not span it (then its volume is zero).

        Passive components of a layout `with_passive_declared` are left out.
        """
        components = free_components(self.layout, frame)
        if not components or not self.layout.spans(components):
            return None
        both = np.concatenate([self.normals, -self.normals])[:, components]
        size = np.linalg.norm(both, axis=1)
        keep = size > _PARALLEL * float(size.max())
        normals = both[keep] / size[keep, None]
        offsets = self._supports.T.reshape(-1)[keep] / size[keep]
        return Section(components, *_irredundant(normals, offsets))


def free_components(layout: Layout, frame: str) -> tuple[int, ...]:
    """Components of a frame whose row of the matrix is not left out (passive, declared)."""
    return tuple(c for c in FRAMES[frame] if np.any(layout.matrix[c] != 0.0) or c not in layout.passive)


def _in_span(layout: Layout, wrenches: np.ndarray) -> np.ndarray:
    scaled = wrenches / np.array([1.0, 1.0, 1.0, *[layout.lever_m] * 3])
    left = np.linalg.svd(layout.scaled)[0][:, layout.rank :]
    size = np.linalg.norm(scaled, axis=1)
    return np.asarray(np.linalg.norm(scaled @ left, axis=1) <= 1e-6 * np.maximum(size, 1e-300))


def _irredundant(normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows of normals @ x <= offsets that are facets: corners of the hull of normals / offsets (polar duality)."""
    from scipy.spatial import ConvexHull  # takes a third of a second to import

    if offsets.min() <= 1e-9 * offsets.max():
        return normals, np.maximum(offsets, 0.0)  # zero on the border: no polar body
    polar = normals / offsets[:, None]
    if normals.shape[1] == 1:
        rows = np.array([int(np.argmax(polar[:, 0])), int(np.argmin(polar[:, 0]))])
    else:
        _, distinct = np.unique(np.round(polar / np.abs(polar).max(), 12), axis=0, return_index=True)
        rows = distinct[ConvexHull(polar[distinct]).vertices]
    return normals[rows], offsets[rows]


def embed(directions: np.ndarray, components: tuple[int, ...]) -> np.ndarray:
    """(n, 6) wrenches with (n, len(components)) directions at `components` and zeros elsewhere."""
    wrenches = np.zeros((len(directions), 6))
    wrenches[:, components] = directions
    return wrenches


def reach_by_programs(layout: Layout, wrenches: np.ndarray, progress: Callable[[int], None] | None = None) -> np.ndarray:
    """(k,) largest factor of each of (k, 6) wrenches, by linear programs (HiGHS), `_BATCH` of them block-diagonal in one.

    Args:
        progress: called with the number of programs solved so far.

    Raises:
        RuntimeError: the solver gave up.
    """
    wrenches = np.atleast_2d(np.asarray(wrenches, dtype=float))
    factor = np.zeros(len(wrenches))
    for begin in range(0, len(wrenches), _BATCH):
        factor[begin : begin + _BATCH] = _solve(layout, wrenches[begin : begin + _BATCH])
        if progress:
            progress(min(begin + _BATCH, len(wrenches)))
    return factor


def _solve(layout: Layout, wrenches: np.ndarray) -> np.ndarray:
    """(k,) solution of one block-diagonal program; force in units of the largest limit, torque over the lever arm."""
    from scipy.optimize import linprog  # these take half a second to import
    from scipy.sparse import block_diag

    unit = float(max(layout.f_max.max(), -layout.f_min.min()))
    rows = np.array([1.0, 1.0, 1.0, *[layout.lever_m] * 3])
    targets = wrenches / rows
    sizes = np.linalg.norm(targets, axis=1)
    targets = targets / np.where(sizes > 0.0, sizes, 1.0)[:, None]
    blocks = [np.column_stack([layout.scaled, -target]) for target in targets]
    k, n = len(wrenches), layout.count
    limits = np.column_stack([np.r_[layout.f_min / unit, 0.0], np.r_[layout.f_max / unit, np.inf]])
    cost = np.tile(np.r_[np.zeros(n), -1.0], k)
    result = linprog(
        cost,
        A_eq=block_diag(blocks, format="csc"),
        b_eq=np.zeros(6 * k),
        bounds=np.tile(limits, (k, 1)),
        method="highs-ds",
        options={"primal_feasibility_tolerance": 1e-9, "dual_feasibility_tolerance": 1e-9},
    )
    if result.x is None:
        raise RuntimeError(f"{layout.name}: the linear program failed: {result.message}")
    return np.asarray(result.x.reshape(k, n + 1)[:, -1] * unit / np.where(sizes > 0.0, sizes, 1.0))
