"""How smooth a space is: Dirichlet and Willmore energy of the star-shaped surface r(d), through spherical harmonics.

The radius is taken about the wrench origin and never re-centred; harmonics are real and orthonormal, degree 10 at most as in
the paper. E_D = sum l (l + 1) |a_lm|^2; E_W = int H^2 dA - int K dA on the fitted surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from firmware_py.prepare.capability.sphere import angles

L_MAX = 10
"""The paper's."""

LEAST_RATIO = 1e-3
"""Smallest r_min / r_max for which the Willmore energy means anything."""

_POLAR, _AZIMUTH = 128, 256
"""Nodes of the quadrature: int K is 4 pi to 1e-6 on all seven robots' spaces."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Energies of one surface.

    Attributes:
        dirichlet: E_D, in the radius's unit squared.
        dirichlet_scale_free: E_D / a_00^2.
        willmore: E_W, no unit; NaN where refused.
        refused: why, or empty.
        total_curvature: int K dA, 4 pi for any closed surface of this kind; tells how good the quadrature is.
        misfit: root mean square of fitted less given radius, as a share of the mean radius.
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
        self.l_max = l_max
        polar, azimuth = angles(directions)
        values, _, _ = _legendre(polar, l_max)
        order = _orders(l_max)
        turning = np.where(order[:, 1] >= 0, np.cos(np.outer(azimuth, order[:, 1])), -np.sin(np.outer(azimuth, order[:, 1])))
        self._matrix = values[:, order[:, 0], np.abs(order[:, 1])] * turning
        self._inverse = np.linalg.pinv(self._matrix)

    def fit(self, radius: np.ndarray) -> np.ndarray:
        """((l_max + 1)^2,) coefficients a_lm, by least squares; order of `_orders`."""
        return np.asarray(self._inverse @ radius)

    def shape(self, radius: np.ndarray) -> Shape:
        """Both energies of the surface with the given radius along each direction."""
        a = self.fit(radius)
        energy = dirichlet(a)
        misfit = float(np.sqrt(np.mean((self._matrix @ a - radius) ** 2)) / np.mean(radius)) if radius.any() else math.nan
        scale_free = energy / float(a[0] ** 2) if a[0] else math.nan
        ratio = float(radius.min() / radius.max()) if radius.max() > 0.0 else 0.0
        if ratio < LEAST_RATIO:
            return Shape(energy, scale_free, math.nan, f"r_min / r_max is {ratio:.1e}", math.nan, misfit)
        value, curvature, fitted_ratio = willmore(a, self.l_max)
        if fitted_ratio < LEAST_RATIO:
            return Shape(energy, scale_free, math.nan, "the fitted surface passes the origin", math.nan, misfit)
        return Shape(energy, scale_free, value, "", curvature, misfit)


def dirichlet(coefficients: np.ndarray) -> float:
    """E_D of coefficients in the order of `_orders`."""
    degree = _orders(math.isqrt(len(coefficients)) - 1)[:, 0]
    return float(np.sum(degree * (degree + 1) * coefficients**2))


def willmore(coefficients: np.ndarray, l_max: int) -> tuple[float, float, float]:
    """E_W, int K dA and r_min / r_max of the surface r(d) d, by Gauss-Legendre (polar) and trapezoidal (azimuth) quadrature."""
    x, weights = np.polynomial.legendre.leggauss(_POLAR)
    polar = np.arccos(x)[:, None]
    azimuth = 2.0 * np.pi * np.arange(_AZIMUTH)[None] / _AZIMUTH
    r, r_p, r_a, r_pp, r_pa, r_aa = _radius(coefficients, l_max, polar[:, 0], azimuth[0])
    if r.min() <= 0.0:
        return math.nan, math.nan, float(r.min() / r.max())
    sin, cos = np.sin(polar), np.cos(polar)
    # First and second fundamental forms of r e_r, in the frame (e_r, e_polar, e_azimuth) that turns with the angles.
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
    element = area / sin * weights[:, None] * (2.0 * np.pi / _AZIMUTH)
    return float(np.sum((mean**2 - gauss) * element)), float(np.sum(gauss * element)), float(r.min() / r.max())


def _radius(coefficients: np.ndarray, l_max: int, polar: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, ...]:
    """r and its derivatives p, a, pp, pa, aa (polar, azimuth) on the product grid, each (polar, azimuth)."""
    legendre = _legendre(polar, l_max)
    order = _orders(l_max)
    m = np.arange(l_max + 1)
    cosine, sine = np.cos(np.outer(m, azimuth)), np.sin(np.outer(m, azimuth))
    out = []
    by_cosine, by_sine = [], []
    for table in legendre:
        c, s = np.zeros((2, len(polar), l_max + 1))
        for a, (degree, k) in zip(coefficients, order, strict=True):
            (c if k >= 0 else s)[:, abs(k)] += a * table[:, degree, abs(k)]
        by_cosine.append(c)
        by_sine.append(s)
    for derivative, turns in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)):
        c, s = by_cosine[derivative], by_sine[derivative]
        if turns == 0:
            out.append(c @ cosine + s @ sine)
        elif turns == 1:
            out.append(-(c * m) @ sine + (s * m) @ cosine)
        else:
            out.append(-(c * m**2) @ cosine - (s * m**2) @ sine)
    return tuple(out)


def _orders(l_max: int) -> np.ndarray:
    """((l_max + 1)^2, 2) degree l and order m of each coefficient; m < 0 are the sines."""
    return np.array([(degree, m) for degree in range(l_max + 1) for m in range(-degree, degree + 1)])


def _legendre(polar: np.ndarray, l_max: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three arrays (n, l, m >= 0): orthonormal real harmonics without their turning, and two derivatives by the polar angle."""
    from scipy.special import sph_harm_y  # a quarter of a second to import

    tables = np.zeros((3, len(polar), l_max + 1, l_max + 1))
    for degree in range(l_max + 1):
        for m in range(degree + 1):
            value, gradient, hessian = sph_harm_y(degree, m, polar, 0.0, diff_n=2)
            factor = 1.0 if m == 0 else math.sqrt(2.0)
            for table, part in zip(tables, (value, gradient[..., 0], hessian[..., 0, 0]), strict=True):
                table[:, degree, m] = factor * part.real
    return tables[0], tables[1], tables[2]
