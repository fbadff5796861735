"""Minimum snap under limits: velocity, acceleration and corridor as linear constraint rows, solved with OSQP.

Each piece starts with rows at a few points. Where the result violates a limit in between, a row is added at the crest and
the problem is solved again, so that the limits hold everywhere and not only at samples.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import redirect_stdout

import numpy as np
import osqp
import scipy.sparse as sparse

from firmware_py.prepare.snap_limits import InfeasibleError, Plane, PlaneTable, place_on, towards_ends, worst
from firmware_py.prepare.snap_spline import ORDERS, TO_COEFFICIENTS, Knots, System, derivative_rows

_FIRST_POINTS = 8
"""Number of points of each piece with rows from the start."""

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
    table = PlaneTable.of(limits).in_unit(unit_m)
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
            place = place_on(limit.piece, float(where[conflict]), system.durations)
            raise InfeasibleError(f"no trajectory {in_time} keeps the {limit.name}", place)
        excess, crest = table.excess(system.coefficients(knots.value, unknown), system.durations)
        broken = np.flatnonzero(excess > 1.0)
        if not len(broken):
            return unit_m * unknown
        index = np.concatenate([index, broken])
        where = np.concatenate([where, crest[broken]])
    k = int(np.argmax(excess))
    place = place_on(limits[k].piece, float(crest[k]), system.durations)
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

    def solve(self, table: PlaneTable, index: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, int]:
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

    def _rows(self, table: PlaneTable, index: np.ndarray, u: np.ndarray) -> tuple[sparse.csc_matrix, np.ndarray]:
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
