"""Builds the arrays of the world from vehicle files, random draws and the seats of the modules in their bodies.

Runs at the start and whenever bodies merge or split, not in the tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.vehicle import Vehicle
from hil.plant import shelter
from hil.plant.bodies import Bodies, Modules
from hil.plant.draw import ModuleDraw, mass_about_body_origin
from hil.plant.lattice import Place
from hil.plant.spec import WorldSpec
from hil.plant.thrusters import Thrusters

ALONE = -1
"""Value in `Modules.shelter` for the only module of a body."""


def make_thrusters(
    vehicles: Sequence[Vehicle], draws: Sequence[ModuleDraw], spec: WorldSpec, step_ns: int
) -> Thrusters:
    """Returns all thrusters at rest; `seat_thrusters` then places them in their bodies."""
    module = np.array([m for m, v in enumerate(vehicles) for _ in v.thruster], dtype=np.int64)
    curves = [vehicles[m].curve for m in module]
    constants = np.column_stack([
        np.concatenate([d.gain for d in draws]),
        np.concatenate([d.deadband_n for d in draws]),
        np.array([c.rpm_at_full for c in curves]),
    ])  # fmt: skip
    supply = np.array([
        [v.curve.voltage_v, v.supply.voltage_v, spec.supply_resistance_ohm,
         v.supply.current_a if spec.supply_limit else math.inf, v.supply.idle_w]
        for v in vehicles
    ])  # fmt: skip
    lag = spec.thruster_lag_s
    decay = np.exp(-0.5e-9 * step_ns / lag * np.arange(3)) if lag > 0.0 else np.zeros(3)
    return Thrusters(
        module,
        module.copy(),
        np.zeros((len(module), 6)),
        np.zeros((len(module), 3)),
        np.array([[c.forward, c.reverse] for c in curves]),
        np.array([[c.power_forward, c.power_reverse] for c in curves]),
        constants,
        np.tile(decay, (len(module), 1)),
        np.zeros((len(module), 2)),
        np.zeros(len(module)),
        supply,
        np.zeros((len(vehicles), 2)),
    )


def seat_thrusters(thrusters: Thrusters, vehicles: Sequence[Vehicle], modules: Modules) -> None:
    """Writes body, column and position of every thruster from the seats of the modules."""
    first = 0
    for m, vehicle in enumerate(vehicles):
        turn, last = modules.turn[m], first + len(vehicle.thruster)
        directions = vehicle.directions @ turn.T
        positions = vehicle.positions @ turn.T + modules.position[m]
        thrusters.body[first:last] = modules.body[m]
        thrusters.position[first:last] = positions
        thrusters.column[first:last] = np.hstack([directions, np.cross(positions, directions)])
        first = last


def make_modules(
    vehicles: Sequence[Vehicle],
    draws: Sequence[ModuleDraw],
    groups: Sequence[Sequence[int]],
    places: Sequence[Place],
) -> Modules:
    """Returns all modules, seated in their bodies.

    Args:
        groups: modules of each body. places: seat of each module in its body.
    """
    coefficients = [d.drag * (0.0 if len(v.drag.quadratic) else 1.0) for v, d in zip(vehicles, draws, strict=True)]
    body = np.zeros(len(vehicles), dtype=np.int64)
    for b, members in enumerate(groups):
        body[list(members)] = b
    sizes = np.array([v.hull.size_m for v in vehicles])
    quaternions = np.array([p.quaternion for p in places], dtype=np.float64)
    positions = np.array([p.position for p in places], dtype=np.float64)
    row, sides, maps = _shelter(groups, positions, quaternions, sizes)
    return Modules(
        body,
        positions,
        np.array([rotations.to_matrix(q) for q in quaternions]),
        quaternions,
        sizes,
        np.array(coefficients),
        np.array([d.linear for d in draws]),
        np.array([d.quadratic for d in draws]),
        row,
        sides,
        maps,
    )


def _shelter(
    groups: Sequence[Sequence[int]], positions: np.ndarray, quaternions: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row of each module in the maps, its (m, 3) open sides, and the maps of all bodies of more than one module."""
    row, sides = np.full(len(positions), ALONE, dtype=np.int64), np.ones((len(positions), 3))
    maps: list[np.ndarray] = []
    for members in groups:
        if len(members) > 1:
            chosen = list(members)
            found = shelter.shelter_maps(positions[chosen], quaternions[chosen], sizes[chosen])
            row[chosen] = np.arange(len(chosen)) + int(sum(len(m) for m in maps))
            sides[chosen] = shelter.side_shares(found)
            maps.append(found)
    return row, sides, _stack(maps)


