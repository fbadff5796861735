"""Docked modules to one Body: masses, thrusters, tags and drag about the common centre of mass.

Runs before a body is needed (start, or when docking is requested); the tick only swaps the result in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from firmware_py.core import rotations
from firmware_py.core.body import Body, ThrusterSet
from firmware_py.description.fleet import Fleet
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import FACE_NAMES, Vehicle
from firmware_py.prepare import drag_table
from firmware_py.prepare.drag_cache import DragCache
from firmware_py.prepare.drag_table import Placement
from firmware_py.prepare.lattice import MATRICES, QUATERNIONS, face_towards

GRAVITY = 9.80665
"""m/s^2, standard."""

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
    name: str = "",
) -> Body:
    """One rigid body out of docked modules.

    The body frame has the axes of the lattice and its origin at the common centre of mass, entrained water included.

    Args:
        cells: (m, 3) lattice cells, whole numbers.
        rotation: (m,) which of prepare.lattice.MATRICES turns each module into the lattice.
        vehicles: (m,) description of each module.
        modules: (m,) fleet indices; 0, 1, ... when left out.
        pitch_m: lattice pitch.
        cache: kept drag outlines.
        name: for people; made of the vehicle names when left out.

    Raises:
        DescriptionError: too many modules, two in one cell, a probe that meets no drogue, or no joint that leads to a
            module; the modules are named by their fleet index.
    """
    count = len(vehicles)
    modules = tuple(range(count)) if modules is None else tuple(int(m) for m in modules)
    if not 1 <= count <= MOST_MODULES or not len(cells) == len(rotation) == len(modules) == count:
        raise DescriptionError(f"a body has 1 to {MOST_MODULES} modules, each with cell, rotation and vehicle; got {count}")
    turned = zip(vehicles, cells, rotation, strict=True)
    placements = [Placement(v, (int(c[0]), int(c[1]), int(c[2])), int(r)) for v, c, r in turned]
    check_joints(placements, modules)
    return _body(placements, modules, pitch_m, cache, name or _name(placements))


def assemble_vehicle(vehicle: Vehicle, module_index: int = 0, cache: DragCache | None = None) -> Body:
    """The body that one module is on its own."""
    return assemble([(0, 0, 0)], [0], [vehicle], [module_index], cache=cache, name=vehicle.name)


def assemble_fleet(fleet: Fleet, vehicles: Mapping[str, Vehicle], cache: DragCache | None = None) -> list[Body]:
    """The bodies that the fleet starts as, in the order of their leaders; `vehicles` by the name in the fleet file."""
    groups: dict[object, list[int]] = {}
    for index, module in enumerate(fleet.module):
        groups.setdefault(module.body if module.body >= 0 else (index,), []).append(index)
    bodies = []
    for members in groups.values():
        chosen = [fleet.module[i] for i in members]
        cells = np.rint([m.cell for m in chosen]).astype(int)
        descriptions = [vehicles[m.vehicle] for m in chosen]
        bodies.append(assemble(cells, [m.rotation for m in chosen], descriptions, members, fleet.pitch_m, cache))
    return bodies


def check_joints(placements: Sequence[Placement], modules: Sequence[int]) -> None:
    """Refuse placements that cannot be docked; see `assemble`."""
    at: dict[tuple[int, int, int], int] = {}
    for i, placement in enumerate(placements):
        if placement.cell in at:
            other = modules[at[placement.cell]]
            raise DescriptionError(f"modules {other} and {modules[i]} overlap in cell {placement.cell}")
        if not 0 <= placement.rotation < 24:
            raise DescriptionError(f"module {modules[i]}: rotation {placement.rotation} is none of 0 to 23")
        at[placement.cell] = i
    joints: dict[int, list[int]] = {i: [] for i in range(len(placements))}
    for i, placement in enumerate(placements):
        for axis in range(3):
            j = at.get(_neighbour(placement.cell, axis))
            if j is not None and _joined(placements, modules, i, j, axis):
                joints[i].append(j)
                joints[j].append(i)
    reached, open_ends = {0}, [0]
    while open_ends:
        for j in joints[open_ends.pop()]:
            if j not in reached:
                reached.add(j)
                open_ends.append(j)
    if lost := [str(modules[i]) for i in range(len(placements)) if i not in reached]:
        raise DescriptionError(f"no docked face joins module {', '.join(lost)} to module {modules[0]}")


def _neighbour(cell: tuple[int, int, int], axis: int) -> tuple[int, int, int]:
    x, y, z = (c + (k == axis) for k, c in enumerate(cell))
    return x, y, z


def _joined(placements: Sequence[Placement], modules: Sequence[int], i: int, j: int, axis: int) -> bool:
    """Whether the faces between neighbours i and j (i below j along `axis`) dock. A probe needs a drogue before it."""
    unit = [0, 0, 0]
    unit[axis] = 1
    upper = face_towards(placements[i].rotation, (unit[0], unit[1], unit[2]))
    lower = face_towards(placements[j].rotation, (-unit[0], -unit[1], -unit[2]))
    kinds = placements[i].vehicle.faces[upper] + placements[j].vehicle.faces[lower]
    if kinds in ("PP", "P-", "-P"):
        what = "probe" if kinds == "PP" else "a face without drogue"
        first, second = ((i, upper), (j, lower)) if kinds[0] == "P" else ((j, lower), (i, upper))
        raise DescriptionError(
            f"module {modules[first[0]]}'s probe on face {FACE_NAMES[first[1]]} meets {what} on face "
            f"{FACE_NAMES[second[1]]} of module {modules[second[0]]}"
        )
    return set(kinds) == {"P", "D"}


def _name(placements: Sequence[Placement]) -> str:
    counts: dict[str, int] = {}
    for placement in placements:
        counts[placement.vehicle.name] = counts.get(placement.vehicle.name, 0) + 1
    return " + ".join(n if c == 1 else f"{c} x {n}" for n, c in counts.items())


def _body(
    placements: Sequence[Placement], modules: tuple[int, ...], pitch_m: float, cache: DragCache | None, name: str
) -> Body:
    turns = np.array([MATRICES[p.rotation] for p in placements])
    origins = pitch_m * np.array([p.cell for p in placements], dtype=float)
    inertials = [p.vehicle.inertial for p in placements]
    masses = np.array([i.dry_kg + i.entrained_kg for i in inertials])
    centres = origins + np.einsum("mij,mj->mi", turns, np.array([i.com_m for i in inertials]))
    com = masses @ centres / masses.sum()
    r_bm = origins - com
    q_bm = np.array([QUATERNIONS[p.rotation] for p in placements])
    mass = mass_matrix(placements, r_bm)
    tags = [(k, tag) for k, p in enumerate(placements) for tag in p.vehicle.tag]
    return Body(
        name=name,
        modules=modules,
        cells=np.array([p.cell for p in placements], dtype=np.int64),
        r_bm=r_bm,
        q_bm=q_bm,
        r_bi=r_bm.copy(),
        mass=mass,
        mass_inv=np.ascontiguousarray(np.linalg.inv(mass)),
        rigid_mass_kg=float(masses.sum()),
        dry_kg=float(sum(i.dry_kg for i in inertials)),
        righting=sum((_righting(p) for p in placements), np.zeros(3)),
        thrusters=thruster_set([p.vehicle for p in placements], turns, r_bm),
        drag=drag_table.build(placements, com, pitch_m, cache),
        tag_ids=np.array([tag.id for _, tag in tags], dtype=np.int64),
        tag_module=np.array([k for k, _ in tags], dtype=np.int64),
        r_bt=np.array([r_bm[k] + turns[k] @ tag.position_m for k, tag in tags]).reshape(-1, 3),
        q_bt=np.array([_turned(q_bm[k], tag.quaternion) for k, tag in tags]).reshape(-1, 4),
        supply_power_w=np.array([_power(p.vehicle) for p in placements]),
    )


def _turned(q_bm: np.ndarray, q_mt: np.ndarray) -> np.ndarray:
    return np.asarray(rotations.normalise(rotations.multiply(q_bm.copy(), q_mt.copy())))


def _power(vehicle: Vehicle) -> float:
    return vehicle.supply.voltage_v * vehicle.supply.current_a - vehicle.supply.idle_w


def _righting(placement: Placement) -> np.ndarray:
    """(3,) dry weight times the arm from centre of mass up (-z of the module) to that of buoyancy, lattice axes, N m."""
    inertial = placement.vehicle.inertial
    moment = GRAVITY * inertial.dry_kg * inertial.righting_arm_m
    return np.asarray(MATRICES[placement.rotation] @ np.array([0.0, 0.0, -moment]))


def mass_matrix(placements: Sequence[Placement], r_bm: np.ndarray) -> np.ndarray:
    """(6, 6) rigid, entrained and added mass about the body's centre of mass, body axes.

    Each module contributes H^T M_i H, where H = [I, -S(r); 0, I] takes the body's velocity to a point r of the module
    (Fossen's system transformation): its centre of mass for the rigid part, its hull's centre for added mass.
    """
    total = np.zeros((6, 6))
    for placement, origin in zip(placements, r_bm, strict=True):
        inertial, turn = placement.vehicle.inertial, MATRICES[placement.rotation]
        rigid = np.zeros((6, 6))
        rigid[:3, :3] = (inertial.dry_kg + inertial.entrained_kg) * np.eye(3)
        rigid[3:, 3:] = turn @ inertial.inertia @ turn.T
        added = np.zeros((6, 6))
        added[:3, :3] = turn @ np.diag(inertial.added[:3]) @ turn.T
        added[3:, 3:] = turn @ np.diag(inertial.added[3:]) @ turn.T
        for part, r in ((rigid, origin + turn @ inertial.com_m), (added, origin)):
            h = np.eye(6)
            h[:3, 3:] = -rotations.skew(r)
            total += h.T @ part @ h
    return 0.5 * (total + total.T)


def thruster_set(vehicles: Sequence[Vehicle], turns: np.ndarray, r_bm: np.ndarray) -> ThrusterSet:
    """All thrusters in module order; columns [direction; position x direction] about the centre of mass.

    The paper's Jacobian with its two words put right.
    """
    columns = []
    for vehicle, turn, origin in zip(vehicles, turns, r_bm, strict=True):
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
