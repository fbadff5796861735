"""Modules of the plant in calm deep water: two that are about to dock, or docked already."""

import dataclasses

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.plant.dock_spec import JamRule
from hil.plant.lattice import Place
from hil.plant.spec import CALM, Tank, WorldSpec
from hil.plant.world import Start, World

PERIOD_NS = 10_000_000
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
OCEAN = Tank(kind="box", size_m=np.array([900.0, 900.0, 900.0]))
VEHICLE = load_vehicle("modcube")
PULL, PUSH, OFF = 1, 2, 0
NEVER, ALWAYS = JamRule(probability_inside=0.0, probability_outside=0.0), JamRule(probability_inside=1.0)


def two(
    gap_m: float, lateral_m: float = 0.0, jam: JamRule = NEVER, q: np.ndarray = LEVEL, vehicle: Vehicle = VEHICLE, **world: float
) -> World:
    """Module 1 in front of module 0's +x face, its -x face towards it, in calm deep water."""
    starts = [Start(np.array([0.0, 0.0, 400.0]), LEVEL), Start(np.array([0.21 + gap_m, lateral_m, 400.0]), q)]
    return World(WorldSpec(**{**CALM, **world}), OCEAN, [vehicle] * 2, starts, 0, PERIOD_NS, jam=jam)


def relays(world: World, state: int) -> None:
    world.set_relays(0, [state, 0, 0, 0, 0, 0])
    world.set_relays(1, [0, state, 0, 0, 0, 0])


def run(world: World, seconds: float) -> None:
    for _ in range(round(1e9 * seconds / PERIOD_NS)):
        world.advance(PERIOD_NS)


def docked_pair(**world: float) -> World:
    pair = two(0.02, 0.002, **world)
    relays(pair, PULL)
    run(pair, 3.0)
    assert pair.bodies == [(0, 1)]
    return pair


SMOOTH = dataclasses.replace(
    VEHICLE,
    faces=("-",) * 6,
    drag=dataclasses.replace(VEHICLE.drag, cd_face=0.0, cd_edge=0.0, rotational_cd=0.0),
    inertial=dataclasses.replace(VEHICLE.inertial, righting_arm_m=0.0),
)
"""A bare hull, without docking faces, drag or righting arm: only contact acts on it."""


def hulls(x_m: float, y_m: float = 0.0, roll_deg: float = 0.0, vehicle: Vehicle = SMOOTH) -> World:
    """Two hulls along x, the second one rolled by `roll_deg`."""
    q = rotations.from_euler(np.radians(roll_deg), 0.0, 0.0)
    starts = [Start(np.array([0.0, 0.0, 400.0]), LEVEL), Start(np.array([x_m, y_m, 400.0]), q)]
    return World(WorldSpec(**CALM), OCEAN, [vehicle] * 2, starts, 0, PERIOD_NS, jam=NEVER)


SLIPPERY = dataclasses.replace(SMOOTH, faces=VEHICLE.faces)


def start_docked(third_m: float = 100.0, tank: Tank = OCEAN, **world: float) -> World:
    """Two modules docked along x, and a third one on the same axis at `third_m`."""
    starts = [Start(np.array([x, 0.0, 400.0]), LEVEL) for x in (0.0, 0.21, third_m)]
    places = [Place(np.array([x, 0.0, 0.0]), LEVEL.copy()) for x in (0.0, 0.21, 0.0)]
    spec = WorldSpec(**{**CALM, **world})
    return World(spec, tank, [SLIPPERY] * 3, starts, 0, PERIOD_NS, groups=[(0, 1), (2,)], places=places, jam=NEVER)
