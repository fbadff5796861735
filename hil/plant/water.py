"""The water and its boundaries: current with gusts, walls, bottom and surface of the tank.

The current is uniform over the tank: a mean drawn per seed plus second-order Gauss-Markov gusts, which have finite
acceleration. Walls are soft: springs and dampers at the corners of each hull.
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import numpy as np
from numba import types

from hil.plant.draw import Noise
from hil.plant.spec import Tank, WorldSpec
from hil.plant.vectors import F1, F2, F8, callee, compiled, dot, inlined, minus, plus, times, triple

AHEAD = 128
"""Number of ticks per block of gusts drawn ahead."""
FRICTION = 0.3
"""Largest friction at a wall, share of the normal force (synthetic)."""


class Water(NamedTuple):
    """The water as arrays."""

    flow: np.ndarray
    """(3, 3) mean current; present gust; target of the gust; m/s, world."""
    density: float
    gravity: float
    smoothing_s: float
    stiffness: float
    damping: float
    is_box: bool
    half_length: float
    """Half the length of a box, or the radius of a cylinder, m."""
    half_width: float
    depth: float


WATER = types.NamedTuple((F2, *(F8,) * 5, types.boolean, F8, F8, F8), Water)


def make_water(spec: WorldSpec, tank: Tank) -> Water:
    """Returns still water in `tank`."""
    is_box = tank.kind == "box"
    length, width, depth = tank.size_m.tolist() if is_box else (2 * tank.radius_m, 2 * tank.radius_m, tank.depth_m)
    wall = (spec.wall_stiffness, spec.wall_damping)
    extent = (0.5 * length, 0.5 * width, depth)
    return Water(np.zeros((3, 3)), spec.density, spec.gravity, spec.gust_smoothing_s, *wall, is_box, *extent)


class Gusts:
    """Generates the gust target: white noise after the first of two lags, T1 (correlation) and T2 (smoothing, in `flow_at`), scaled so
    that the gust has the given variance.

    The output of the first lag has variance s1^2. Its covariance with the output of the second is s1^2 T1/(T1+T2), which is also
    the variance of the second (Lyapunov equation of the two lags).
    """

    def __init__(self, spec: WorldSpec, rng: np.random.Generator, period_s: float) -> None:
        t1, t2 = spec.gust_time_s, spec.gust_smoothing_s
        self._sigma = spec.gust_m_s * math.sqrt((t1 + t2) / t1)
        self._keep = math.exp(-period_s / t1)
        self._unit = rng.standard_normal(3)
        angle = rng.uniform(0.0, 2.0 * math.pi)
        self.mean = spec.current_m_s * np.array([math.cos(angle), math.sin(angle), 0.0])
        self.start = spec.gust_m_s * (
            math.sqrt(t1 / (t1 + t2)) * self._unit + math.sqrt(t2 / (t1 + t2)) * rng.standard_normal(3)
        )
        self._push = math.sqrt(1.0 - self._keep**2)
        self._noise = Noise(rng, 3)
        self._ahead = np.empty((0, 3))
        self._taken = 0

    def step(self) -> np.ndarray:
        """(3,) target of the gust during the next tick, m/s."""
        if self._taken == len(self._ahead):
            self._ahead, self._taken = self._draw(AHEAD), 0
        self._taken += 1
        return cast("np.ndarray", self._ahead[self._taken - 1])

    def steps(self, count: int) -> np.ndarray:
        """(count, 3) the targets of the next `count` ticks, the same as `count` calls of `step`."""
        ready = self._ahead[self._taken : self._taken + count]
        self._taken += len(ready)
        return np.concatenate([ready, self._draw(count - len(ready))]) if count > len(ready) else ready

    def _draw(self, count: int) -> np.ndarray:
        """(count, 3) newly drawn targets."""
        out = self._noise.take_many(count)
        _lag(self._unit, self._keep, self._push, out)
        self._unit = out[-1].copy()
        return self._sigma * out


@compiled(types.void(F1, F8, F8, F2))
def _lag(start, keep, push, out):
    """Filters the white noise out (k, 3) in place through the first lag; start: (3,) state before."""
    for k in range(out.shape[0]):
        for i in range(3):
            before = start[i] if k == 0 else out[k - 1, i]
            out[k, i] = keep * before + push * out[k, i]


@callee
def flow_at(water, since_s):
    """Velocity and acceleration of the water, world, `since_s` after `water.flow` was set."""
    keep, rate = math.exp(-since_s / water.smoothing_s), 1.0 / water.smoothing_s
    target = triple(water.flow, 2, 0)
    gap = times(keep, minus(triple(water.flow, 1, 0), target))
    return plus(triple(water.flow, 0, 0), plus(target, gap)), times(-rate, gap)


@inlined
def room(water, p):
    """Distance of p from the nearest of walls, bottom and surface, m; negative outside."""
    x, y, z = p
    corner = min(water.half_length - abs(x), water.half_width - abs(y))
    rim = water.half_length - math.sqrt(x * x + y * y)
    return min(corner if water.is_box else rim, min(z, water.depth - z))


@callee
def is_clear(water, centre, half):
    """Whether a box of half extents `half` along the world's axes touches neither wall, bottom nor surface."""
    if centre[2] < half[2] or centre[2] > water.depth - half[2]:
        return False
    if water.is_box:
        return abs(centre[0]) + half[0] < water.half_length and abs(centre[1]) + half[1] < water.half_width
    return math.hypot(centre[0], centre[1]) + math.hypot(half[0], half[1]) < water.half_length


@callee
def _push(water, deep, outward, v):
    """Force of one wall on a point that is `deep` metres inside it and moves with v; outward: unit vector into the wall."""
    if deep <= 0.0:
        return (0.0, 0.0, 0.0)
    into = dot(v, outward)
    normal = max(0.0, water.stiffness * deep + water.damping * into)
    along = minus(v, times(into, outward))
    speed = math.sqrt(dot(along, along))
    rub = min(water.damping, FRICTION * normal / speed) if speed > 1e-9 else 0.0
    return plus(times(-normal, outward), times(-rub, along))


@callee
def push_of_walls(water, p, v):
    """Force of walls and bottom on one corner at p with velocity v; all world."""
    f = _push(water, p[2] - water.depth, (0.0, 0.0, 1.0), v)
    if water.is_box:
        x, y = (1.0 if p[0] > 0.0 else -1.0), (1.0 if p[1] > 0.0 else -1.0)
        f = plus(f, _push(water, x * p[0] - water.half_length, (x, 0.0, 0.0), v))
        return plus(f, _push(water, y * p[1] - water.half_width, (0.0, y, 0.0), v))
    r = math.hypot(p[0], p[1])
    return plus(f, _push(water, r - water.half_length, (p[0] / r, p[1] / r, 0.0), v)) if r > water.half_length else f
