"""Reachable wrench space: the exact limit of what the thrusters can push in any direction, from the facets of the zonotope.

lambda(d) = max lambda so that J f = lambda [d; 0] (force frame) or lambda [0; d] (torque frame), f_min <= f <= f_max.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_py.prepare.capability import facets
from firmware_py.prepare.capability.layout import FRAMES, Layout

_PARALLEL = 1e-9
"""Size of a facet's normal in a frame, as a share of the largest, below which the facet does not bound the frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Wrenches in some components with all others zero: the polytope normals @ x <= offsets, without redundant rows.

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

    def polygons(self) -> list[np.ndarray]:
        """Corners of each facet in order, (k, 3), in three dimensions; of the one outline, (k, 2), in two; both ends, (2, 1), in one."""
        corners = corners_of(self.normals, self.offsets)
        if len(self.components) == 1:
            return [corners]
        if len(self.components) == 2:
            return [corners[np.argsort(np.arctan2(corners[:, 1], corners[:, 0]))]]
        tolerance = 1e-7 * float(np.abs(corners).max())
        found = []
        for normal, offset in zip(self.normals, self.offsets, strict=True):
            on = corners[np.abs(corners @ normal - offset) < tolerance]
            across = np.linalg.svd(normal[None])[2][1:]
            flat = (on - on.mean(axis=0)) @ across.T
            found.append(on[np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))])
        return found

    def worst(self) -> float:
        """Smallest lambda over all unit directions: the distance to the nearest facet, N or N m."""
        return float(max(self.offsets.min(), 0.0))


class WrenchSpace:
    """All reachable wrenches of one layout, through the facets of its zonotope.

    Attributes:
        layout: the layout itself.
        dead: number of thrusters that give nothing, always those whose loss costs most.
        normals: (m, 6) of facets.normals_of.

    Raises:
        DescriptionError: too many thrusters to find all facets; programs.ProgramSpace handles any number.
    """

    def __init__(self, layout: Layout, dead: int = 0, normals: np.ndarray | None = None) -> None:
        self.layout = layout
        self.dead = dead
        self.normals = facets.normals_of(layout) if normals is None else normals
        self._supports = facets.supports_of(layout, self.normals, dead)

    def with_dead(self, dead: int) -> WrenchSpace:
        """The wrenches that remain reachable whichever `dead` thrusters fail.

        Exact: a facet of the wrenches of n - dead thrusters is spanned by some of them, so its normal is one of the full
        layout's; along it the worst loss is that of the `dead` largest contributions.
        """
        return WrenchSpace(self.layout, dead, self.normals)

    def reach(self, wrenches: np.ndarray) -> np.ndarray:
        """(k,) largest factor of each of (k, 6) wrenches; 0 for wrenches outside the layout's span."""
        wrenches = np.atleast_2d(np.asarray(wrenches, dtype=float))
        factor = facets.reach(self.layout, self.normals, self._supports, wrenches)
        return np.where(in_span(self.layout, wrenches), factor, 0.0)

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
        return Section(components, *irredundant(normals, offsets))


def free_components(layout: Layout, frame: str) -> tuple[int, ...]:
    """Components of a frame, without passive ones whose row of the matrix is zero (`with_passive_declared`)."""
    return tuple(c for c in FRAMES[frame] if np.any(layout.matrix[c] != 0.0) or c not in layout.passive)


def in_span(layout: Layout, wrenches: np.ndarray) -> np.ndarray:
    """(k,) whether each of (k, 6) wrenches is a combination of the thrusters."""
    scaled = wrenches / layout.levers
    left = np.linalg.svd(layout.scaled)[0][:, layout.rank :]
    size = np.linalg.norm(scaled, axis=1)
    return np.asarray(np.linalg.norm(scaled @ left, axis=1) <= 1e-6 * np.maximum(size, 1e-300))


def irredundant(normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows of normals @ x <= offsets that are facets: corners of the hull of normals / offsets (polar duality)."""
    from scipy.spatial import ConvexHull  # takes a third of a second to import

    if offsets.min() <= 1e-9 * offsets.max():
        return normals, np.maximum(offsets, 0.0)  # the origin is on the border, so that there is no polar body
    polar = normals / offsets[:, None]
    if normals.shape[1] == 1:
        rows = np.array([int(np.argmax(polar[:, 0])), int(np.argmin(polar[:, 0]))])
    else:
        _, distinct = np.unique(np.round(polar / np.abs(polar).max(), 12), axis=0, return_index=True)
        rows = distinct[ConvexHull(polar[distinct]).vertices]
    return normals[rows], offsets[rows]


def corners_of(normals: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """(c, d) corners of {x : normals @ x <= offsets} with the origin inside: faces of the hull of the polar points."""
    from scipy.spatial import ConvexHull

    if normals.shape[1] == 1:
        return np.asarray(normals * offsets[:, None])
    equations = ConvexHull(normals / offsets[:, None]).equations
    corners = equations[:, :-1] / -equations[:, -1:]
    _, distinct = np.unique(np.round(corners / np.abs(corners).max(), 9), axis=0, return_index=True)
    return np.asarray(corners[distinct])


def embed(directions: np.ndarray, components: tuple[int, ...]) -> np.ndarray:
    """(n, 6) wrenches with (n, len(components)) directions at `components` and zeros elsewhere."""
    wrenches = np.zeros((len(directions), 6))
    wrenches[:, components] = directions
    return wrenches
