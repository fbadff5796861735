"""One tick of the world: fourth-order Runge-Kutta integration of bodies, thrusters and water at a fixed sub-step."""

from __future__ import annotations

import math

from numba import types

from hil.plant.bodies import BODIES, MODULES, accelerate, load, observe
from hil.plant.contact import FACES, interact
from hil.plant.thrusters import THRUSTERS, forces_after, load_supplies, settle
from hil.plant.vectors import F2, F3, F8, I8, callee, compiled, inlined, plus, times, triple
from hil.plant.water import WATER, flow_at


@inlined
def wrenches(thrusters, external, out):
    """Writes the sum (b, 6) of all thrusters' wrenches and `external` (b, 6), about O, body frame."""
    for b in range(out.shape[0]):
        for i in range(6):
            out[b, i] = external[b, i]
    t, column = 0, thrusters.column
    while t < thrusters.force.shape[0]:
        b = thrusters.body[t]
        f, n = triple(out, b, 0), triple(out, b, 3)
        while t < thrusters.force.shape[0] and thrusters.body[t] == b:  # thrusters of one body are summed in registers
            f = plus(f, times(thrusters.force[t], triple(column, t, 0)))
            n = plus(n, times(thrusters.force[t], triple(column, t, 3)))
            t += 1
        for i in range(3):
            out[b, i], out[b, 3 + i] = f[i], n[i]


@callee
def along(x, h, rate, out):
    """out = x + h rate."""
    for b in range(x.shape[0]):
        for i in range(13):
            out[b, i] = x[b, i] + h * rate[b, i]


@callee
def close_step(x, h, stage):
    """Adds the weighted sum of the four stages to x and normalises the quaternions."""
    for b in range(x.shape[0]):
        for i in range(13):
            x[b, i] += h / 6.0 * (stage[0, b, i] + 2.0 * (stage[1, b, i] + stage[2, b, i]) + stage[3, b, i])
        norm = math.sqrt(x[b, 3] ** 2 + x[b, 4] ** 2 + x[b, 5] ** 2 + x[b, 6] ** 2)
        for i in range(3, 7):
            x[b, i] /= norm


@inlined
def derivative(bodies, modules, faces, water, flow, flow_rate, thrust, x, out):
    """Rate of change of the states.

    Args:
        faces: None in a world of one body, which has no contacts: merely passing it through would cost a third of the time.
        flow, flow_rate: velocity and acceleration of the water, world.
        thrust: (b, 6) wrench of all thrusters and external forces about O, body frame.
        x: (b, 13) states; out: (b, 13) written.
    """
    load(bodies, modules, water, flow, flow_rate, thrust, x)
    if faces is not None:
        interact(bodies, modules, faces, x)
    for b in range(x.shape[0]):
        accelerate(bodies, b, x, out, flow, flow_rate)


@compiled([
    types.void(BODIES, MODULES, faces, THRUSTERS, WATER, F2, I8, F8, F3, F2, F2) for faces in (FACES, types.none)
])
def advance(bodies, modules, faces, thrusters, water, external, steps, h, stage, thrust, seen):
    """Integrates the world over `steps` sub-steps of h seconds.

    Args:
        faces: see `derivative`.
        external: (b, 6) wrench of jets and external pushes about O, body frame, constant over the call.
        stage: (6, b, 13) working memory; stage[5] holds the derivative of the states at the end.
        thrust: (b, 6) working memory.
        seen: (m, 16) written: pose, velocity, rate and specific force of every module at the end (`bodies.observe`).
    """
    x, trial = bodies.state, stage[4]
    for s in range(steps):
        load_supplies(thrusters, 1)  # at the midpoint, for second-order accuracy
        for k in range(4):
            share = 0.0 if k == 0 else (1.0 if k == 3 else 0.5)
            if k != 2:
                forces_after(thrusters, 0 if k == 0 else (2 if k == 3 else 1))
                wrenches(thrusters, external, thrust)
            flow, flow_rate = flow_at(water, (s + share) * h)
            along(x, share * h, stage[max(0, k - 1)], trial)
            derivative(bodies, modules, faces, water, flow, flow_rate, thrust, trial, stage[k])
        close_step(x, h, stage)
        settle(thrusters)
    flow, flow_rate = flow_at(water, steps * h)
    for i in range(3):
        water.flow[1, i] = flow[i] - water.flow[0, i]
    load_supplies(thrusters, 0)
    forces_after(thrusters, 0)
    wrenches(thrusters, external, thrust)
    derivative(bodies, modules, faces, water, flow, flow_rate, thrust, x, stage[5])
    observe(bodies, modules, stage[5], water.gravity, seen)
