"""Many worlds in one call, for studies that need no bus: lone modules under given commands, on several threads.

The physics is the plant's own, compiled: a world that a batch has moved is to the last bit where `World.advance` would have put it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit, types

from firmware_py.description.schema import DescriptionError
from hil.plant.bodies import BODIES, MODULES
from hil.plant.integrator import advance
from hil.plant.thrusters import THRUSTERS, command
from hil.plant.vectors import F2, F3, F8
from hil.plant.water import WATER
from hil.plant.world import World

SEEN = 16
"""Numbers of a row: hull's centre and attitude in the world 0:7, velocity (world) 7:10, rate and specific force (module) 10:16."""


@njit(
    types.void(BODIES, MODULES, THRUSTERS, WATER, F2, F2, types.int64, F8, F3, F2, F2, F2, F2),
    cache=True,
    error_model="numpy",
    nogil=True,
)
def _fly(bodies, modules, thrusters, water, gusts, external, steps, step_s, stage, thrust, seen, commands, out):
    """One world over all ticks; its arrays are those of `plant.world.Arrays`. commands: (k, t); out: (k, 16) is written."""
    external[:] = 0.0
    for k in range(commands.shape[0]):
        command(thrusters, 0, commands[k])
        water.flow[2] = gusts[k]
        advance(bodies, modules, None, thrusters, water, external, steps, step_s, stage, thrust, seen)
        out[k] = seen[0]


def fly(worlds: Sequence[World], commands: np.ndarray, threads: int = 0) -> np.ndarray:
    """Moves every world on by k ticks.

    Args:
        worlds: of one lone module each, of the same number of thrusters t.
        commands: (n, k, t) share of full command, -1 to 1, that acts during each tick; or (k, t), the same for all.
        threads: how many; 0: one a core.

    Returns:
        (n, k, 16) each module after each tick, see SEEN.

    Raises:
        DescriptionError: a world has more than one module, or the shape of `commands` is another.
    """
    count, thrusters = len(worlds), len(worlds[0].vehicles[0].thruster) if worlds else 0
    given = np.asarray(commands, dtype=np.float64)
    if given.ndim not in (2, 3) or given.shape[-1] != thrusters or (given.ndim == 3 and len(given) != count):
        raise DescriptionError(f"batch: commands have the shape {given.shape}; (ticks, {thrusters}) or ({count}, ticks, {thrusters}) fit")
    given = np.array(np.broadcast_to(given, (count, *given.shape[-2:])), order="C")
    out = np.empty((count, given.shape[1], SEEN))
    parts = [world.lend(given.shape[1]) for world in worlds]

    def one(i: int) -> None:
        _fly(*parts[i], given[i], out[i])

    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        list(pool.map(one, range(count)))
    return out
