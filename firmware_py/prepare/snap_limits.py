"""Minimum snap under limits: velocity, acceleration and corridor as linear constraint rows, solved with OSQP.

Each piece starts with rows at a few points. Where the result violates a limit in between, a row is added at the crest and
the problem is solved again, so that the limits hold everywhere and not only at samples.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import osqp
import scipy.sparse as sparse

from firmware_py.prepare.snap_spline import ORDERS, TO_COEFFICIENTS, Knots, System, derivative_rows

_FIRST_POINTS = 8
"""Number of points of each piece with rows from the start."""

_CHECK_POINTS = 48
"""Number of intervals of each piece whose ends are sampled to find the crests of a limited quantity."""

_MARGIN = 2e-3
"""Share by which rows are tighter than the limit. Covers the solver's tolerance, and the shift of a crest when a row limits it."""

_ROUNDS = 12
_SOLVER = {
    "eps_abs": 1e-5,
    "eps_rel": 1e-5,
    "max_iter": 20000,
    "polishing": True,
    "verbose": False,
    "adaptive_rho_interval": 50,  # counted, not timed: the same result every time
    "scaling": 0,  # _Problem scales; OSQP's own scaling leaves its rho at a bound where durations are uneven
    "eps_dual_inf": 1e-15,  # snap is bounded below: a certificate of the opposite is false
}
_CURVATURE = 1e-3
"""Curvature of the scaled cost. With 1, and rows of 0.02 as velocities have, OSQP's rho reaches its upper bound of 1e6."""
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
class _Table:
    """Planes as arrays: piece, order (m,), normal (m, 3), centre, bound (m,)."""

    piece: np.ndarray
    order: np.ndarray
    normal: np.ndarray
    centre: np.ndarray
    bound: np.ndarray

    @staticmethod
    def of(limits: list[Plane]) -> _Table:
        return _Table(
            np.array([p.piece for p in limits], dtype=int),
            np.array([p.order for p in limits], dtype=int),
            np.array([p.normal for p in limits]).reshape(-1, 3),
            np.array([p.centre for p in limits]),
            np.array([p.bound for p in limits]),
        )

    def in_unit(self, unit_m: float) -> _Table:
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
    excess, where = _Table.of(limits).excess(coefficients, durations)
    k = int(np.argmax(excess))
    return float(excess[k]), limits[k].name, _place_on(limits[k].piece, float(where[k]), durations)


def _place_on(piece: int, u: float, durations: np.ndarray) -> Place:
    """The place at the share `u` of a piece."""
    return Place(piece, float(durations[:piece].sum() + u * durations[piece]))


def solve_limited(system: System, knots: Knots, limits: list[Plane], start: np.ndarray, before_round: Callable[[], None]) -> np.ndarray:
    """(n, 4, 3) scaled derivatives of least snap that keep the limits.

    Args:
        system: durations.
        knots: waypoints (n, 3) and the derivatives given there.
        limits: result of `planes`.
        start: (n, 4, 3) solution without limits.
        before_round: called before each round of OSQP; what it raises ends them.

    Raises:
        InfeasibleError: names the limit and the place of the conflict.
    """
    in_time = f"in {system.durations.sum():.2f} s"
    if knots.fixed.all():
        _, name, place = worst(limits, system.coefficients(knots.value, start), system.durations)
        raise InfeasibleError(f"no trajectory {in_time} that stops at every waypoint keeps the {name}", place)
    unit_m = float(np.ptp(knots.value, axis=0).max()) or 1.0  # in which OSQP's tolerances suit paths of any length
    table = _Table.of(limits).in_unit(unit_m)
    knots = Knots(knots.value / unit_m, knots.fixed, knots.derivative / unit_m)
    problem = _Problem(system, knots, start / unit_m)
    index = np.repeat(np.arange(len(limits)), _FIRST_POINTS)
    where = np.tile(towards_ends(np.arange(_FIRST_POINTS) / _FIRST_POINTS), len(limits))
    for _ in range(_ROUNDS):
        before_round()
        try:
            unknown, conflict = problem.solve(table, index, where)
        except (osqp.OSQPException, _GaveUpError) as error:
            _, name, place = worst(limits, system.coefficients(unit_m * knots.value, start), system.durations)
            why = "" if isinstance(error, _GaveUpError) else "error "
            raise InfeasibleError(f"no trajectory was found that keeps the {name}", place, f": OSQP gave up with {why}{error}") from None
        if conflict >= 0:
            limit = limits[index[conflict]]
            place = _place_on(limit.piece, float(where[conflict]), system.durations)
            raise InfeasibleError(f"no trajectory {in_time} keeps the {limit.name}", place)
        excess, crest = table.excess(system.coefficients(knots.value, unknown), system.durations)
        broken = np.flatnonzero(excess > 1.0)
        if not len(broken):
            return unit_m * unknown
        index = np.concatenate([index, broken])
        where = np.concatenate([where, crest[broken]])
    k = int(np.argmax(excess))
    place = _place_on(limits[k].piece, float(crest[k]), system.durations)
    raise InfeasibleError(f"no trajectory was found in {_ROUNDS} rounds that keeps the {limits[k].name}", place)


