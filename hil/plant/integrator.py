"""One tick of the world: bodies, thrusters and water move on together, by Runge-Kutta of fourth order at a fixed sub-step."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from hil.plant.bodies import BODIES, MODULES, SCRATCH, add_force, derivative, turn
from hil.plant.thrusters import THRUSTERS, forces_after, load_supplies, settle
from hil.plant.water import F1, F2, F3, WATER, flow_at

F8 = types.float64


@njit(types.void(MODULES, THRUSTERS, F1, F1, F2, F2), cache=True)
def wrenches(modules, thrusters, force, jets, work, out):
    """Writes the wrench (b, 6) of all thrusters about O, body frame; `jets` (m, 6) flattened is added to each body."""
    out[:] = 0.0
    f, at = work[12], work[13]
    for t in range(force.shape[0]):
        m = thrusters.module[t]
        turn(modules.turn[m], thrusters.position[t], at)
        turn(modules.turn[m], thrusters.direction[t], f)
        for i in range(3):
            at[i] += modules.position[m, i]
            f[i] *= force[t]
        add_force(out[modules.body[m]], at, f)
    for m in range(modules.body.shape[0]):
        for i in range(6):
            out[modules.body[m], i] += jets[6 * m + i]


@njit(types.void(BODIES, MODULES, THRUSTERS, WATER, F1, types.int64, F8, SCRATCH, F3), cache=True)
def advance(bodies, modules, thrusters, water, jets, steps, h, scratch, stage):
    """Moves everything on by `steps` sub-steps of h seconds.

    Args:
        jets: (6 m,) wrench of foreign jets on each module's body, held over the call.
        stage: (6, b, 13) working memory; stage[5, :, :6] holds the wrenches.
    """
    x = bodies.state
    flow, flow_rate = scratch.work[14], scratch.work[15]
    force = thrusters.force
    thrust = np.empty((x.shape[0], 6))
    for s in range(steps):
        load_supplies(thrusters)
        for k in range(4):
            share = 0.0 if k == 0 else (1.0 if k == 3 else 0.5)
            if k != 2:
                forces_after(thrusters, share * h, force)
                wrenches(modules, thrusters, force, jets, scratch.work, thrust)
                flow_at(water, (s + share) * h, flow, flow_rate)
            if k == 0:
                derivative(bodies, modules, water, flow, flow_rate, thrust, x, stage[0], scratch)
            else:
                for b in range(x.shape[0]):
                    for i in range(13):
                        stage[4, b, i] = x[b, i] + share * h * stage[k - 1, b, i]
                derivative(bodies, modules, water, flow, flow_rate, thrust, stage[4], stage[k], scratch)
        for b in range(x.shape[0]):
            for i in range(13):
                x[b, i] += h / 6.0 * (stage[0, b, i] + 2.0 * (stage[1, b, i] + stage[2, b, i]) + stage[3, b, i])
            norm = math.sqrt(x[b, 3] ** 2 + x[b, 4] ** 2 + x[b, 5] ** 2 + x[b, 6] ** 2)
            for i in range(3, 7):
                x[b, i] /= norm
        settle(thrusters, h)
    flow_at(water, steps * h, flow, flow_rate)
    for i in range(3):
        water.flow[1, i] = flow[i] - water.flow[0, i]
    load_supplies(thrusters)
    forces_after(thrusters, 0.0, force)
    wrenches(modules, thrusters, force, jets, scratch.work, thrust)
    # What the accelerometers feel now.
    derivative(bodies, modules, water, flow, flow_rate, thrust, x, stage[5], scratch)
