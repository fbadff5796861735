"""The quadratic core of minimum snap: ninth-degree pieces, given by their values and derivatives at the waypoints.

The unknowns are velocity, acceleration, jerk and snap at each waypoint; positions are exact and derivatives up to the fourth
are continuous by construction. Without limits the optimum is the interpolating spline of degree seven.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.linalg import solveh_banded
from scipy.optimize import minimize

DEGREE = 9
ORDERS = 5
"""Position, velocity, acceleration, jerk, snap: the quantities that neighbouring pieces share."""

_UNKNOWN = ORDERS - 1

_SHORTER, _LONGER = 100.0, 10.0
"""How much shorter, and longer, a piece may be in time than the longest one at uniform speed. Beyond, the form is too stiff for floats."""
_TOO_STIFF = 1e3
"""Log-cost returned for a form too stiff to evaluate; above all others."""


def _falling(power: int, order: int) -> int:
    product = 1
    for k in range(order):
        product *= power - k
    return product


def _inverse(rows: list[list[Fraction]]) -> np.ndarray:
    """Inverse by Gauss-Jordan in fractions: the matrix is ill-conditioned for floats; its inverse has integers over 24."""
    n = len(rows)
    work = [row + [Fraction(int(i == j)) for j in range(n)] for i, row in enumerate(rows)]
    for k in range(n):
        pivot = next(i for i in range(k, n) if work[i][k] != 0)
        work[k], work[pivot] = work[pivot], work[k]
        work[k] = [value / work[k][k] for value in work[k]]
        for i in range(n):
            if i != k and work[i][k] != 0:
                work[i] = [a - work[i][k] * b for a, b in zip(work[i], work[k], strict=True)]
    return np.array([[float(value) for value in row[n:]] for row in work])


def _hermite_to_coefficients() -> np.ndarray:
    """(10, 10) map from derivatives 0..4 at u = 0 and at u = 1 to coefficients of 1, u, ..., u^9."""
    start = [[Fraction(_falling(j, o) if j == o else 0) for j in range(DEGREE + 1)] for o in range(ORDERS)]
    end = [[Fraction(_falling(j, o)) for j in range(DEGREE + 1)] for o in range(ORDERS)]
    return _inverse(start + end)


TO_COEFFICIENTS = _hermite_to_coefficients()
TO_COEFFICIENTS.flags.writeable = False


def _snap_form() -> np.ndarray:
    """(10, 10) Z with z^T Z z = integral over u of the squared fourth derivative, for Hermite data z."""
    power = np.zeros((DEGREE + 1, DEGREE + 1))
    for i in range(4, DEGREE + 1):
        for j in range(4, DEGREE + 1):
            power[i, j] = _falling(i, 4) * _falling(j, 4) / (i + j - 7)
    return np.asarray(TO_COEFFICIENTS.T @ power @ TO_COEFFICIENTS)


SNAP_FORM = _snap_form()
SNAP_FORM.flags.writeable = False

_ORDER = np.tile(np.arange(ORDERS), 2)


def derivative_rows(u: np.ndarray, order: int) -> np.ndarray:
    """(k, 10) rows that map coefficients to the derivative of `order` in u at (k,) u."""
    rows = np.zeros((len(u), DEGREE + 1))
    for j in range(order, DEGREE + 1):
        rows[:, j] = _falling(j, order) * u ** (j - order)
    return rows


@dataclass(frozen=True, eq=False)
class Knots:
    """Given values at n waypoints for c channels.

    Attributes:
        value: (n, c) positions.
        fixed: (n, 4) whether velocity, acceleration, jerk, snap are given.
        derivative: (n, 4, c) their values where given.
    """

    value: np.ndarray
    fixed: np.ndarray
    derivative: np.ndarray

    @staticmethod
    def at_rest(value: np.ndarray) -> Knots:
        """Knots with zero velocity, acceleration and jerk at both ends; all other derivatives are free."""
        n, c = value.shape
        fixed = np.zeros((n, _UNKNOWN), dtype=bool)
        fixed[[0, -1], :3] = True
        return Knots(value, fixed, np.zeros((n, _UNKNOWN, c)))


@dataclass(frozen=True, eq=False)
class System:
    """The cost of n waypoints as a block-tridiagonal form in the scaled derivatives d_o tau^o.

    Attributes:
        durations: (n - 1,) s.
        tau: time scale, s.
        blocks: (n - 1, 10, 10) form of each piece in its scaled Hermite data.
    """

    durations: np.ndarray
    tau: float
    blocks: np.ndarray

    @staticmethod
    def of(durations: np.ndarray) -> System:
        """The form for (n - 1,) durations."""
        tau = float(np.mean(durations))
        scale = (durations[:, None] / tau) ** _ORDER
        blocks = SNAP_FORM * scale[:, :, None] * scale[:, None, :] / (durations[:, None, None] / tau) ** 7
        return System(durations, tau, blocks)

    def banded(self) -> np.ndarray:
        """(8, 4 n) lower banded storage of the form in the unknowns (velocity to snap of every waypoint)."""
        n = len(self.durations) + 1
        diagonal = np.zeros((n, _UNKNOWN, _UNKNOWN))
        diagonal[:-1] += self.blocks[:, 1:ORDERS, 1:ORDERS]
        diagonal[1:] += self.blocks[:, ORDERS + 1 :, ORDERS + 1 :]
        below = self.blocks[:, ORDERS + 1 :, 1:ORDERS]
        bands = np.zeros((2 * _UNKNOWN, n, _UNKNOWN))
        for column in range(_UNKNOWN):
            for row in range(column, _UNKNOWN):
                bands[row - column, :, column] = diagonal[:, row, column]
            for row in range(_UNKNOWN):
                bands[_UNKNOWN + row - column, :-1, column] = below[:, row, column]
        return bands.reshape(2 * _UNKNOWN, n * _UNKNOWN)

    def gradient(self, value: np.ndarray, unknown: np.ndarray) -> np.ndarray:
        """(n, 4, c) half the gradient in the unknowns (n, 4, c) at positions `value` (n, c)."""
        data = self.hermite(value, unknown)
        piece = np.einsum("kij,kjc->kic", self.blocks, data)
        total = np.zeros_like(unknown)
        total[:-1] += piece[:, 1:ORDERS]
        total[1:] += piece[:, ORDERS + 1 :]
        return total

    def hermite(self, value: np.ndarray, unknown: np.ndarray) -> np.ndarray:
        """(n - 1, 10, c) scaled Hermite data of each piece."""
        knots = np.concatenate([value[:, None], unknown], axis=1)
        return np.concatenate([knots[:-1], knots[1:]], axis=1)

    def coefficients(self, value: np.ndarray, unknown: np.ndarray) -> np.ndarray:
        """(n - 1, 10, c) coefficients in u = t / duration of each piece."""
        scale = (self.durations[:, None] / self.tau) ** _ORDER
        return np.asarray(np.einsum("ij,kjc->kic", TO_COEFFICIENTS, self.hermite(value, unknown) * scale[:, :, None]))

    def cost(self, value: np.ndarray, unknown: np.ndarray) -> float:
        """Integral of the squared snap over all pieces and channels, (m/s^4)^2 s for metres."""
        data = self.hermite(value, unknown)
        return float(np.einsum("kic,kij,kjc->", data, self.blocks, data) / self.tau**7)

    def cost_by_duration(self, value: np.ndarray, unknown: np.ndarray) -> np.ndarray:
        """(n - 1,) derivative of the least cost by each duration: at the optimum only the explicit part counts."""
        data = self.hermite(value, unknown)
        power = _ORDER[:, None] + _ORDER[None, :] - 7
        return np.asarray(np.einsum("kic,kij,kjc->k", data, self.blocks * power, data) / self.durations / self.tau**7)


def solve(system: System, knots: Knots) -> np.ndarray:
    """(n, 4, c) scaled derivatives of least snap in closed form: one banded Cholesky factor for all channels."""
    n, channels = knots.value.shape
    given = np.where(knots.fixed[..., None], knots.derivative, 0.0) * system.tau ** np.arange(1, ORDERS)[:, None]
    bands = system.banded()
    fixed = knots.fixed.ravel()
    right = -system.gradient(knots.value, given).reshape(n * _UNKNOWN, channels)
    for offset in range(1, len(bands)):
        touched = fixed[:-offset] | fixed[offset:]
        bands[offset, :-offset][touched] = 0.0
    bands[0, fixed] = 1.0
    right[fixed] = 0.0
    step = solveh_banded(bands, right, lower=True, overwrite_ab=True, overwrite_b=True, check_finite=False)
    return np.asarray(given + step.reshape(n, _UNKNOWN, channels))


def divide_time(knots: Knots, total_s: float) -> np.ndarray:
    """(n - 1,) durations of sum `total_s` with the least snap.

    Args:
        knots: waypoints and the derivatives given there.
        total_s: s.
    """
    distance = np.linalg.norm(np.diff(knots.value, axis=0), axis=1)
    if distance.max() == 0.0:
        return np.full(len(distance), total_s / len(distance))
    start = np.log(np.maximum(distance, distance.max() / _SHORTER))

    def log_cost(z: np.ndarray) -> tuple[float, np.ndarray]:
        share = np.exp(z - z.max())
        share /= share.sum()
        system = System.of(total_s * share)
        unknown = solve(system, knots)
        cost = system.cost(knots.value, unknown)
        if not cost > 0.0:
            return _TOO_STIFF, np.zeros_like(z)
        by_share = total_s * system.cost_by_duration(knots.value, unknown) / cost
        return float(np.log(cost)), share * (by_share - share @ by_share)

    bounds = [(start.max() - np.log(_SHORTER), start.max() + np.log(_LONGER))] * len(start)
    best = minimize(log_cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 100, "ftol": 1e-6}).x
    share = np.exp(best - best.max())
    return np.asarray(total_s * share / share.sum())
