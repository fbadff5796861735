"""Frozen arrays of one docked shape: what estimator, controller and allocator need to know of a body.

Built by `prepare.assembly` from vehicle files; a merge or split swaps one Body for another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

RANK_TOLERANCE = 1e-6
"""Singular values of a thruster matrix below this share of the largest count as zero."""
CRUISE_M_S = 0.2
"""Nominal speed of a robot under way, used to convert a change of the water's speed into a change of drag."""
BUOYANCY_SIGMA_N, ARM_SIGMA_M, TRIM_SIGMA_M = 0.5, 0.003, 0.002
"""Sigma of a module's buoyancy, of its righting arm (a moment when multiplied by the weight with entrained water) and of its trim along
each axis (multiplied by the dry weight); the errors show when the body tilts. Arm and trim: one sigma of the bench's draw of 5 and 3 mm
to either side."""
Plant = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Mass, its inverse, righting, drag nodes, rotational and linear damping; core.propagation.PLANT has their types."""


@dataclass(frozen=True, slots=True, eq=False)
class ThrusterSet:
    """The n thrusters of a body, in module order; eight per module where the vehicle has eight.

    Attributes:
        matrix: (6, n) wrench of unit forces: [direction; position x direction] about the centre of mass.
        pinv: (n, 6) Moore-Penrose inverse.
        f_min, f_max: (n,) N.
        forward, reverse: (n, 5) force polynomials; power_forward, power_reverse: (n, 5) power polynomials (W over |N|).
        deadband_n, lag_s, voltage_v, rpm_at_full: (n,).
        module: (n,) index, within the body, of each thruster's module; channel: (n,) its number within that module.
    """

    matrix: np.ndarray
    pinv: np.ndarray
    f_min: np.ndarray
    f_max: np.ndarray
    forward: np.ndarray
    reverse: np.ndarray
    power_forward: np.ndarray
    power_reverse: np.ndarray
    deadband_n: np.ndarray
    lag_s: np.ndarray
    voltage_v: np.ndarray
    rpm_at_full: np.ndarray
    module: np.ndarray
    channel: np.ndarray

    @property
    def full_wrench(self) -> np.ndarray:
        """(6,) largest wrench along each axis, whatever it makes along the others, mean of both directions."""
        return np.asarray(0.5 * np.abs(self.matrix) @ (self.f_max - self.f_min))


def rank_by(values: np.ndarray) -> int:
    """Rank of a matrix with these singular values, largest first."""
    return int(np.sum(values > RANK_TOLERANCE * values.max(initial=1e-12)))


def rank_of(matrix: np.ndarray) -> int:
    """Rank of a matrix that has no more than RANK_TOLERANCE of noise."""
    return rank_by(np.linalg.svd(matrix, compute_uv=False))


def can_make(matrix: np.ndarray, axis: int) -> bool:
    """Whether thrusters of this (6, n) matrix can make a wrench along one axis, 0 to 5, alone."""
    unit = np.eye(6)[axis]
    return bool(np.linalg.norm(matrix @ np.linalg.lstsq(matrix, unit, rcond=RANK_TOLERANCE)[0] - unit) < RANK_TOLERANCE)


def axes_without_thrust(matrix: np.ndarray, passive: Sequence[int]) -> tuple[int, ...]:
    """Axes, 0 to 5, that must be passive too before thrusters of this (6, n) matrix can make every wrench along the others.

    Of the axes that depend on each other it takes the one that thrusters can make least; moments count by the thrusters' mean lever arm.
    """
    lever = float(np.sqrt(np.mean(np.sum(matrix[3:] ** 2, axis=0))))
    scaled = matrix / np.repeat([1.0, lever if lever > 0.0 else 1.0], 3)[:, None]
    left, found = [axis for axis in range(6) if axis not in passive], []
    while left:
        directions, values, _ = np.linalg.svd(scaled[left])
        rank = rank_by(values)
        if rank == len(left):
            break
        found.append(left.pop(int(np.argmax(np.linalg.norm(directions[:, rank:], axis=1)))))
    return tuple(sorted(found))


def deceleration_of(thrusters: ThrusterSet, mass: np.ndarray, passive: Sequence[int], alive: np.ndarray) -> np.ndarray:
    """`Body.deceleration` (2,) of a body with this mass matrix (6, 6) and these passive axes, 0 to 5.

    `alive`: (n,) bool, thrusters that may turn. An axis counts by the largest wrench that makes nothing along the others and is shared out
    with the least forces: a thruster that is left out takes the force of its counterpart with it.
    """
    matrix = thrusters.matrix * alive
    idle = {*passive, *axes_without_thrust(matrix, passive)}
    pushed = [axis for axis in range(6) if axis not in idle]
    shares = np.abs(np.linalg.pinv(matrix[pushed], rcond=RANK_TOLERANCE))
    along = np.full(6, np.inf)
    along[pushed] = 1.0 / (np.max(shares / (0.5 * (thrusters.f_max - thrusters.f_min))[:, None], axis=0) * np.diag(mass)[pushed])
    return np.asarray(along.reshape(2, 3).min(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class DragTable:
    """Drag of a shape over flow direction, on the six sides of a cube (core.drag_lookup).

    Attributes:
        nodes: (6, n, n, 4) per node: force per squared speed 1/2 rho Cd A (N s^2/m^2), centre of pressure (3,) from
            the centre of mass, m.
        rotational: (3,) quadratic damping about the body axes, N m s^2.
        linear: (6,) linear damping, N s/m and N m s.
    """

    nodes: np.ndarray
    rotational: np.ndarray
    linear: np.ndarray

    @property
    def mean(self) -> float:
        """Force per squared speed, mean over all nodes, N s^2/m^2."""
        return float(self.nodes[..., 0].mean())

    @property
    def cruise_slope(self) -> float:
        """Change of drag per change of the water's speed for a robot under way, mean over all nodes, N s/m: dF/dv = 2 c v."""
        return 2.0 * CRUISE_M_S * self.mean


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One rigid body of m modules.

    Attributes:
        modules: fleet indices of its modules.
        r_bm: (m, 3) module origins from the centre of mass, body frame; q_bm: (m, 4) module frame to body frame.
        r_bi: (m, 3) IMUs from the centre of mass.
        mass: (6, 6) rigid, entrained and added mass about the centre of mass; mass_inv: its inverse.
        rigid_mass_kg: dry and entrained mass.
        righting: (3,) sum of weight, entrained water included, times (centre of buoyancy - centre of mass), body frame, N m.
        righting_sigma: (3,) its standard deviation, from arm, trim and buoyancy of each module.
        thrusters, drag: see ThrusterSet and DragTable.
        tag_ids: (t,) ids; tag_module: (t,) index within the body; r_bt: (t, 3); q_bt: (t, 4) tag frame to body frame.
        tag_module and r_bt follow the order of tag_ids.
        supply_power_w: (m,) power that each module's supply can give to its thrusters and magnets.
        hull_m: (m, 3) edges of each module's hull, a box, along the axes of the body, m.
        reach_m: largest distance of any point of its hulls from the centre of mass, m.
        deceleration: (2,) with which all its thrusters stop its motion and its turn along the axis where that takes longest, m/s^2 and
            rad/s^2, see deceleration_of; passive axes, and those without thrust, left out.
        depth_rating_m: largest depth that all its vehicles are made for, m.
        cells: (m, 3) lattice cells; name: for display.
        faces: per module the kinds of its six faces, a letter each, as in the vehicle file (P probe, D drogue).
        passive: wrench components, 0 to 5, that are left to buoyancy: no thruster is asked for them.
    """

    name: str
    modules: tuple[int, ...]
    cells: np.ndarray
    faces: tuple[str, ...]
    r_bm: np.ndarray
    q_bm: np.ndarray
    r_bi: np.ndarray
    mass: np.ndarray
    mass_inv: np.ndarray
    rigid_mass_kg: float
    righting: np.ndarray
    righting_sigma: np.ndarray
    thrusters: ThrusterSet
    drag: DragTable
    tag_ids: np.ndarray
    tag_module: np.ndarray
    r_bt: np.ndarray
    q_bt: np.ndarray
    supply_power_w: np.ndarray
    hull_m: np.ndarray
    reach_m: float
    deceleration: np.ndarray
    passive: tuple[int, ...]
    depth_rating_m: float

    @property
    def index(self) -> int:
        """Number of the body: the fleet index of its leader, which is its first module."""
        return self.modules[0]

    @property
    def nominal_v(self) -> np.ndarray:
        """(m,) supply voltage of each module at which its thrusters' curves hold."""
        t = self.thrusters
        return np.array([t.voltage_v[t.module == m][0] for m in range(len(self.modules))])

    @property
    def steered_matrix(self) -> np.ndarray:
        """(6, n) thruster matrix with zeros for passive axes that the thrusters could make alone. One that they cannot make alone keeps
        its row, because it follows from the other axes.
        """
        matrix = self.thrusters.matrix.copy()
        matrix[[axis for axis in self.passive if can_make(matrix, axis)]] = 0.0
        return matrix

    @property
    def plant(self) -> Plant:
        """Arrays of the body that the process model uses."""
        return self.mass, self.mass_inv, self.righting, self.drag.nodes, self.drag.rotational, self.drag.linear
