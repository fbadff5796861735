"""Limits of a trajectory: velocity, acceleration and corridor as planes, where a path is beyond them, and the error that says so."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from firmware_py.prepare.snap_spline import derivative_rows

_CHECK_POINTS = 48
"""Number of intervals of each piece whose ends are sampled to find the crests of a limited quantity."""

_CORRIDOR_SIDES = 8
"""Number of sides of the prism, inside the cylinder, that represents a corridor."""


class Place(NamedTuple):
    """Where a path does not meet a request.

    Attributes:
        waypoint: index of the waypoint where it is, or behind which.
        time_s: time since the start of the path; None at the waypoint itself, at rest.
    """

    waypoint: int
    time_s: float | None = None

    def __str__(self) -> str:
        if self.time_s is None:
            return f"to stand still at waypoint {self.waypoint}"
        return f"between waypoints {self.waypoint} and {self.waypoint + 1}, at {self.time_s:.2f} s"


class InfeasibleError(ValueError):
    """No trajectory meets the request; the message says which limit, where, and what follows.

    Attributes:
        place: where the request is not met.
        hurried: index of the waypoint before the piece with the least time for its way; None unless a duration is given for each. A piece
            that is too short makes its neighbours swing out, which have the time to, so that the limit is mostly exceeded in one of these.
    """

    def __init__(self, what: str, place: Place, rest: str = "") -> None:
        super().__init__(what, place, rest)
        self.place = place
        self.hurried: int | None = None

    def __str__(self) -> str:
        return self.worded(str(self.place))

    def worded(self, where: str) -> str:
        """The message with other words for the place."""
        what, _, rest = self.args
        return f"{what} {where}{rest}"

    def renumbered(self, waypoint: int) -> Self:
        """The same error with another index for the waypoint."""
        what, place, rest = self.args
        return type(self)(what, place._replace(waypoint=waypoint), rest)


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of a trajectory; None leaves a quantity free.

    Attributes:
        velocity: (3,) m/s, along each world axis.
        acceleration: (3,) m/s^2, along each world axis.
        corridor_m: largest distance from the straight line through neighbouring waypoints, and largest overshoot beyond either of them.
        angular_rate: rad/s.
        angular_acceleration: rad/s^2.
        thruster_share: share of each thruster's range that the path may use; the rest is reserved for control.
    """

    velocity: np.ndarray | None = None
    acceleration: np.ndarray | None = None
    corridor_m: float | None = None
    angular_rate: float | None = None
    angular_acceleration: float | None = None
    thruster_share: float = 0.8


@dataclass(frozen=True, eq=False)
class Plane:
    """One scalar limit on one piece: |normal . derivative - centre| <= bound.

    Attributes:
        piece, order: index of the piece; 0 position, 1 velocity, 2 acceleration.
        normal: (3,) unit vector.
        centre, bound: m, m/s or m/s^2.
        name: for messages.
    """

    piece: int
    order: int
    normal: np.ndarray
    centre: float
    bound: float
    name: str


def planes(value: np.ndarray, limits: Limits) -> list[Plane]:
    """Every scalar limit on every piece between waypoints `value` (n, 3)."""
    found = []
    for piece, (a, b) in enumerate(itertools.pairwise(value)):
        for order, bounds, word in ((1, limits.velocity, "velocity"), (2, limits.acceleration, "acceleration")):
            for axis in range(3 if bounds is not None else 0):
                assert bounds is not None
                unit = "m/s" if order == 1 else "m/s^2"
                name = f"{word} along {'xyz'[axis]} within {bounds[axis]:g} {unit}"
                found.append(Plane(piece, order, np.eye(3)[axis], 0.0, float(bounds[axis]), name))
        if limits.corridor_m is not None:
            found += _corridor(piece, a, b, limits.corridor_m)
    return found


