"""Assembles docked modules into one Body: masses, thrusters, tags and drag about the common centre of mass.

Runs before the body is needed (at start, or when docking is requested); the tick only swaps the result in.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.core import rotations
from firmware_py.core.body import ARM_SIGMA_M, BUOYANCY_SIGMA_N, TRIM_SIGMA_M, Body, ThrusterSet, can_make, deceleration_of
from firmware_py.description.fleet import Fleet, module_number
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import AXES, MOST_THRUSTERS, Vehicle, too_many_thrusters
from firmware_py.description.water import GRAVITY
from firmware_py.prepare import drag_table
from firmware_py.prepare.drag_cache import DragCache
from firmware_py.prepare.joints import Placement, check_joints
from firmware_py.prepare.lattice import MATRICES, QUATERNIONS

MOST_MODULES = 64
PITCH_M = 0.21
"""Lattice pitch of the paper's module (its docking condition 2)."""


def assemble(
    cells: Sequence[Sequence[int]] | np.ndarray,
    rotation: Sequence[int],
    vehicles: Sequence[Vehicle],
    modules: Sequence[int] | None = None,
    pitch_m: float = PITCH_M,
    cache: DragCache | None = None,
) -> Body:
    """One rigid body made of docked modules.

    The body frame has the axes of the lattice and its origin at the common centre of mass, including entrained water.

    Args:
        cells: (m, 3) lattice cells, integers.
        rotation: (m,) index into prepare.lattice.MATRICES of each module's rotation to the lattice.
        vehicles: (m,) description of each module.
        modules: (m,) fleet indices; 0, 1, ... when left out.
        pitch_m: lattice pitch.
        cache: cache of drag outlines.

    Raises:
        DescriptionError: too many modules, two in one cell, a probe that meets no drogue, or a module without a joint to the
            rest; the message numbers modules as all texts do.
    """
    count = len(vehicles)
    modules = tuple(range(count)) if modules is None else tuple(int(m) for m in modules)
    if not 1 <= count <= MOST_MODULES or not len(cells) == len(rotation) == len(modules) == count:
        raise DescriptionError(f"a body has 1 to {MOST_MODULES} modules with cell, rotation and vehicle, not {count}")
    placements = place(cells, rotation, vehicles)
    check_joints(placements, [module_number(module) for module in modules], pitch_m)
    return _body(placements, modules, pitch_m, cache)


def assemble_vehicle(vehicle: Vehicle) -> Body:
    """The body of a single module."""
    return assemble([(0, 0, 0)], [0], [vehicle])


def assemble_fleet(fleet: Fleet, vehicles: Mapping[str, Vehicle]) -> list[Body]:
    """The initial bodies of the fleet, in the order of their leaders; `vehicles` by the name in the fleet file."""
    check_fleet(fleet, vehicles)
    return [assemble(*described(fleet, members, vehicles), members, fleet.pitch_m) for members in groups_of(fleet)]


def check_fleet(fleet: Fleet, vehicles: Mapping[str, Vehicle]) -> None:
    """Refuses modules that cannot be docked as described, and more thrusters than a module's frames carry.

    Raises DescriptionError, which names module numbers.
    """
    for name, vehicle in vehicles.items():
        if len(vehicle.thruster) > MOST_THRUSTERS:
            raise DescriptionError(f"vehicle {name}: {len(vehicle.thruster)} thrusters; {too_many_thrusters()}")
    for members in groups_of(fleet):
        check_joints(place(*described(fleet, members, vehicles)), [fleet.label(i) for i in members], fleet.pitch_m)


def groups_of(fleet: Fleet) -> list[list[int]]:
    """Fleet indices of the modules of each body."""
    groups: dict[object, list[int]] = {}
    for index, module in enumerate(fleet.module):
        groups.setdefault(module.body if module.body >= 0 else (index,), []).append(index)
    return list(groups.values())


def described(
    fleet: Fleet, members: Sequence[int], vehicles: Mapping[str, Vehicle]
) -> tuple[np.ndarray, list[int], list[Vehicle]]:
    """Cells, rotations and vehicles of a body's modules."""
    chosen = [fleet.module[i] for i in members]
    cells = np.rint([m.cell for m in chosen]).astype(int)
    return cells, [m.rotation for m in chosen], [vehicles[m.vehicle] for m in chosen]


def place(
    cells: Sequence[Sequence[int]] | np.ndarray, rotation: Sequence[int], vehicles: Sequence[Vehicle]
) -> list[Placement]:
    """Placement of each module; arguments as in `assemble`."""
    turned = zip(vehicles, cells, rotation, strict=True)
    return [Placement(v, (int(c[0]), int(c[1]), int(c[2])), int(r)) for v, c, r in turned]


def _name(placements: Sequence[Placement]) -> str:
    counts = Counter(placement.vehicle.name for placement in placements)
    return " + ".join(n if c == 1 else f"{c} x {n}" for n, c in counts.items())


