"""Largest ellipsoid inside a polytope: max log det B, |B a_i| + a_i . x <= b_i (V_MIE), by an interior-point method.

The problem has nine unknowns: Newton's method on the logarithmic barrier solves it in milliseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

_GAP = 1e-9
"""Tolerated distance from the optimum, in log det."""

_GROWTH = 20.0
"""Factor of the barrier's weight from one centring to the next (Boyd and Vandenberghe, 11.3)."""

_CLOSE = 0.05
"""Squared Newton decrement below which a full step stays inside; the error that remains is this, over the barrier's weight."""

_MOST_STEPS = 200
"""Newton steps of one centring; ten are usual."""


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """{B u + x : |u| <= 1}.

    Attributes:
        shape: (d, d) symmetric positive definite B.
        centre: (d,) x.
    """

    shape: np.ndarray
    centre: np.ndarray

    @property
    def volume(self) -> float:
        """4/3 pi det B in three dimensions, pi det B in two, twice B in one; N^d or (N m)^d."""
        d = len(self.centre)
        return float(math.pi ** (d / 2) / math.gamma(d / 2 + 1) * np.linalg.det(self.shape))


def largest_inscribed(normals: np.ndarray, offsets: np.ndarray) -> Ellipsoid:
    """The largest ellipsoid inside {y : normals @ y <= offsets}, which must contain the origin and be bounded.

    Args:
        normals: (m, d) rows a_i.
        offsets: (m,) b_i > 0.

    Raises:
        ValueError: the origin is not inside.
        RuntimeError: no convergence.
    """
    if offsets.min() <= 0.0:
        raise ValueError("the largest inscribed ellipsoid needs a polytope with the origin inside")
    unit = float(offsets.min())
    barrier = _Barrier(normals, offsets / unit)
    p = barrier.start()
    weight = 1.0
    while True:
        p = barrier.centred(p, weight)
        if 2.0 * len(offsets) / weight < _GAP:
            break
        weight *= _GROWTH
    shape, centre = barrier.unpack(p)
    return Ellipsoid(shape * unit, centre * unit)


class _Barrier:
    """-weight log det B - sum log((b_i - a_i . x)^2 - |B a_i|^2) over p = (upper triangle of B, x)."""

    def __init__(self, a: np.ndarray, b: np.ndarray) -> None:
        self._a, self._b = a, b
        d = a.shape[1]
        self._d = d
        pairs = [(i, j) for i in range(d) for j in range(i, d)]
        self._basis = np.zeros((len(pairs), d, d))
        for k, (i, j) in enumerate(pairs):
            self._basis[k, i, j] = self._basis[k, j, i] = 1.0
        self._moves = np.einsum("kde,me->mdk", self._basis, a)  # B a_i = moves[i] @ p[:k]

    def start(self) -> np.ndarray:
        """Half of the largest ball about the origin."""
        radius = 0.5 * float((self._b / np.linalg.norm(self._a, axis=1)).min())
        return np.concatenate([radius * np.einsum("kii->k", self._basis), np.zeros(self._d)])

    def unpack(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = len(self._basis)
        return np.einsum("k,kde->de", p[:k], self._basis), p[k:]

    def value(self, p: np.ndarray, weight: float) -> float:
        """Value of the barrier function; infinite outside the polytope."""
        shape, centre = self.unpack(p)
        if not np.all(np.linalg.eigvalsh(shape) > 0.0):
            return math.inf
        slack = self._b - self._a @ centre
        gap = slack**2 - np.sum((self._a @ shape) ** 2, axis=1)
        if not (np.all(slack > 0.0) and np.all(gap > 0.0)):
            return math.inf
        return -weight * float(np.linalg.slogdet(shape)[1]) - float(np.log(gap).sum())

    def derivatives(self, p: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Hessian."""
        shape, centre = self.unpack(p)
        k = len(self._basis)
        slack = self._b - self._a @ centre
        image = self._a @ shape
        gap = slack**2 - np.sum(image**2, axis=1)
        slope = -2.0 * np.hstack([np.einsum("mdk,md->mk", self._moves, image), slack[:, None] * self._a])
        gradient = -np.sum(slope / gap[:, None], axis=0)
        hessian = (slope / gap[:, None] ** 2).T @ slope
        hessian[:k, :k] += 2.0 * np.einsum("mdk,mdl,m->kl", self._moves, self._moves, 1.0 / gap)
        hessian[k:, k:] -= 2.0 * (self._a / gap[:, None]).T @ self._a
        turned = np.linalg.inv(shape) @ self._basis
        gradient[:k] -= weight * np.einsum("kii->k", turned)
        hessian[:k, :k] += weight * np.einsum("kij,lji->kl", turned, turned)
        return gradient, hessian

    def centred(self, p: np.ndarray, weight: float) -> np.ndarray:
        """A point close to the minimum for one weight, by Newton's method with backtracking.

        The function is self-concordant; below _CLOSE a comparison of values would only compare rounding errors.
        """
        for _ in range(_MOST_STEPS):
            gradient, hessian = self.derivatives(p, weight)
            step = -np.linalg.solve(hessian, gradient)
            decrement = -float(gradient @ step)
            if decrement < _CLOSE:
                return p + step
            here, length = self.value(p, weight), 1.0
            while self.value(p + length * step, weight) > here - 0.25 * length * decrement:
                length *= 0.5
            p = p + length * step
        raise RuntimeError("the largest inscribed ellipsoid was not found")
