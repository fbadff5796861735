"""For tools/identify.py: the unknowns that best explain recorded flights, and their uncertainty.

Gauss-Newton on the rows of all flights. The gusts of each flight are unknowns too, with a Gauss-Markov process as their prior; the standard
deviations of gusts and rows are estimated along with them (expectation maximisation: Dempster, Laird and Rubin 1977). The remaining model
error is not white noise. The covariance is therefore the sandwich of Newey and West (1987) over a window of 10 s, and the intervals are
wider than normal ones according to that window's share of the record (Kiefer and Vogelsang 2005, table 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from identify_model import NUISANCES, Equations, Unknown, gust_precision, initial_values, slices_by_name, unknowns

MEMORY_S = 10.0
"""Time over which errors are assumed to be correlated."""
GUST_M_S = 0.02
"""Initial value of the standard deviation of gusts."""
MOST_STEPS = 15
STEP_TOLERANCE = 0.05
"""Largest step, in standard errors, at which the search ends."""
CERTAIN = 1e-6
"""Standard deviation of the prior that fixes a scale which nothing measures."""


@dataclass(frozen=True, slots=True)
class Reference:
    """Known gain of one thruster: 1, for the curve that was measured on it, to within `accuracy` of it."""

    thruster: int
    accuracy: float

    @property
    def sigma(self) -> float:
        """Standard deviation of a uniform distribution between the bounds (GUM 4.3.7)."""
        return self.accuracy / math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit.

    Attributes:
        x: (p,) unknowns of the vehicle. slices: slice of each in x, by name.
        covariance: (p, p). critical: half-width of a 95 % interval in standard errors.
        residual: (6,) standard deviation of the residuals, m/s^2 and rad/s^2. gust_m_s: that of the gusts.
        has_scale: whether any absolute reference was known; otherwise gains are scaled to a mean of 1.
    """

    x: np.ndarray
    slices: dict[str, slice]
    covariance: np.ndarray
    critical: float
    residual: np.ndarray
    gust_m_s: float
    has_scale: bool

    def value(self, name: str) -> np.ndarray:
        """Value of one unknown."""
        return self.x[self.slices[name]]

    def interval(self, function: Callable[[np.ndarray], float]) -> tuple[float, float]:
        """Value of a function of the unknowns, and the half-width of its 95 % interval, to first order."""
        sigma = np.sqrt(np.diag(self.covariance))
        slope = np.zeros(len(self.x))
        for i in np.flatnonzero(sigma):
            ahead, behind = self.x.copy(), self.x.copy()
            ahead[i] += 1e-5
            behind[i] -= 1e-5
            slope[i] = (function(ahead) - function(behind)) / 2e-5
        return function(self.x), self.critical * math.sqrt(max(0.0, slope @ self.covariance @ slope))


def fit(flights: Sequence[Equations], reference: Reference | None = None, has_weight: bool = False) -> Fit:
    """Fits all flights of one vehicle at once; without `reference` and weight the mean gain is defined as 1."""
    vehicle = flights[0].vehicle
    mine = unknowns(vehicle)
    shared, count = slices_by_name(mine), sum(u.size for u in mine)
    parts, own = _with_nuisances(mine, flights)
    gusts = [np.kron(gust_precision(flight.knots.shape[1]), np.eye(3)) for flight in flights]
    width = np.concatenate([np.full(u.size, u.width) for u in parts])
    step = np.concatenate([np.full(u.size, u.step) for u in parts])
    first = np.zeros(len(width))
    first[:count] = np.concatenate(list(initial_values(vehicle).values()))
    scale, pull = _scale_row(shared["gain"], len(first), reference, has_weight)
    prior = np.diag(width**-2.0) + pull * np.outer(scale, scale)  # about `first`, whose gains of 1 satisfy the scale row
    x, noise, gust = first.copy(), np.zeros(6), GUST_M_S
    for _ in range(MOST_STEPS):
        for at, precision in zip(own, gusts, strict=True):
            prior[at["gust"], at["gust"]] = precision / gust**2
        rows = [_rows(flight, x, step, shared | at) for flight, at in zip(flights, own, strict=True)]
        residual = np.concatenate([each for each, _ in rows])
        sigma = np.sqrt(np.mean(residual**2, axis=0) + noise)
        flat = [(slopes / sigma[:, None]).reshape(-1, len(x)) for _, slopes in rows]
        information = prior + sum(each.T @ each for each in flat)
        inverse = np.linalg.inv(information)
        score = sum(each.T @ (left / sigma).ravel() for each, (left, _) in zip(flat, rows, strict=True))
        move = inverse @ (score - prior @ (x - first))
        x = x + move
        noise = sum(np.einsum("np,pq,nq->n", each, inverse, each, optimize=True).reshape(-1, 6).sum(axis=0) for each in flat)
        noise = noise * sigma**2 / len(residual)
        gust = _gust_m_s(x, inverse, [at["gust"] for at in own], gusts)
        if np.all(np.abs(move) < STEP_TOLERANCE * np.sqrt(np.diag(inverse))):
            break
    lags = [max(1, round(MEMORY_S / float(np.median(np.diff(flight.time_s))))) for flight in flights]
    scores = [np.einsum("nki,nk->ni", slopes, left / sigma**2) for left, slopes in rows]
    covariance = inverse @ sum(map(_long_run, scores, lags), prior) @ inverse
    share = max(lag / len(each) / len(flights) for lag, each in zip(lags, scores, strict=True))
    critical = critical_value(min(share, 1.0))
    return Fit(x[:count], shared, covariance[:count, :count], critical, sigma, gust, reference is not None or has_weight)