def _body(placements: Sequence[Placement], modules: tuple[int, ...], pitch_m: float, cache: DragCache | None) -> Body:
    balance = Balance.of(placements, pitch_m)
    r_bm = balance.r_bm
    q_bm = np.array([QUATERNIONS[p.rotation] for p in placements])
    mass = _mass_matrix(balance, placements)
    tags = [(k, tag) for k, p in enumerate(placements) for tag in p.vehicle.tag]
    thrusters = thruster_set(placements, r_bm)
    passive = _passive(placements, thrusters.matrix)
    return Body(
        name=_name(placements),
        modules=modules,
        cells=np.array([p.cell for p in placements], dtype=np.int64),
        faces=tuple(p.vehicle.faces for p in placements),
        r_bm=r_bm,
        q_bm=q_bm,
        r_bi=r_bm.copy(),
        mass=mass,
        mass_inv=np.ascontiguousarray(np.linalg.inv(mass)),
        rigid_mass_kg=balance.mass_kg,
        righting=sum((_righting(p) for p in placements), np.zeros(3)),
        righting_sigma=_righting_sigma(placements, r_bm),
        thrusters=thrusters,
        drag=drag_table.build(placements, balance.centre, pitch_m, cache),
        tag_ids=np.array([tag.id for _, tag in tags], dtype=np.int64),
        tag_module=np.array([k for k, _ in tags], dtype=np.int64),
        r_bt=np.array([r_bm[k] + MATRICES[placements[k].rotation] @ tag.position_m for k, tag in tags]).reshape(-1, 3),
        q_bt=np.array([_turned(q_bm[k], tag.quaternion) for k, tag in tags]).reshape(-1, 4),
        supply_power_w=np.array([_power(p.vehicle) for p in placements]),
        hull_m=np.array([np.abs(MATRICES[p.rotation] @ p.vehicle.hull.size_m) for p in placements]),
        reach_m=max(_reach_m(p.vehicle, r) for p, r in zip(placements, r_bm, strict=True)),
        deceleration=deceleration_of(thrusters, mass, passive, np.ones(thrusters.f_max.size, dtype=np.bool_)),
        passive=passive,
        depth_rating_m=min(p.vehicle.depth_rating_m for p in placements),
    )


def passive_axes(fleet: Fleet, members: Sequence[int], vehicles: Mapping[str, Vehicle]) -> tuple[int, ...]:
    """`Body.passive` of the body of these modules, without the rest of its arrays."""
    placements = place(*described(fleet, members, vehicles))
    return _passive(placements, thruster_set(placements, Balance.of(placements, fleet.pitch_m).r_bm).matrix)


def _passive(placements: Sequence[Placement], matrix: np.ndarray) -> tuple[int, ...]:
    """Axes of the body that are left to buoyancy: those that its only module declares; for several modules, those that any of them
    declares and that the thrusters of all together cannot make.
    """
    declared = sorted({_turned_axis(p.rotation, AXES.index(name)) for p in placements for name in p.vehicle.passive_dof})
    return tuple(axis for axis in declared if len(placements) == 1 or not can_make(matrix, axis))


def _turned_axis(rotation: int, axis: int) -> int:
    """The axis of the body, 0 to 5, along or about which that axis of a module lies."""
    return axis - axis % 3 + int(np.argmax(np.abs(MATRICES[rotation][:, axis % 3])))


def _turned(q_bm: np.ndarray, q_mt: np.ndarray) -> np.ndarray:
    return np.asarray(rotations.normalise(rotations.multiply(q_bm.copy(), q_mt.copy())))


def _power(vehicle: Vehicle) -> float:
    return vehicle.supply.voltage_v * vehicle.supply.current_a - vehicle.supply.idle_w


def _reach_m(vehicle: Vehicle, r_bm: np.ndarray) -> float:
    """Upper bound of the distance from the centre of mass to the corners of the hull's box, m."""
    return float(np.linalg.norm(r_bm) + 0.5 * np.linalg.norm(vehicle.hull.size_m))


def _righting(placement: Placement) -> np.ndarray:
    """(3,) weight, with entrained water, times the arm from the centre of mass up (-z of the module) to that of buoyancy, N m."""
    inertial = placement.vehicle.inertial
    moment = GRAVITY * inertial.wet_kg * inertial.righting_arm_m
    return np.asarray(MATRICES[placement.rotation] @ np.array([0.0, 0.0, -moment]))


