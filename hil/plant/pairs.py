"""Poses of modules, velocities of body points, and forces between two bodies. Called at every stage of the integration."""

from __future__ import annotations

from hil.plant.bodies import add_force
from hil.plant.vectors import (
    M3,
    callee,
    column,
    compiled,
    cross,
    dot,
    inlined,
    matrix,
    matrix_of,
    minus,
    plus,
    times,
    triple,
    turn,
    turn_back,
)


@compiled(M3(M3, M3))
def product(a, b):
    """a b."""
    x, y, z = (b[0][0], b[1][0], b[2][0]), (b[0][1], b[1][1], b[2][1]), (b[0][2], b[1][2], b[2][2])
    return (
        (dot(a[0], x), dot(a[0], y), dot(a[0], z)),
        (dot(a[1], x), dot(a[1], y), dot(a[1], z)),
        (dot(a[2], x), dot(a[2], y), dot(a[2], z)),
    )


@callee
def turn_into(a, b):
    """a^T b."""
    return (
        (dot(column(a, 0), column(b, 0)), dot(column(a, 0), column(b, 1)), dot(column(a, 0), column(b, 2))),
        (dot(column(a, 1), column(b, 0)), dot(column(a, 1), column(b, 1)), dot(column(a, 1), column(b, 2))),
        (dot(column(a, 2), column(b, 0)), dot(column(a, 2), column(b, 1)), dot(column(a, 2), column(b, 2))),
    )


@inlined
def centre_of(modules, x, m):
    """Hull centre in the world."""
    b = modules.body[m]
    r = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    return plus(triple(x, b, 0), turn(r, triple(modules.position, m, 0)))


@callee
def pose_of(modules, x, m):
    """Hull centre in the world, and module frame to world."""
    b = modules.body[m]
    r = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    return plus(triple(x, b, 0), turn(r, triple(modules.position, m, 0))), product(r, matrix(modules.turn, m))


@callee
def velocity_at(x, b, p):
    """Velocity of the point of body b that is at p; both world."""
    r = matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6])
    at = turn_back(r, minus(p, triple(x, b, 0)))
    return turn(r, plus(triple(x, b, 7), cross(triple(x, b, 10), at)))


@callee
def rate_of(x, b):
    """Angular rate of body b, world."""
    return turn(matrix_of(x[b, 3], x[b, 4], x[b, 5], x[b, 6]), triple(x, b, 10))


@callee
def push_apart(wrench, x, i, j, p, f):
    """Adds the force f (world) on body j at the world point p, and its counter-force on body i."""
    ri = matrix_of(x[i, 3], x[i, 4], x[i, 5], x[i, 6])
    rj = matrix_of(x[j, 3], x[j, 4], x[j, 5], x[j, 6])
    add_force(wrench, j, turn_back(rj, minus(p, triple(x, j, 0))), turn_back(rj, f))
    add_force(wrench, i, turn_back(ri, minus(p, triple(x, i, 0))), turn_back(ri, times(-1.0, f)))


@callee
def turn_apart(wrench, x, i, j, n):
    """Adds the moment n (world) on body j, and its counter-moment on body i."""
    ni = turn_back(matrix_of(x[i, 3], x[i, 4], x[i, 5], x[i, 6]), n)
    nj = turn_back(matrix_of(x[j, 3], x[j, 4], x[j, 5], x[j, 6]), n)
    for k in range(3):
        wrench[j, 3 + k] += nj[k]
        wrench[i, 3 + k] -= ni[k]
