"""Jets: the water that a thruster throws pushes the first other module in its way. Once per tick."""

from __future__ import annotations

import math

from numba import types

from hil.plant.bodies import BODIES, MODULES, add_force
from hil.plant.thrusters import THRUSTERS
from hil.plant.vectors import F2, F8, V3, callee, compiled, dot, matrix_of, minus, plus, times, triple, turn, turn_back

I8 = types.int64
SPREADING = 0.1
"""Widening of a round jet per length (Pope, Turbulent Flows, 2000, section 5.1: 0.094)."""


@compiled(V3(F2, I8, V3))
def to_world(x, b, r):
    """A point of body b in the world."""
    return plus(triple(x, b, 0), turn(matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), r))


@callee
def in_the_way(modules, x, m, start, jet, radius):
    """(way along the jet to the point nearest to module m's centre, share of the jet that it catches: 0 is a miss)."""
    gap = minus(to_world(x, modules.body[m], triple(modules.position, m, 0)), start)
    ahead = dot(gap, jet)
    if ahead <= 0.0:
        return ahead, 0.0
    half = (modules.size[m, 0] + modules.size[m, 1] + modules.size[m, 2]) / 6.0
    beside = math.sqrt(max(0.0, dot(gap, gap) - ahead * ahead))
    miss = max(0.0, beside - half) / (radius + SPREADING * ahead)
    return ahead, math.exp(-miss * miss) if miss < 2.0 else 0.0


@compiled(types.void(THRUSTERS, BODIES, MODULES, F8, F8, F8, F2))
def add_jets(thrusters, bodies, modules, strength, length, radius, out):
    """Adds the push of every jet to the wrenches out (m, 6) of the modules that it hits, about O of their bodies, body frame.

    A jet leaves against the force. `strength` of its thrust is felt at its start, half of that after `length` (m), at
    the point of its axis nearest to the centre of the first module in its way. Modules of the same body count too.
    """
    x = bodies.state
    for t in range(thrusters.force.shape[0]):
        force, b = thrusters.force[t], thrusters.body[t]
        if abs(force) < 1e-6:
            continue
        against = times(-1.0 if force > 0.0 else 1.0, triple(thrusters.column, t, 0))
        jet = turn(matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), against)
        start = to_world(x, b, triple(thrusters.position, t, 0))
        hit, way, caught = -1, 1e9, 0.0
        for m in range(modules.body.shape[0]):
            ahead, share = in_the_way(modules, x, m, start, jet, radius)
            if m != thrusters.module[t] and share > 0.0 and ahead < way:
                hit, way, caught = m, ahead, share
        if hit >= 0:
            c = modules.body[hit]
            other = matrix_of(x[c, 3], x[c, 4], x[c, 5], x[c, 6])
            at = turn_back(other, minus(plus(start, times(way, jet)), triple(x, c, 0)))
            push = strength * caught * abs(force) / (1.0 + way / length)
            add_force(out, hit, at, turn_back(other, times(push, jet)))
