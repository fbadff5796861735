"""Exact outline of a shape seen along a direction: area and centroid of the union of the projected hulls (shapely).

The slow half of the drag table. prepare.alpha is the alternative by the paper's sampling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

_BOX_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Corners of each face of a box, right-handed about its outward normal; corner 4 x + 2 y + z, each 0 or 1."""
_BOX_TRIANGLES = np.array([each for a, b, c, d in _BOX_FACES for each in ((a, b, c), (a, c, d))])


@dataclass(frozen=True, eq=False)
class Solid:
    """One closed hull, placed in the frame of its shape.

    Attributes:
        vertices: (k, 3) m.
        triangles: (t, 3) vertex indices, outward normals by the right-hand rule.
        convex: whether every outline is the convex hull of the projected vertices.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    convex: bool

    @cached_property
    def normals(self) -> np.ndarray:
        """(t, 3) outward normals whose length is the area of the triangle, m^2."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.asarray(0.5 * np.cross(b - a, c - a))

    def placed(self, rotation: np.ndarray, position: np.ndarray) -> Solid:
        """The solid rotated by a (3, 3) matrix, then translated by (3,) m."""
        return Solid(self.vertices @ rotation.T + position, self.triangles, self.convex)


def box(size: np.ndarray) -> Solid:
    """A box centred on the origin with edges of `size` (3,) m."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return Solid(corners * size, _BOX_TRIANGLES, True)


def plane_basis(directions: np.ndarray) -> np.ndarray:
    """(n, 2, 3) right-handed bases of the planes normal to (n, 3) unit directions.

    Has no singular direction: Duff et al., "Building an orthonormal basis, revisited", JCGT 6 (2017).
    """
    x, y, z = directions.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    second = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([first, second], axis=1)


def outlines(solids: Sequence[Solid], directions: np.ndarray) -> np.ndarray:
    """(n,) shapely polygons: union of the projected solids along (n, 3) directions, in `plane_basis` coordinates."""
    basis = plane_basis(directions)
    parts = [_outline_of_one(solid, directions, basis) for solid in solids]
    if len(parts) == 1:
        return parts[0]
    return np.asarray(shapely.union_all(np.stack(parts, axis=1), axis=1))


def _outline_of_one(solid: Solid, directions: np.ndarray, basis: np.ndarray) -> np.ndarray:
    flat = np.einsum("nkj,vj->nvk", basis, solid.vertices)
    if solid.convex:
        return np.asarray(shapely.convex_hull(shapely.multipoints(shapely.points(flat))))
    facing = directions @ solid.normals.T
    threshold = 1e-9 * np.abs(solid.normals).sum(axis=1)
    shapes = []
    for points, towards in zip(flat, facing, strict=True):
        corners = points[solid.triangles[towards > threshold]]
        shapes.append(shapely.union_all(shapely.polygons(corners)))
    return np.array(shapes)


def areas_and_centroids(solids: Sequence[Solid], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Projected area and centre of pressure along each direction.

    Args:
        solids: the hulls that make up the shape, in one frame; they may touch or overlap.
        directions: (n, 3) unit vectors.

    Returns:
        (n,) areas, m^2, and (n, 3) centroids of the outlines, m, in the frame of the shape, normal to their direction.
    """
    shapes = outlines(solids, directions)
    centres = shapely.centroid(shapes)
    flat = np.stack([shapely.get_x(centres), shapely.get_y(centres)], axis=1)
    return np.asarray(shapely.area(shapes)), np.einsum("nk,nkj->nj", flat, plane_basis(directions))