def _righting_sigma(placements: Sequence[Placement], r_bm: np.ndarray) -> np.ndarray:
    """(3,) uncertainty of the sum over modules of buoyancy times its position, N m; the errors of the modules are independent."""
    parts = [BUOYANCY_SIGMA_N * r_bm]
    for placement in placements:
        inertial = placement.vehicle.inertial
        trim, arm = GRAVITY * inertial.dry_kg * TRIM_SIGMA_M, GRAVITY * inertial.wet_kg * ARM_SIGMA_M
        parts.append((MATRICES[placement.rotation] @ np.array([trim, trim, arm]))[None])
    return np.asarray(np.linalg.norm(np.concatenate(parts), axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class _Lump:
    """A rigid part with the water that it entrains: mass, centre (3,) in the lattice frame, inertia (3, 3) about the centre."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Balance:
    """Mass and centre of mass of docked modules, including entrained water.

    Attributes:
        lumps: rigid parts of the modules; mass_kg: their total mass.
        centre: (3,) common centre of mass in the lattice frame, m.
        r_bm: (m, 3) module origins relative to the centre of mass, m.
    """

    lumps: list[_Lump]
    mass_kg: float
    centre: np.ndarray
    r_bm: np.ndarray

    @staticmethod
    def of(placements: Sequence[Placement], pitch_m: float) -> Balance:
        """The balance of these modules, each at its cell of a lattice of this pitch."""
        origins = pitch_m * np.array([p.cell for p in placements], dtype=float)
        lumps = [lump for p, origin in zip(placements, origins, strict=True) for lump in _lumps(p, origin)]
        mass_kg = sum(lump.mass for lump in lumps)
        centre = np.sum([lump.mass * lump.centre for lump in lumps], axis=0) / mass_kg
        return Balance(lumps, float(mass_kg), centre, origins - centre)


def _lumps(placement: Placement, origin: np.ndarray) -> list[_Lump]:
    inertial, turn = placement.vehicle.inertial, MATRICES[placement.rotation]
    lumps = [_Lump(inertial.wet_kg, origin + turn @ inertial.com_m, turn @ inertial.inertia @ turn.T)]
    for payload in placement.vehicle.payload:
        mass, squares = payload.dry_kg + payload.entrained_kg, payload.size_m**2
        inertia = mass / 12.0 * np.diag(squares.sum() - squares)
        lumps.append(_Lump(mass, origin + turn @ payload.position_m, turn @ inertia @ turn.T))
    return lumps


def _mass_matrix(balance: Balance, placements: Sequence[Placement]) -> np.ndarray:
    """(6, 6) rigid, entrained and added mass about the body's centre of mass, body axes.

    Each part contributes H^T M_i H, where H = [I, -S(r); 0, I] takes the body's velocity to a point r of the module
    (Fossen's system transformation): the centre of mass of a rigid lump, the hull's centre for added mass.
    """
    parts = []
    for lump in balance.lumps:
        parts.append((_blocks(lump.mass * np.eye(3), lump.inertia), lump.centre - balance.centre))
    for placement, origin in zip(placements, balance.r_bm, strict=True):
        turn, added = MATRICES[placement.rotation], placement.vehicle.inertial.added
        parts.append((_blocks(turn @ np.diag(added[:3]) @ turn.T, turn @ np.diag(added[3:]) @ turn.T), origin))
    total = np.zeros((6, 6))
    for part, r in parts:
        h = _blocks(np.eye(3), np.eye(3))
        h[:3, 3:] = -rotations.skew(r)
        total += h.T @ part @ h
    return 0.5 * (total + total.T)


def _blocks(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    matrix = np.zeros((6, 6))
    matrix[:3, :3], matrix[3:, 3:] = upper, lower
    return matrix


def thruster_set(placements: Sequence[Placement], r_bm: np.ndarray) -> ThrusterSet:
    """All thrusters in module order; columns [direction; position x direction] about the centre of mass.

    This is the paper's Jacobian with its two terms corrected.
    """
    columns = []
    vehicles = [p.vehicle for p in placements]
    for vehicle, placement, origin in zip(vehicles, placements, r_bm, strict=True):
        turn = MATRICES[placement.rotation]
        direction = vehicle.directions @ turn.T
        position = vehicle.positions @ turn.T + origin
        columns.append(np.hstack([direction, np.cross(position, direction)]))
    matrix = np.ascontiguousarray(np.vstack(columns).T)
    counts = [len(v.thruster) for v in vehicles]

    def each(values: Sequence[object]) -> np.ndarray:
        return np.repeat(np.array(values), counts, axis=0)

    curves = [v.curve for v in vehicles]
    return ThrusterSet(
        matrix=matrix,
        pinv=np.ascontiguousarray(np.linalg.pinv(matrix)),
        f_min=each([v.force_min_n for v in vehicles]),
        f_max=each([v.force_max_n for v in vehicles]),
        forward=each([c.forward for c in curves]),
        reverse=each([c.reverse for c in curves]),
        power_forward=each([c.power_forward for c in curves]),
        power_reverse=each([c.power_reverse for c in curves]),
        deadband_n=each([c.deadband_n for c in curves]),
        lag_s=each([c.lag_s for c in curves]),
        voltage_v=each([c.voltage_v for c in curves]),
        rpm_at_full=each([c.rpm_at_full for c in curves]),
        module=each(list(range(len(vehicles)))),
        channel=np.concatenate([np.arange(c) for c in counts]),
    )
