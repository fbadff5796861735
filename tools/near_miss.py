"""Near misses by the thousand: a module drifts past another's face, magnets on or off, watched by the docking detector.

The detector works on real frames. There is no controller: one module is clamped, the other is pushed off and left to water, magnets and
funnel; or it is held just where it would dock, with a magnet that does not work. A pass in which the faces really lock is not a near
miss. The others show what each condition of the detector would have declared alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import numpy as np

from firmware_py.bus.codec import Codec
from firmware_py.bus.mapping import InputCollector, OutputEncoder
from firmware_py.core.docking_detector import FacePair, ModulePoses, PairDetector, tag_table
from firmware_py.core.types import ModuleCommand, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import FACE_NAMES
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_fleet
from hil.bench import fleet_of
from hil.nodes import make_nodes
from hil.plant.draw import stream
from hil.scenario import RandomStart, Scenario, load_scenario, make_world
from hil.starts import PITCH_M

PASS_S = 2.5
PERIOD_NS = 10_000_000
MOST_GAP_M, MOST_BESIDE_M, MOST_SPEED_M_S, MOST_TURN_DEG = 0.030, 0.015, 0.08, 4.0
"""Limits of a pass: gap between the faces, height off the axis, speed along the face, and tilt."""
HELD = 0.2
"""Share of the passes in which the module is held before the face with a magnet off; gap, height and tilt are then scaled by HELD_NEAR."""
HELD_NEAR = 0.2
FORWARD = 1


class Pass(NamedTuple):
    """Outcome of one pass."""

    current: bool
    """Whether the condition on the current held at any time."""
    position: bool
    declared: bool
    """Whether both held at once."""
    joined: bool
    """Whether the faces really locked."""


def fly_by(seed: int) -> Pass:
    """Simulates one pass, all of it drawn from its seed."""
    scenario, velocity, relays = _drawn(seed)
    fleet, vehicle = fleet_of(scenario, "virtual:near-miss", 100), load_vehicle(scenario.module[0].vehicle)
    world, codec = make_world(scenario, seed, PERIOD_NS), _codec()
    nodes = make_nodes(world, codec, scenario)
    collector, encoder = InputCollector(fleet, codec), OutputEncoder(fleet, codec)
    bodies = assemble_fleet(fleet, {vehicle.name: vehicle})
    detector = PairDetector(
        FacePair(0, FACE_NAMES.index("+x"), 1, FACE_NAMES.index("-x"), np.array([PITCH_M, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])),
        Parameters().docking,
    )
    world.set_motion(1, velocity, np.zeros(3))
    poses, seen = ModulePoses(tag_table(bodies), len(fleet.module)), (False, False, False)
    for tick in range(1, round(PASS_S * 1e9) // PERIOD_NS + 1):
        time_ns = tick * PERIOD_NS
        commands = [ModuleCommand(False, np.zeros(8), wanted) for wanted in relays]
        sent = [*encoder.sync(tick), *encoder.frames(Outputs(tick, time_ns, commands, False, [], []))]
        collector.sync_sent(tick, time_ns)
        collector.take(0, nodes.step([frame for _, frame in sent]))
        if len(world.bodies) == 1:
            return Pass(*seen, joined=True)
        inputs = collector.collect(tick, time_ns)
        poses.take(inputs.modules)
        status = detector.step(time_ns, inputs.modules, poses)
        seen = (seen[0] or status.current, seen[1] or status.position, seen[2] or status.docked)
    return Pass(*seen, joined=False)


def count(seeds: Iterable[int]) -> dict[str, int]:
    """Number of near misses among the passes, and in how many each condition alone, and both, would have declared a dock."""
    misses = [found for found in map(fly_by, seeds) if not found.joined]
    return {
        "misses": len(misses),
        "current": sum(p.current for p in misses),
        "position": sum(p.position for p in misses),
        "declared": sum(p.declared for p in misses),
    }


_codec, _scenario = cache(Codec.load), cache(load_scenario)


def _drawn(seed: int) -> tuple[Scenario, np.ndarray, list[tuple[int, ...]]]:
    """The scenario of a pass, the drifting module's velocity (3,) in the world, and the relays of both modules."""
    rng = stream(seed, "start")
    base = _scenario("dock-near-miss")
    gap, beside, turn = rng.uniform(0.0, MOST_GAP_M), rng.uniform(-MOST_BESIDE_M, MOST_BESIDE_M), rng.uniform(-1.0, 1.0, 3)
    speed, held, off = rng.uniform(-MOST_SPEED_M_S, MOST_SPEED_M_S), rng.random() < HELD, rng.integers(2)
    on = (True, True)
    if held:
        gap, beside, turn, speed, on = HELD_NEAR * gap, HELD_NEAR * beside, HELD_NEAR * turn, 0.0, (off == 1, False)
    target, drifting = base.module
    place = target.position_m + np.array([PITCH_M + gap, -0.5 * PASS_S * speed, beside])
    moved = dataclasses.replace(drifting, position_m=place, euler_deg=MOST_TURN_DEG * turn, clamped=held)
    scenario = dataclasses.replace(
        base, module=(dataclasses.replace(target, clamped=True), moved), start=RandomStart(), fault=()
    )
    faces = (FACE_NAMES.index("+x"), FACE_NAMES.index("-x"))
    relays = [tuple(FORWARD * int(on[m] and face == faces[m]) for face in range(len(FACE_NAMES))) for m in range(2)]
    return scenario, np.array([0.0, speed, 0.0]), relays
