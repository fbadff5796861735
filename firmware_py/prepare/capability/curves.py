"""Thruster curves out of measured tables: fifth-order polynomials without a constant term that rise everywhere on 0..1.

Used when a vehicle file is made; `core.thruster` inverts the force polynomial, so it must rise. Plain least squares
falls near zero command, where a measured thruster does nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.special import comb

DEGREE = 5
"""The paper's order."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted polynomial c[0] x + ... + c[4] x^5.

    Attributes:
        coefficients: (5,).
        rms, largest: residual over the samples, in the unit of the ordinate.
    """

    coefficients: np.ndarray
    rms: float
    largest: float


@dataclass(frozen=True, slots=True, eq=False)
class ThrusterFit:
    """One thruster: force over command 0..1 (N) and power over force size (W), each way, and the measured deadband."""

    forward: Fit
    reverse: Fit
    power_forward: Fit
    power_reverse: Fit
    deadband_n: float


def rising_polynomial(x: np.ndarray, y: np.ndarray, least_slope: float = 0.0) -> Fit:
    """Least squares over fifth-order polynomials through the origin with a lower bound on the slope.

    The slope is sum b_k B_k,4(x) in Bernstein's basis with b_k >= least_slope, so it is at least that everywhere on
    0..1, not on a grid alone; non-negative least squares (Lawson and Hanson) solves the bounded problem exactly.

    Args:
        x: (n,) abscissa, 0 to 1.
        y: (n,) ordinate.
        least_slope: smallest slope.

    Raises:
        ValueError: abscissa outside of 0..1.
    """
    if x.size == 0 or x.min() < 0.0 or x.max() > 1.0:
        raise ValueError("the abscissa of a thruster curve must be within 0 to 1")
    powers = x[:, None] ** np.arange(1, DEGREE + 1)
    to_monomials = _integrated_bernstein()
    basis = powers @ to_monomials
    floor = np.full(DEGREE, least_slope)
    above, _ = nnls(basis, y - basis @ floor)
    coefficients = to_monomials @ (floor + above)
    residual = powers @ coefficients - y
    return Fit(coefficients, float(np.sqrt(np.mean(residual**2))), float(np.abs(residual).max()))


def _integrated_bernstein() -> np.ndarray:
    """(5, 5) column k: coefficients of x..x^5 of the integral from 0 of the k-th Bernstein polynomial of degree 4."""
    n = DEGREE - 1
    columns = np.zeros((DEGREE, DEGREE))
    for k in range(DEGREE):
        for j in range(k, DEGREE):
            columns[j, k] = comb(n, k) * comb(n - k, j - k) * (-1) ** (j - k) / (j + 1)
    return columns


def fit_thruster(
    command: np.ndarray, force_n: np.ndarray, power_w: np.ndarray, least_slope: float = 0.5
) -> ThrusterFit:
    """The polynomials of one measured thruster.

    Args:
        command: (n,) -1 to 1.
        force_n: (n,) N, with the command's sign.
        power_w: (n,) W.
        least_slope: smallest slope of force over command, N; keeps the inverse well defined in the deadband.
    """
    force: list[Fit] = []
    power: list[Fit] = []
    for sign in (1.0, -1.0):
        side = sign * command >= 0.0
        force.append(rising_polynomial(sign * command[side], sign * force_n[side], least_slope))
        full = float((sign * force_n[side]).max())
        scaled = rising_polynomial(sign * force_n[side] / full, power_w[side])
        per_newton = scaled.coefficients / full ** np.arange(1, DEGREE + 1)
        power.append(Fit(per_newton, scaled.rms, scaled.largest))
    working = np.abs(force_n[force_n != 0.0])
    return ThrusterFit(force[0], force[1], power[0], power[1], float(working.min()))