class _GaveUpError(Exception):
    """OSQP stopped without a result; the message is its status."""


class _Problem:
    """The quadratic program in the free scaled derivatives of all three axes, each scaled to the same curvature."""

    def __init__(self, system: System, knots: Knots, start: np.ndarray) -> None:
        self._system, self._knots, self._count = system, knots, 3 * knots.fixed.size
        bands = system.banded()
        size = bands.shape[1]
        lower = sparse.diags([bands[k, : size - k] for k in range(len(bands))], [-k for k in range(len(bands))])
        form = sparse.kron(sparse.eye(3), lower + sparse.tril(lower, -1).T, format="csc")
        self._free = np.flatnonzero(~np.tile(knots.fixed.ravel(), 3))
        self._given = np.where(knots.fixed[..., None], start, 0.0)
        reduced = form[self._free][:, self._free]
        self._scale = 1.0 / np.sqrt(reduced.diagonal())
        scaling = sparse.diags(self._scale)
        self._form = _CURVATURE * sparse.triu(scaling @ reduced @ scaling, format="csc")
        self._linear = _CURVATURE * self._scale * self._flat(system.gradient(knots.value, self._given))[self._free]
        self._warm = self._flat(start)[self._free] / self._scale

    @staticmethod
    def _flat(unknown: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(unknown.transpose(2, 0, 1)).ravel()

    def solve(self, table: _Table, index: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, int]:
        """(n, 4, 3) solution with rows for planes `index` (r,) at `u` (r,), and -1 or the row most in conflict.

        Raises _GaveUpError: there is neither a solution nor a proof that there is none.
        """
        matrix, constant = self._rows(table, index, u)
        bound = table.bound[index]
        low = -(1.0 - _MARGIN) - (constant - table.centre[index]) / bound
        high = (1.0 - _MARGIN) - (constant - table.centre[index]) / bound
        scaled = (sparse.diags(1.0 / bound) @ matrix[:, self._free] @ sparse.diags(self._scale)).tocsc()
        solver = osqp.OSQP()
        solver.setup(self._form, self._linear, scaled, low, high, **_SOLVER)
        solver.warm_start(x=self._warm)
        with redirect_stdout(io.StringIO()):  # "Polishing not needed" is printed regardless of verbose (osqp/osqp issue 785)
            result = solver.solve(raise_error=False)
        status = osqp.SolverStatus
        if result.info.status_val in (status.OSQP_PRIMAL_INFEASIBLE, status.OSQP_PRIMAL_INFEASIBLE_INACCURATE):
            return self._given, int(np.argmax(np.abs(result.prim_inf_cert)))
        if result.info.status_val not in (status.OSQP_SOLVED, status.OSQP_SOLVED_INACCURATE):
            raise _GaveUpError(result.info.status)  # it leaves zeros in the place of a certificate
        self._warm = result.x
        flat = self._flat(self._given)
        flat[self._free] = self._scale * result.x
        n = len(self._knots.value)
        return np.ascontiguousarray(flat.reshape(3, n, ORDERS - 1).transpose(1, 2, 0)), -1

    def _rows(self, table: _Table, index: np.ndarray, u: np.ndarray) -> tuple[sparse.csc_matrix, np.ndarray]:
        """Rows over all unknowns, and the constant part from the given positions and derivatives."""
        piece, order, normal = table.piece[index], table.order[index], table.normal[index]
        durations, tau = self._system.durations[piece], self._system.tau
        rows = np.zeros((len(index), 2 * ORDERS))
        for k in range(3):
            rows[order == k] = derivative_rows(u[order == k], k) @ TO_COEFFICIENTS
        rows *= (durations[:, None] / tau) ** np.tile(np.arange(ORDERS), 2) / durations[:, None] ** order[:, None]
        data = self._system.hermite(self._knots.value, self._given)[piece]
        constant = np.einsum("rj,rjc,rc->r", rows, data, normal)
        size, width = self._count // 3, ORDERS - 1
        kept = [j for j in range(2 * ORDERS) if j not in (0, ORDERS)]
        column = width * piece[:, None] + np.arange(2 * width)
        columns = np.concatenate([axis * size + column for axis in range(3)], axis=1)
        values = np.concatenate([rows[:, kept] * normal[:, axis : axis + 1] for axis in range(3)], axis=1)
        row = np.repeat(np.arange(len(index)), columns.shape[1])
        matrix = sparse.csc_matrix((values.ravel(), (row, columns.ravel())), shape=(len(index), self._count))
        matrix.eliminate_zeros()
        return matrix, constant
