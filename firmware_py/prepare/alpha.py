"""The paper's outline method: the alpha shape of the body's projected points (its Algorithm 1).

An alternative to prepare.projected_area, so that each checks the other. Points on a lattice that includes the boundary are
accurate within 1 %; random interior points, as in the paper, underestimate (`random_points` shows by how much).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError

from firmware_py.prepare.projected_area import Solid, plane_basis

POINTS_PER_MODULE = 1000
"""The paper's figure."""

RADIUS_IN_SPACINGS = 1.0
"""Alpha radius in lattice spacings. Below 0.9 the outline has holes (errata); measured at 1.0 over one, line of two, L
and 2x2: 0.22 % rms, 0.93 % at most; above 1.2 it fills the notch of an L."""

_MERGE = 1e-7
"""m; projected points nearer than this are merged."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one shape, and the alpha radius that suits them.

    Attributes:
        points: (k, 3) m.
        radius: largest circumradius of a triangle that belongs to the outline, m.
    """

    points: np.ndarray
    radius: float


def lattice_points(solids: Sequence[Solid]) -> Cloud:
    """Points on a lattice of each solid's bounding box, boundary included; a solid that is no box gives its surface.

    The projection of a closed surface fills the same outline as that of the volume within.
    """
    clouds, spacing = [], 0.0
    for solid in solids:
        low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
        step = float(np.cbrt(np.prod(high - low) / POINTS_PER_MODULE))
        counts = np.maximum(np.rint((high - low) / step), 2).astype(int)
        if len(solid.vertices) == 8 and _is_box(solid, low, high):
            axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
            clouds.append(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
            spacing = max(spacing, float(np.max((high - low) / (counts - 1))))
        else:
            clouds.append(_surface_points(solid, step))
            spacing = max(spacing, step)
    points = np.unique(np.round(np.concatenate(clouds), 9), axis=0)
    return Cloud(points, RADIUS_IN_SPACINGS * spacing)


def random_points(solids: Sequence[Solid], generator: np.random.Generator) -> Cloud:
    """Points drawn evenly inside convex solids: the paper's sampling, which misses the rim and so underestimates."""
    clouds, volume = [], 0.0
    for solid in solids:
        low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
        inside = np.empty((0, 3))
        while len(inside) < POINTS_PER_MODULE:
            drawn = generator.uniform(low, high, (POINTS_PER_MODULE, 3))
            inside = np.concatenate([inside, drawn[_inside_convex(solid, drawn)]])
        clouds.append(inside[:POINTS_PER_MODULE])
        volume = max(volume, float(np.prod(high - low)))
    spacing = float(np.cbrt(volume / POINTS_PER_MODULE))
    return Cloud(np.concatenate(clouds), RADIUS_IN_SPACINGS * spacing)


def outlines_of(cloud: Cloud, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) areas and (n, 3) centroids of the alpha shape of the projected points along (n, 3) unit directions."""
    bases = plane_basis(directions)
    areas, centroids = np.zeros(len(directions)), np.zeros((len(directions), 3))
    for k, basis in enumerate(bases):
        areas[k], flat = alpha_shape(cloud.points @ basis.T, cloud.radius)
        centroids[k] = flat @ basis
    return areas, centroids


def alpha_shape(points: np.ndarray, radius: float) -> tuple[float, np.ndarray]:
    """Area and centroid (2,) of the Delaunay triangles of (k, 2) points whose circumradius is at most `radius`.

    Edelsbrunner, Kirkpatrick, Seidel, "On the shape of a set of points in the plane", IEEE Trans. IT 29 (1983).
    """
    _, first = np.unique(np.round(points / _MERGE), axis=0, return_index=True)
    unique = points[first]
    try:
        triangles = unique[Delaunay(unique).simplices]
    except QhullError:
        return 0.0, unique.mean(axis=0)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, bc, ca = b - a, c - b, a - c
    area = 0.5 * np.abs(ab[:, 0] * ca[:, 1] - ab[:, 1] * ca[:, 0])
    product = np.linalg.norm(ab, axis=1) * np.linalg.norm(bc, axis=1) * np.linalg.norm(ca, axis=1)
    kept = product <= 4.0 * radius * area
    total = float(area[kept].sum())
    if total == 0.0:
        return 0.0, unique.mean(axis=0)
    return total, area[kept] @ triangles[kept].mean(axis=1) / total


def lattice_method(solids: Sequence[Solid], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A `method` of drag_table.build: outlines from lattice points."""
    return outlines_of(lattice_points(solids), directions)


def random_method(seed: int) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """A `method` of drag_table.build: outlines from random interior points."""

    def method(solids: Sequence[Solid], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return outlines_of(random_points(solids, np.random.default_rng(seed)), directions)

    return method


def _is_box(solid: Solid, low: np.ndarray, high: np.ndarray) -> bool:
    return bool(np.all(np.isclose(solid.vertices, low) | np.isclose(solid.vertices, high)))


def _inside_convex(solid: Solid, points: np.ndarray) -> np.ndarray:
    corners = solid.vertices[solid.triangles[:, 0]]
    return np.asarray(np.all(np.einsum("ptk,tk->pt", points[:, None] - corners[None], solid.normals) <= 0.0, axis=1))


def _surface_points(solid: Solid, step: float) -> np.ndarray:
    """Points of every triangle on a barycentric grid no wider than `step`."""
    found = []
    for a, b, c in solid.vertices[solid.triangles]:
        n = max(1, int(np.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c)) / step)))
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        u, v = i[i + j <= n] / n, j[i + j <= n] / n
        found.append(a + u[:, None] * (b - a) + v[:, None] * (c - a))
    return np.concatenate(found)