def _with_nuisances(mine: Sequence[Unknown], flights: Sequence[Equations]) -> tuple[list[Unknown], list[dict[str, slice]]]:
    """All unknowns, the vehicle's and then those of each flight, and the slices of each flight's own by name."""
    parts, own = list(mine), []
    for flight in flights:
        nuisances = [*NUISANCES, Unknown("gust", 3 * flight.knots.shape[1], math.inf)]
        own.append(slices_by_name(nuisances, sum(u.size for u in parts)))
        parts += nuisances
    return parts, own


def _gust_m_s(x: np.ndarray, inverse: np.ndarray, where: Sequence[slice], precisions: Sequence[np.ndarray]) -> float:
    """Standard deviation of the gusts of all flights, from their estimates and the uncertainty of these (`inverse`: covariance)."""
    squares = [x[at] @ p @ x[at] + np.sum(p * inverse[at, at]) for at, p in zip(where, precisions, strict=True)]
    return math.sqrt(sum(squares) / sum(map(len, precisions)))


def critical_value(share: float) -> float:
    """Half-width of a 95 % interval in standard errors for a window that is `share` of the record; 1.96 for a share of 0."""
    return 1.96 + 2.9694 * share + 0.4160 * share**2 - 0.5324 * share**3


def _scale_row(gains: slice, count: int, reference: Reference | None, has_weight: bool) -> tuple[np.ndarray, float]:
    """(p,) row whose product with the unknowns should be 1, and the weight of that: the reference's thruster, or else the mean gain."""
    row = np.zeros(count)
    if reference is not None:
        row[gains.start + reference.thruster] = 1.0
        return row, reference.sigma**-2.0
    row[gains] = 1.0 / (gains.stop - gains.start)
    return row, 0.0 if has_weight else CERTAIN**-2.0


def _rows(flight: Equations, x: np.ndarray, step: np.ndarray, where: dict[str, slice]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 6) residuals, measured less predicted, and (n, 6, p) slopes of the prediction."""
    expected = flight.predict({name: x[at] for name, at in where.items()})
    slopes = np.zeros((*expected.shape, len(x)))
    for at in (where[name] for name in where if name != "gust"):
        for i in range(at.start, at.stop):
            ahead = x.copy()
            ahead[i] += step[i]
            slopes[:, :, i] = (flight.predict({name: ahead[k] for name, k in where.items()}) - expected) / step[i]
    mean = slopes[:, :, where["current"]]  # a gust acts like the mean, at the times of its knot
    slopes[:, :, where["gust"]] = (mean[:, :, None, :] * flight.knots[:, None, :, None]).reshape(*expected.shape, -1)
    return flight.measured - expected, slopes


def _long_run(scores: np.ndarray, lags: int) -> np.ndarray:
    """(p, p) covariance of the sum of (n, p) scores that are correlated over `lags` rows: Bartlett weights."""
    total = scores.T @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        between = scores[:-lag].T @ scores[lag:]
        total += (1.0 - lag / (lags + 1.0)) * (between + between.T)
    return np.asarray(total)