def _corridor(piece: int, a: np.ndarray, b: np.ndarray, radius: float) -> list[Plane]:
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    across = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    across /= np.linalg.norm(across)
    name = "corridor"
    found = [Plane(piece, 0, along, float(along @ (a + b)) / 2.0, 0.5 * length + radius, name)]
    for k in range(_CORRIDOR_SIDES // 2):
        angle = 2.0 * math.pi * k / _CORRIDOR_SIDES
        normal = math.cos(angle) * across + math.sin(angle) * np.cross(along, across)
        found.append(Plane(piece, 0, normal, float(normal @ a), radius * math.cos(math.pi / _CORRIDOR_SIDES), name))
    return found


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """Planes as arrays: piece, order (m,), normal (m, 3), centre, bound (m,)."""

    piece: np.ndarray
    order: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    bound: np.ndarray

    @staticmethod
    def of(limits: list[Plane]) -> PlaneTable:
        return PlaneTable(
            np.array([p.piece for p in limits], dtype=int),
            np.array([p.order for p in limits], dtype=int),
            np.array([p.normal for p in limits]).reshape(-1, 3),
            np.array([p.centre for p in limits]),
            np.array([p.bound for p in limits]),
        )

    def in_unit(self, unit_m: float) -> PlaneTable:
        """The same planes with lengths in `unit_m`, m."""
        return replace(self, centre=self.centre / unit_m, bound=self.bound / unit_m)

    def excess(self, coefficients: np.ndarray, durations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(m,) largest |normal . derivative - centre| over bound on each piece, and (m,) the share of the piece at which it is."""
        grid = towards_ends(np.arange(_CHECK_POINTS + 1) / _CHECK_POINTS)
        rows = np.stack([derivative_rows(grid, order) for order in range(3)])[self.order]
        sampled = self._used(rows, coefficients, durations)
        heights, places = crests(sampled)
        each = np.arange(len(sampled))
        u = towards_ends(places[each, heights.argmax(axis=1)] / _CHECK_POINTS)
        rows = np.stack([derivative_rows(u, order) for order in range(3)])[self.order, each]
        crest, at_points = self._used(rows[:, None], coefficients, durations)[:, 0], sampled.max(axis=1)
        return np.maximum(crest, at_points), np.where(crest > at_points, u, grid[sampled.argmax(axis=1)])

    def _used(self, rows: np.ndarray, coefficients: np.ndarray, durations: np.ndarray) -> np.ndarray:
        """(m, p) |normal . derivative - centre| over bound, of rows (m, p, 10) over the coefficients in u."""
        values = np.einsum("muj,mjc,mc->mu", rows, coefficients[self.piece], self.normal)
        values /= durations[self.piece][:, None] ** self.order[:, None]
        return np.asarray(np.abs(values - self.centre[:, None]) / self.bound[:, None])


def towards_ends(share: np.ndarray) -> np.ndarray:
    """Shares of a piece, denser near its ends as Chebyshev's points are: there a polynomial may turn most sharply."""
    return 0.5 - 0.5 * np.cos(math.pi * share)


def crests(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The crests between samples (..., n) of smooth functions: (..., n - 2) heights and places, counted in samples.

    Each is the crest of the parabola through a sample and its two neighbours; without a crest between these, the sample itself.
    """
    before, at, after = values[..., :-2], values[..., 1:-1], values[..., 2:]
    bend, slope = before - 2.0 * at + after, 0.5 * (after - before)
    offset = np.divide(-slope, bend, out=np.zeros_like(at), where=np.abs(slope) < -bend)
    return at + 0.5 * slope * offset, np.arange(1, values.shape[-1] - 1) + offset


def largest(size: np.ndarray) -> tuple[float, int]:
    """The maximum of smooth quantities (pieces, points), including crests between points, and the flat index of the nearest point."""
    if size.shape[1] < 3:
        return float(size.max()), int(np.argmax(size))
    heights, _ = crests(size)
    piece, i = divmod(int(np.argmax(heights)), heights.shape[1])
    if heights[piece, i] > size.max():
        return float(heights[piece, i]), piece * size.shape[1] + i + 1
    return float(size.max()), int(np.argmax(size))


def worst(limits: list[Plane], coefficients: np.ndarray, durations: np.ndarray) -> tuple[float, str, Place]:
    """Largest ratio of any limited quantity to its limit, the name of that limit, and its place; 0 without limits."""
    if not limits:
        return 0.0, "", Place(0)
    excess, where = PlaneTable.of(limits).excess(coefficients, durations)
    k = int(np.argmax(excess))
    return float(excess[k]), limits[k].name, place_on(limits[k].piece, float(where[k]), durations)


def place_on(piece: int, u: float, durations: np.ndarray) -> Place:
    """The place at the share `u` of a piece."""
    return Place(piece, float(durations[:piece].sum() + u * durations[piece]))
