"""Smoothness of a space: Dirichlet and Willmore energy of the star-shaped surface r(d), through spherical harmonics.

The radius is taken about the wrench origin and never re-centred; harmonics are real and orthonormal, degree 10 at most
as in the paper. E_D = sum l (l + 1) |a_lm|^2; E_W = int H^2 dA - int K dA on the fitted surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from firmware_py.prepare.capability.sphere import angles

L_MAX = 10
"""Highest degree of the harmonics, as in the paper."""

LEAST_RATIO = 1e-3
"""Smallest r_min / r_max for which the Willmore energy is meaningful."""

_CURVATURE_ERROR = 1e-3
"""Largest relative error of int K dA = 4 pi with which a Willmore energy is accepted."""

_POLAR, _AZIMUTH = 128, 256
"""Nodes of the quadrature: int K is 4 pi to 1e-6 on all seven robots' spaces."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Energies of one surface.

    Attributes:
        dirichlet: E_D, in the radius's unit squared.
        dirichlet_scale_free: E_D / a_00^2.
        willmore: E_W, no unit; NaN where refused.
        refused: reason why E_W is refused; empty where it is not.
        total_curvature: int K dA, 4 pi for any closed surface of this kind; a measure of the quadrature's accuracy.
        misfit: root mean square of fitted minus given radius, as a share of the mean radius.
    """

    dirichlet: float
    dirichlet_scale_free: float
    willmore: float
    refused: str
    total_curvature: float
    misfit: float


class Harmonics:
    """Spherical harmonics on one set of directions; build once and fit many surfaces."""

    def __init__(self, directions: np.ndarray, l_max: int = L_MAX) -> None:
        if len(directions) < (l_max + 1) ** 2:
            raise ValueError(f"{len(directions)} directions are too few for harmonics of degree {l_max}")
        polar, azimuth = angles(directions)
        values, order = _legendre(polar, l_max), _orders(l_max)
        turning = np.where(
            order[:, 1] >= 0, np.cos(np.outer(azimuth, order[:, 1])), -np.sin(np.outer(azimuth, order[:, 1]))
        )
        self._matrix = values[:, order[:, 0], np.abs(order[:, 1])] * turning
        # Normal equations: even directions make the columns nearly orthogonal (condition 1.01 for 1000, 68 for 121).
        self._inverse = np.linalg.solve(self._matrix.T @ self._matrix, self._matrix.T)
        self._surface = Quadrature(l_max)

    def fit(self, radius: np.ndarray) -> np.ndarray:
        """((l_max + 1)^2,) coefficients a_lm, by least squares; order of `_orders`."""
        return np.asarray(self._inverse @ radius)

    def shape(self, radius: np.ndarray) -> Shape:
        """Both energies of the surface with the given radius along each direction."""
        a = self.fit(radius)
        energy = dirichlet(a)
        misfit = (
            float(np.sqrt(np.mean((self._matrix @ a - radius) ** 2)) / np.mean(radius)) if radius.any() else math.nan
        )
        scale_free = energy / float(a[0] ** 2) if a[0] else math.nan
        ratio = float(radius.min() / radius.max()) if radius.max() > 0.0 else 0.0
        if ratio < LEAST_RATIO:
            return Shape(energy, scale_free, math.nan, f"r_min / r_max is {ratio:.1e}", math.nan, misfit)
        value, curvature, fitted_ratio = self._surface.willmore(a)
        if fitted_ratio < LEAST_RATIO:
            return Shape(energy, scale_free, math.nan, "the fitted surface passes the origin", math.nan, misfit)
        if abs(curvature / (4.0 * math.pi) - 1.0) > _CURVATURE_ERROR:
            return Shape(energy, scale_free, math.nan, "too sharp for the quadrature", curvature, misfit)
        return Shape(energy, scale_free, value, "", curvature, misfit)


def dirichlet(coefficients: np.ndarray) -> float:
    """E_D of coefficients in the order of `_orders`."""
    degree = _orders(math.isqrt(len(coefficients)) - 1)[:, 0]
    return float(np.sum(degree * (degree + 1) * coefficients**2))


class Quadrature:
    """Gauss-Legendre nodes in the polar angle, even ones in azimuth, and the harmonics on them."""

    def __init__(self, l_max: int) -> None:
        x, weights = np.polynomial.legendre.leggauss(_POLAR)
        polar = np.arccos(x)
        azimuth = 2.0 * np.pi * np.arange(_AZIMUTH) / _AZIMUTH
        self._order = _orders(l_max)
        values = _legendre(polar, l_max)
        self._tables = (values, *_derivatives(polar, values))
        turns = np.outer(np.arange(l_max + 1), azimuth)
        self._cosine, self._sine = np.cos(turns), np.sin(turns)
        self._sin, self._cos = np.sin(polar)[:, None], np.cos(polar)[:, None]
        self._weights = weights[:, None] * (2.0 * np.pi / _AZIMUTH)

    def willmore(self, coefficients: np.ndarray) -> tuple[float, float, float]:
        """E_W, int K dA and r_min / r_max of the surface r(d) d; the energies NaN where it passes the origin."""
        r, r_p, r_a, r_pp, r_pa, r_aa = self._radius(coefficients)
        if r.min() <= 0.0:
            return math.nan, math.nan, float(r.min() / r.max())
        sin, cos = self._sin, self._cos
        # First and second fundamental forms of r e_r, in the frame (e_r, e_polar, e_azimuth).
        e, f, g = r_p**2 + r**2, r_p * r_a, r_a**2 + (r * sin) ** 2
        area = np.sqrt(e * g - f * f)
        normal = np.stack([r * r * sin, -r * r_p * sin, -r * r_a]) / area
        second = (
            np.stack([r_pp - r, 2.0 * r_p, np.zeros_like(r)]),
            np.stack([r_pa, r_a, r_p * sin + r * cos]),
            np.stack([r_aa - r * sin**2, -r * sin * cos, 2.0 * r_a * sin]),
        )
        ll, mm, nn = (np.sum(normal * part, axis=0) for part in second)
        mean = (e * nn - 2.0 * f * mm + g * ll) / (2.0 * area**2)
        gauss = (ll * nn - mm * mm) / area**2
        element = area / sin * self._weights
        return float(np.sum((mean**2 - gauss) * element)), float(np.sum(gauss * element)), float(r.min() / r.max())

    def _radius(self, coefficients: np.ndarray) -> tuple[np.ndarray, ...]:
        """r and its derivatives p, a, pp, pa, aa (polar, azimuth), each (polar nodes, azimuth nodes)."""
        parts = []
        for table in self._tables:
            c, s = np.zeros((2, *table.shape[::2]))
            for a, (degree, m) in zip(coefficients, self._order, strict=True):
                (c if m >= 0 else s)[:, abs(m)] += a * table[:, degree, abs(m)]
            parts.append((c, s))
        out = []
        m = np.arange(self._cosine.shape[0])
        for derivative, turns in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)):
            c, s = parts[derivative]
            if turns == 0:
                out.append(c @ self._cosine + s @ self._sine)
            elif turns == 1:
                out.append((s * m) @ self._cosine - (c * m) @ self._sine)
            else:
                out.append(-(c * m**2) @ self._cosine - (s * m**2) @ self._sine)
        return tuple(out)


def _orders(l_max: int) -> np.ndarray:
    """((l_max + 1)^2, 2) degree l and order m of each coefficient; m < 0 are the sines."""
    return np.array([(degree, m) for degree in range(l_max + 1) for m in range(-degree, degree + 1)])


def _legendre(polar: np.ndarray, l_max: int) -> np.ndarray:
    """(n, l, m >= 0) orthonormal real harmonics without their azimuthal factor.

    Fully normalised associated Legendre functions by the standard recurrence from degree to degree (Holmes and
    Featherstone, J. Geodesy 76, 2002, eqs. 11 to 13).
    """
    x, s = np.cos(polar), np.sin(polar)
    values = np.zeros((len(polar), l_max + 1, l_max + 1))
    values[:, 0, 0] = math.sqrt(0.25 / math.pi)
    for degree in range(1, l_max + 1):
        top = math.sqrt((2 * degree + 1) / (2 * degree)) * (math.sqrt(2.0) if degree == 1 else 1.0)
        values[:, degree, degree] = top * s * values[:, degree - 1, degree - 1]
        for m in range(degree):
            a = math.sqrt((4 * degree**2 - 1) / (degree**2 - m**2))
            values[:, degree, m] = a * x * values[:, degree - 1, m]
            if degree >= m + 2:
                b = math.sqrt(((degree - 1) ** 2 - m**2) / (4 * (degree - 1) ** 2 - 1))
                values[:, degree, m] -= a * b * values[:, degree - 2, m]
    return values


def _derivatives(polar: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivative of `_legendre` by the polar angle, the second from Legendre's equation. Require sin(polar) > 0."""
    x, s, slopes = np.cos(polar), np.sin(polar), np.zeros_like(values)
    orders = np.arange(values.shape[1])
    degrees = orders[:, None]
    for degree in orders[1:]:
        c = np.sqrt(np.maximum((2 * degree + 1) / (2 * degree - 1) * (degree**2 - orders**2), 0.0))
        slopes[:, degree] = (degree * x[:, None] * values[:, degree] - c * values[:, degree - 1]) / s[:, None]
    square = (s**2)[:, None, None]
    bends = -(x / s)[:, None, None] * slopes - (degrees * (degrees + 1) - orders**2 / square) * values
    return slopes, bends
