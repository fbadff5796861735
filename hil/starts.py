"""Initial poses of the modules of a scenario, and checks that they are inside the tank and do not overlap."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.plant.build import nominal_centre
from hil.plant.lattice import Place, place
from hil.plant.spec import Tank
from hil.plant.world import Start

if TYPE_CHECKING:
    from hil.scenario import Scenario

PITCH_M = 0.21
"""Lattice pitch of modules without docking faces (the paper's)."""
CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
"""(8, 3) corners of a box, as shares of its edges."""
MOVE_IN = "move it in"
TOUCHING_M = 1e-9
"""Tolerance for a hull that touches a wall, against rounding."""


def pitch_of(scenario: Scenario) -> float:
    """Lattice pitch, m: docked hulls touch, so it is the edge of the modules' hulls along the axes of their docking faces."""
    return next(iter(docking_edges_of(scenario)), PITCH_M)


def docking_edges_of(scenario: Scenario) -> set[float]:
    """Edges of all modules' hulls, m, along the axes of their docking faces: one alone where every face meets every other."""
    return set[float]().union(*(load_vehicle(name).docking_edges_m for name in {m.vehicle for m in scenario.module}))


def places_of(scenario: Scenario) -> list[Place]:
    """Seat of each module in its body, whose frame has its origin at the leader's cell."""
    leaders, pitch_m = {m: members[0] for members in scenario.groups for m in members}, pitch_of(scenario)
    return [place(m.cell, m.rotation, pitch_m, np.array(scenario.module[leaders[i]].cell)) for i, m in enumerate(scenario.module)]


def starts_of(scenario: Scenario, vehicles: Sequence[Vehicle], bodies: Sequence[Start]) -> list[Start]:
    """Pose of each module at time 0.

    bodies: initial pose of each of the scenario's groups: of the centre of mass, or of the hull's centre of a lone module.
    """
    places = places_of(scenario)
    starts = [m.start for m in scenario.module]
    for members, start in zip(scenario.groups, bodies, strict=True):
        centre = nominal_centre([vehicles[m] for m in members], [places[m] for m in members]) if len(members) > 1 else np.zeros(3)
        for m in members:
            lever = rotations.rotate(start.q_wm, places[m].position - centre)
            starts[m] = Start(start.p_wm + lever, rotations.multiply(start.q_wm, places[m].quaternion))
    return starts


def hull_of(vehicle: Vehicle, start: Start) -> np.ndarray:
    """(8, 3) corners of a module's hull, world, m."""
    return start.p_wm + CORNERS * vehicle.hull.size_m @ rotations.to_matrix(start.q_wm).T


def in_wall(tank: Tank, points: np.ndarray) -> str:
    """Describes which wall the points (..., 3) penetrate deepest, and by how much; empty when all are between walls and bottom.

    The surface is no wall: a hull that sticks out of the water floats.
    """
    x, y, z = (points[..., axis] for axis in range(3))
    if tank.kind == "box":
        length, width, depth = tank.size_m.tolist()
        beyond = {"wall at +x": x - 0.5 * length, "wall at -x": -x - 0.5 * length}
        beyond |= {"wall at +y": y - 0.5 * width, "wall at -y": -y - 0.5 * width}
    else:
        beyond, depth = {"wall": np.hypot(x, y) - tank.radius_m}, tank.depth_m
    deepest = {name: float(np.max(by)) for name, by in (beyond | {"bottom": z - depth}).items()}
    wall = max(deepest, key=deepest.__getitem__)
    return f"{deepest[wall]:.3g} m into the {wall} of the tank, a {tank}" if deepest[wall] > TOUCHING_M else ""


def inscribed_radius_m(vehicle: Vehicle) -> float:
    """Radius of the largest sphere about the centre of a vehicle's hull that is inside it."""
    return 0.5 * float(vehicle.hull.size_m.min())


def sphere_in_wall(tank: Tank, centre_m: np.ndarray, radius_m: float) -> str:
    """Describes which wall a sphere about `centre_m` (3,), world, penetrates deepest, as `in_wall` does."""
    x, y, _ = centre_m.tolist()
    outward = np.array([x, y, 0.0]) / max(math.hypot(x, y), TOUCHING_M)
    return in_wall(tank, centre_m + radius_m * np.array([*np.eye(3), *-np.eye(3), outward]))


def remedy(tank: Tank, vehicle: Vehicle, start: Start) -> str:
    """What to do about a hull that starts in a wall: move it, or, if it is larger than the tank in its attitude, take another."""
    extent = np.ptp(hull_of(vehicle, start), axis=0)
    room = tank.size_m if tank.kind == "box" else np.array([2.0 * tank.radius_m, 2.0 * tank.radius_m, tank.depth_m])
    if np.all(extent <= room + TOUCHING_M):
        return MOVE_IN
    edges = " x ".join(f"{edge:.3g}" for edge in extent)
    return f"{vehicle.name}, {edges} m as it starts, does not fit that tank: take a larger tank or a smaller vehicle"


def hull_levers(scenario: Scenario) -> dict[int, tuple[Start, np.ndarray]]:
    """Initial pose of the body, and (8, 3) hull corners relative to it, body frame, m; by module index, body after body."""
    vehicles = [load_vehicle(module.vehicle) for module in scenario.module]
    bodies = [scenario.module[members[0]].start for members in scenario.groups]
    starts = starts_of(scenario, vehicles, bodies)
    return {
        m: (body, (hull_of(vehicles[m], starts[m]) - body.p_wm) @ rotations.to_matrix(body.q_wm))
        for members, body in zip(scenario.groups, bodies, strict=True)
        for m in members
    }


def hulls_in_walls(scenario: Scenario, shifts_m: np.ndarray, yaws: np.ndarray) -> Iterator[tuple[int, str]]:
    """Yields (index, description) of each module whose hull would start in a wall at any combination of offsets; the worst case of each.

    Args:
        shifts_m: (n, 3) offsets of a body from its place, world.
        yaws: (k,) rotations of a body about the vertical, rad.
    """
    turns = np.array([rotations.to_matrix(rotations.from_euler(0.0, 0.0, yaw)) for yaw in yaws.tolist()])
    for m, (start, levers) in hull_levers(scenario).items():
        hull = start.p_wm + np.einsum("kij,cj->kci", turns, levers @ rotations.to_matrix(start.q_wm).T)
        if where := in_wall(scenario.tank, shifts_m[:, None, None] + hull):
            yield m, where


def refuse_in_walls(scenario: Scenario, vehicles: Sequence[Vehicle], starts: Sequence[Start], seed: int) -> None:
    """Raises DescriptionError when a hull would start in a wall."""
    for module, vehicle, start in zip(scenario.module, vehicles, starts, strict=True):
        if where := in_wall(scenario.tank, hull_of(vehicle, start)):
            what = f"in seed {seed} the hull of module {module.number} starts {where}; {remedy(scenario.tank, vehicle, start)}"
            raise DescriptionError(f"{scenario.name}: {what}")


def refuse_overlap(scenario: Scenario, vehicles: Sequence[Vehicle], starts: Sequence[Start], seed: int) -> None:
    """Raises DescriptionError when two bodies would start inside each other: the inscribed spheres of their hulls overlap."""
    radii = [inscribed_radius_m(vehicle) for vehicle in vehicles]
    docked = {pair for members in scenario.groups for pair in itertools.combinations(members, 2)}
    for (i, one), (j, other) in itertools.combinations(enumerate(starts), 2):
        apart_m = float(np.linalg.norm(one.p_wm - other.p_wm))
        if (i, j) not in docked and apart_m < radii[i] + radii[j]:
            numbers = f"{scenario.module[i].number} and {scenario.module[j].number}"
            raise DescriptionError(
                f"{scenario.name}: in seed {seed} modules {numbers} start {apart_m:.3g} m apart, one inside the other; "
                f"{radii[i] + radii[j]:.3g} m is the least"
            )
