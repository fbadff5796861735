"""Jets: the water that a thruster throws pushes the first other module in its way. Once per tick."""

from __future__ import annotations

import math

from numba import types

from hil.plant.bodies import BODIES, MODULES, add_force
from hil.plant.thrusters import THRUSTERS
from hil.plant.vectors import F2, F8, I8, V3, compiled, dot, matrix_of, minus, plus, times, triple, turn, turn_back

SPREADING = 0.1
"""Widening of a round jet per length (Pope, Turbulent Flows, 2000, section 5.1: 0.094)."""
SAME_M = 1e-6
"""Ways along a jet that differ by less are the same, so that rounding decides nothing: of two modules the earlier one is hit."""


@compiled(V3(F2, I8, V3))
def to_world(x, b, r):
    """A point of body b in the world."""
    return plus(triple(x, b, 0), turn(matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), r))


@compiled(types.UniTuple(F8, 2)(V3, V3, V3, F8))
def in_the_way(gap, size, jet, radius):
    """(way along the jet to the point nearest to a module's centre, share of the jet that it catches: 0 is a miss).

    Args:
        gap: from the jet's start to that centre; jet: unit vector in the same frame. What lies beside the start catches nothing,
            and all of its share from a `radius` ahead.
        size: edges of the hull.
    """
    ahead = dot(gap, jet)
    if ahead <= SAME_M:
        return ahead, 0.0
    half = (size[0] + size[1] + size[2]) / 6.0
    beside = math.sqrt(max(0.0, dot(gap, gap) - ahead * ahead))
    miss = max(0.0, beside - half) / (radius + SPREADING * ahead)
    return ahead, min(1.0, (ahead - SAME_M) / radius) * math.exp(-miss * miss) if miss < 2.0 else 0.0


@compiled(types.void(THRUSTERS, BODIES, MODULES, F8, F8, F8, F2))
def add_jets(thrusters, bodies, modules, strength, length, radius, out):
    """Adds the push of every jet to the wrenches out (m, 6) of the modules that it hits, about O of their bodies, body frame.

    A jet leaves against the force. `strength` of its thrust is felt at its start, half of that after `length` (m), at
    the point of its axis nearest to the centre of the first module in its way. Modules of the same body count too: in the
    frame of that body, for what it does to itself does not depend on where it is.
    """
    x = bodies.state
    for t in range(thrusters.force.shape[0]):
        force, b = thrusters.force[t], thrusters.body[t]
        if abs(force) < 1e-6:
            continue
        against = times(-1.0 if force > 0.0 else 1.0, triple(thrusters.column, t, 0))
        jet = turn(matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), against)
        seat = triple(thrusters.position, t, 0)
        start = to_world(x, b, seat)
        hit, way, caught = -1, 1e9, 0.0
        for m in range(modules.body.shape[0]):
            if m == thrusters.module[t]:
                continue
            at, size = triple(modules.position, m, 0), triple(modules.size, m, 0)
            if modules.body[m] == b:
                ahead, share = in_the_way(minus(at, seat), size, against, radius)
            else:
                ahead, share = in_the_way(minus(to_world(x, modules.body[m], at), start), size, jet, radius)
            if share > 0.0 and ahead < way - SAME_M:
                hit, way, caught = m, ahead, share
        if hit >= 0:
            c, push = modules.body[hit], strength * caught * abs(force) / (1.0 + way / length)
            if c == b:
                add_force(out, hit, plus(seat, times(way, against)), times(push, against))
                continue
            other = matrix_of(x[c, 3], x[c, 4], x[c, 5], x[c, 6])
            at = turn_back(other, minus(plus(start, times(way, jet)), triple(x, c, 0)))
            add_force(out, hit, at, turn_back(other, times(push, jet)))
