"""An actuation layout: the wrench, force limits and power of each thruster.

Columns are [direction; position x direction] about the centre of mass: the paper's Jacobian with its two terms corrected.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.core.body import ThrusterSet
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import AXES, Vehicle
from firmware_py.prepare.assembly import PITCH_M, Balance, place, thruster_set
from firmware_py.prepare.joints import check_joints

FRAMES = {"force": (0, 1, 2), "torque": (3, 4, 5)}
"""Components of a wrench that belong to each frame; the others are held at zero."""

UNITS = {"force": "N", "torque": "N m"}

NORMALISATIONS = ("physical", "unit_thrust", "equal_total_thrust")

REFERENCE_THRUSTERS = 8
"""Number of thrusters of the paper's module, to whose total thrust `equal_total_thrust` scales every robot."""

_RANK_TOLERANCE = 1e-9
"""Singular values below this share of the largest count as zero (torque rows scaled by the lever arm)."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """n thrusters about one centre of mass.

    Attributes:
        name: for display.
        matrix: (6, n) wrench of unit forces, N and N m, body axes.
        f_min, f_max: (n,) N.
        power_forward, power_reverse: (n, 5) W over force size, no constant term; empty (n, 0) where unknown.
        passive: wrench components that buoyancy holds; they matter only in `with_passive_declared`.
        assumption: facts that are assumed, not measured.
    """

    name: str
    matrix: np.ndarray
    f_min: np.ndarray
    f_max: np.ndarray
    power_forward: np.ndarray
    power_reverse: np.ndarray
    passive: tuple[int, ...] = ()
    assumption: str = ""

    def __post_init__(self) -> None:
        if self.matrix.shape[0] != 6 or self.matrix.shape[1] == 0:
            raise DescriptionError(f"{self.name}: has no thrusters")
        if not np.all(np.isfinite(self.matrix)):
            raise DescriptionError(
                f"{self.name}: thruster {_first(~np.isfinite(self.matrix).all(axis=0))} is not finite"
            )
        if np.any(self.f_min > 0.0) or np.any(self.f_max < 0.0):
            raise DescriptionError(f"{self.name}: force limits must hold zero between them")

    @property
    def count(self) -> int:
        """Number of thrusters."""
        return int(self.matrix.shape[1])

    @property
    def lever_m(self) -> float:
        """Root mean square lever arm, m, by which torque is divided to compare with force; 1 if there is none."""
        size = float(np.sqrt(np.mean(np.sum(self.matrix[3:] ** 2, axis=0))))
        return size if size > 0.0 else 1.0

    @property
    def levers(self) -> np.ndarray:
        """(6,) divisors that make the force and torque of a wrench comparable: 1, and the lever arm."""
        return np.array([1.0, 1.0, 1.0, *[self.lever_m] * 3])

    @property
    def scaled(self) -> np.ndarray:
        """(6, n) matrix with torque over the lever arm, N."""
        return np.asarray(self.matrix / self.levers[:, None])

    @property
    def rank(self) -> int:
        """Number of wrench components that can be chosen freely."""
        values = np.linalg.svd(self.scaled, compute_uv=False)
        return int(np.sum(values > _RANK_TOLERANCE * max(float(values.max()), 1.0)))

    def spans(self, components: Sequence[int]) -> bool:
        """Whether every wrench along `components`, all others zero, is a combination of the thrusters."""
        scaled = self.scaled
        wanted = np.eye(6)[:, list(components)]
        residual = wanted - scaled @ (np.linalg.pinv(scaled, rcond=_RANK_TOLERANCE) @ wanted)
        return bool(np.abs(residual).max(initial=0.0) < 1e-6)

    def unreachable(self) -> tuple[str, ...]:
        """Names of the single degrees of freedom that cannot be pushed alone."""
        return tuple(name for axis, name in enumerate(AXES) if not self.spans([axis]))

    def with_passive_declared(self) -> Layout:
        """The layout with the passive components removed from every balance, because buoyancy holds them without a thruster."""
        matrix = self.matrix.copy()
        matrix[list(self.passive)] = 0.0
        return dataclasses.replace(self, matrix=matrix)

    def normalised(self, how: str) -> Layout:
        """The layout with the force limits of one of NORMALISATIONS.

        physical: its own, N. unit_thrust: -1 to 1 each. equal_total_thrust: -1 to 1 times 8 / n, so that all robots
        have the same total thrust.
        """
        if how == "physical":
            return self
        if how not in NORMALISATIONS:
            raise DescriptionError(f"normalisation {how!r} is unknown; permitted: {', '.join(NORMALISATIONS)}")
        limit = np.full(self.count, 1.0 if how == "unit_thrust" else REFERENCE_THRUSTERS / self.count)
        return dataclasses.replace(self, f_min=-limit, f_max=limit)


def of_vehicle(vehicle: Vehicle) -> Layout:
    """The layout of one vehicle on its own."""
    return of_modules([(0, 0, 0)], [0], [vehicle], name=vehicle.name)


def of_modules(
    cells: Sequence[Sequence[int]],
    rotation: Sequence[int],
    vehicles: Sequence[Vehicle],
    pitch_m: float = PITCH_M,
    name: str = "",
) -> Layout:
    """The layout of docked modules, placed as in prepare.assembly.assemble.

    Raises:
        DescriptionError: placements that cannot be docked.
    """
    placements = place(cells, rotation, vehicles)
    check_joints(placements, range(1, len(placements) + 1), pitch_m)
    passive = tuple(AXES.index(a) for a in vehicles[0].passive_dof) if len(vehicles) == 1 else ()
    assumption = "; ".join(dict.fromkeys(v.assumption for v in vehicles if v.assumption))
    thrusters = thruster_set(placements, Balance.of(placements, pitch_m).r_bm)
    return of_thrusters(name or f"{len(vehicles)} x {vehicles[0].name}", thrusters, passive, assumption)


def of_thrusters(name: str, thrusters: ThrusterSet, passive: tuple[int, ...] = (), assumption: str = "") -> Layout:
    """The layout of an assembled body's thrusters."""
    return Layout(
        name,
        np.array(thrusters.matrix),
        np.array(thrusters.f_min),
        np.array(thrusters.f_max),
        np.array(thrusters.power_forward),
        np.array(thrusters.power_reverse),
        passive,
        assumption,
    )


def of_rows(name: str, rows: np.ndarray, f_min: float, f_max: float, curve_of: Vehicle | None = None) -> Layout:
    """The layout of raw rows (n, 6): position about the centre of mass (m), direction of positive force.

    Args:
        rows: (n, 6) as above.
        f_min, f_max: N, the same for all thrusters.
        curve_of: vehicle whose power curve the thrusters have.
    """
    table = np.asarray(rows, dtype=float).reshape(-1, 6)
    lengths = np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    if np.any(lengths == 0.0):
        raise DescriptionError(f"{name}: thruster {_first(lengths[:, 0] == 0.0)} has no direction")
    direction = table[:, 3:] / lengths
    matrix = np.hstack([direction, np.cross(table[:, :3], direction)]).T
    n = len(table)
    forward = np.tile(curve_of.curve.power_forward, (n, 1)) if curve_of else np.zeros((n, 0))
    reverse = np.tile(curve_of.curve.power_reverse, (n, 1)) if curve_of else np.zeros((n, 0))
    return Layout(name, matrix, np.full(n, f_min), np.full(n, f_max), forward, reverse, ())


def _first(bad: np.ndarray) -> int:
    return int(np.argmax(bad))
