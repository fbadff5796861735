"""Simulates many worlds in one call, for studies without a bus: single modules under given commands, eight worlds at a time per thread.

The physics is that of the plant; the results are bit-identical to those of `World.advance`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import types

from firmware_py.description.schema import DescriptionError
from hil.plant.bodies import BODIES, MODULES, Modules
from hil.plant.build import make_bodies
from hil.plant.integrator import advance
from hil.plant.lanes import CHANNELS, LANES, ROWS, fly_lanes, gather, scatter
from hil.plant.thrusters import THRUSTERS, command
from hil.plant.vectors import F2, F3, F8, I8, compiled
from hil.plant.water import WATER
from hil.plant.world import Arrays, World

MAX_SEQUENTIAL_WORLDS = 2
"""Largest number of worlds that run faster one by one than in eight mostly idle lanes."""
SEEN = 16
"""Columns of a row: hull centre and attitude, world, 0:7; velocity, world, 7:10; rate and specific force, module frame, 10:16."""


def fly(worlds: Sequence[World], commands: np.ndarray, threads: int = 0) -> np.ndarray:
    """Advances every world by k ticks.

    Args:
        worlds: each with a single module, all with the same number of thrusters t, the same tank, water and tick.
        commands: (n, k, t) share of full command, -1 to 1, during each tick; or (k, t), the same for all worlds.
        threads: number of threads; 0: one per core.

    Returns:
        (n, k, 16) state of each module after each tick, see SEEN.

    Raises:
        DescriptionError: worlds that cannot run in one batch, commands of another shape, no ticks, or a negative number of threads.
            No world has moved then.
    """
    given, count = np.asarray(commands, dtype=np.float64), len(worlds)
    _check_worlds(worlds)
    _check_commands(given, count, len(worlds[0].vehicles[0].thruster))
    if threads < 0:
        raise DescriptionError(f"batch: {threads} threads; it needs 0, one a core, or more")
    parts = [world.lend_arrays(given.shape[-2]) for world in worlds]
    given = np.array(np.broadcast_to(given, (count, *given.shape[-2:])), order="C")
    out = np.empty((count, given.shape[1], SEEN))

    def run_lanes(first: int) -> None:
        lanes = slice(first, min(first + LANES, count))
        _fly_some(parts[lanes], given[lanes], out[lanes])

    wanted = min(threads or os.cpu_count() or 1, -(-count // LANES))
    with ThreadPoolExecutor(wanted) as pool:
        list((pool.map if wanted > 1 else map)(run_lanes, range(0, count, LANES)))
    return out


def _check_worlds(worlds: Sequence[World]) -> None:
    """Raises DescriptionError when these worlds cannot run in one batch."""
    if not worlds:
        raise DescriptionError("batch: no worlds; it needs one at least")
    if len({id(world) for world in worlds}) < len(worlds):
        raise DescriptionError("batch: the same world is given twice; each needs to be one of its own")
    if len({world.batch_key() for world in worlds}) > 1:
        raise DescriptionError("batch: worlds differ in tank, water or tick; all need the same")
    counts = {len(world.vehicles[0].thruster) for world in worlds}
    if len(counts) > 1 or max(counts) > CHANNELS:
        raise DescriptionError(f"batch: modules differ in their thrusters; all need the same number, at most {CHANNELS}")


def _check_commands(given: np.ndarray, worlds: int, thrusters: int) -> None:
    """Raises DescriptionError when the shape of `given` does not fit this number of worlds and thrusters."""
    if given.ndim not in (2, 3) or given.shape[-1] != thrusters or (given.ndim == 3 and len(given) != worlds):
        raise DescriptionError(f"batch: commands have the shape {given.shape}; (ticks, {thrusters}) or ({worlds}, ticks, {thrusters}) fit")
    if given.shape[-2] == 0:
        raise DescriptionError("batch: commands of no ticks; it needs one at least")


def _fly_some(parts: Sequence[Arrays], commands: np.ndarray, out: np.ndarray) -> None:
    """Runs at most eight worlds, in lanes or one by one."""
    if len(parts) > MAX_SEQUENTIAL_WORLDS:
        return _fly_together(parts, commands, out)
    for part, given, seen in zip(parts, commands, out, strict=True):
        _fly_alone(*part, given, seen)


@compiled(types.void(BODIES, MODULES, THRUSTERS, WATER, F2, F2, I8, F8, F3, F2, F2, F2, F2), nogil=True)
def _fly_alone(bodies, modules, thrusters, water, gusts, external, steps, step_s, stage, thrust, seen, commands, out):
    """Runs one world over all ticks; its arrays are the fields of `plant.world.Arrays`. commands: (k, t); out: (k, 16) written."""
    for i in range(6):
        external[0, i] = 0.0
    for k in range(commands.shape[0]):
        command(thrusters.force_curve, thrusters.constants, thrusters.level, 0, commands[k])
        for i in range(3):
            water.flow[2, i] = gusts[k, i]
        advance(bodies, modules, None, thrusters, water, external, steps, step_s, stage, thrust, seen)
        for i in range(16):
            out[k, i] = seen[0, i]


def _fly_together(parts: Sequence[Arrays], commands: np.ndarray, out: np.ndarray) -> None:
    """Runs the worlds in lanes. Spare lanes repeat the first world, and their results are discarded."""
    lanes = [*range(len(parts)), *[0] * (LANES - len(parts))]
    memory = np.zeros(ROWS * LANES)
    for lane, i in enumerate(lanes):
        gather(memory, lane, *parts[i][:4])
    fields = zip(*(parts[i].modules[1:] for i in lanes), strict=True)
    modules = Modules(np.arange(LANES), *(np.concatenate(field) for field in fields))
    gusts, given, first = np.stack([parts[i].gusts for i in lanes]), commands[lanes], parts[0]
    fly_lanes(memory, LANES, make_bodies(LANES), modules, first.water, gusts, given, first.steps, first.step_s, out)
    for lane, part in enumerate(parts):
        scatter(memory, lane, part.bodies, part.thrusters, part.water, part.stage, part.seen, out[lane])
