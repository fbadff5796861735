"""Thruster jets: the water that a thruster expels pushes the first other module in its path. Once per tick."""

from __future__ import annotations

import math

from numba import types

from hil.plant.bodies import BODIES, MODULES, add_force
from hil.plant.thrusters import THRUSTERS
from hil.plant.vectors import F2, F8, I8, V3, compiled, dot, matrix_of, minus, plus, times, triple, turn, turn_back

SPREADING = 0.1
"""Spreading rate of a round jet: growth of its radius per length (Pope, Turbulent Flows, 2000, section 5.1: 0.094)."""
SAME_M = 1e-6
"""Distances along a jet that differ by less count as equal, against rounding: of two such modules the one with the lower index is hit."""


@compiled(V3(F2, I8, V3))
def to_world(x, b, r):
    """Transforms a point r of body b to the world frame."""
    return plus(triple(x, b, 0), turn(matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), r))


@compiled(types.UniTuple(F8, 2)(V3, V3, V3, F8))
def in_the_way(gap, size, jet, radius):
    """(distance along the jet to the point nearest to a module's centre, share of the jet that the module catches: 0 is a miss).

    Args:
        gap: from the jet's start to that centre; jet: unit vector in the same frame. The share rises from zero beside the start to its
            full value one `radius` ahead.
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
    """Adds the push of every jet to the wrench out (m, 6) of the module that it hits, about O of that module's body, body frame.

    A jet flows opposite to the thruster's force. Its push is the share `strength` of the thrust at the start and half of that after
    `length` (m); it acts at the point of the jet axis nearest to the centre of the first module in its path. A module of the same body
    can be hit too; that case is computed in the body frame, so that it does not depend on the body's pose.
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