def _stack(maps: Sequence[np.ndarray]) -> np.ndarray:
    """Stacks all maps into one array, refined to the finest grid among them."""
    if not maps:
        return shelter.no_maps()
    nodes = max(m.shape[2] for m in maps)
    return np.concatenate([m if m.shape[2] == nodes else shelter.refined(m, nodes) for m in maps])


def make_bodies(count: int) -> Bodies:
    """Returns bodies at the origin, at rest and without mass; `fill_body` adds the mass."""
    return Bodies(
        np.zeros((count, 13)),
        np.zeros((count, 6, 6)),
        np.zeros((count, 6, 6)),
        np.zeros((count, 6, 6)),
        np.zeros((count, 8)),
        np.zeros((count, 4)),
        np.zeros((count, 6)),
        np.zeros(count, dtype=np.int64),
    )


def fill_body(
    bodies: Bodies, b: int, parts: Sequence[tuple[ModuleDraw, np.ndarray, np.ndarray]], spec: WorldSpec
) -> None:
    """Sums the mass properties of the modules of body b.

    parts: (draw, position of the hull centre, module to body rotation) of each.
    """
    for array in bodies[1:6]:  # all but state, working memory and clamp
        array[b] = 0.0
    for draw, r, turn in parts:
        bodies.rigid[b] += mass_about_body_origin(draw.rigid, r, turn)
        bodies.added[b] += mass_about_body_origin(np.diag(draw.added), r, turn)
        weight = draw.mass * spec.gravity
        bodies.weight[b, 0] += weight
        bodies.weight[b, 1] += draw.buoyancy_n
        bodies.weight[b, 2:5] += weight * (r + turn @ draw.com)
        bodies.weight[b, 5:8] += draw.buoyancy_n * (r + turn @ draw.buoyancy_at)
        # Neutral except for the buoyancy error: hull and flooded volume displace the weight of robot and entrained water.
        displaced = draw.buoyancy_n / spec.gravity
        bodies.hull[b, 0] += displaced
        bodies.hull[b, 1:4] += displaced * (r + turn @ draw.buoyancy_at)
        for load in draw.payload:  # trimmed: its weight equals its buoyancy, at the same point
            bodies.hull[b, 0] += load.dry_kg + load.entrained_kg
            bodies.hull[b, 1:4] += (load.dry_kg + load.entrained_kg) * (r + turn @ load.position_m)
    bodies.inverse[b] = np.linalg.inv(bodies.rigid[b] + bodies.added[b])


def nominal_centre(vehicles: Sequence[Vehicle], places: Sequence[Place]) -> np.ndarray:
    """(3,) centre of mass according to the vehicle files, with entrained water and payloads, body frame."""
    mass, moment = 0.0, np.zeros(3)
    for vehicle, seat in zip(vehicles, places, strict=True):
        turn = rotations.to_matrix(seat.quaternion)
        lumps = [(vehicle.inertial.wet_kg, vehicle.inertial.com_m)]
        lumps += [(p.dry_kg + p.entrained_kg, p.position_m) for p in vehicle.payload]
        for kg, at in lumps:
            mass += kg
            moment += kg * (seat.position + turn @ at)
    return moment / mass
