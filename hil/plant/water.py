"""The water and its edges: current with gusts, walls, bottom and surface of the tank.

The current is uniform over the tank: a mean that is drawn per seed and second-order Gauss-Markov gusts, which have a finite
acceleration. Walls are soft: springs and dampers at the corners of each hull.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types

from hil.plant.spec import Tank, WorldSpec

F1, F2, F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
FRICTION = 0.3
"""Largest friction at a wall, share of the normal force (synthetic)."""


class Water(NamedTuple):
    """The water as arrays."""

    flow: np.ndarray
    """(3, 3) mean current; gust now; where the gust tends, m/s, world."""
    density: float
    gravity: float
    smoothing_s: float
    stiffness: float
    damping: float
    is_box: bool
    extent: np.ndarray
    """(3,) half length, half width, depth; or radius, radius, depth, m."""


WATER = types.NamedTuple((F2, *(types.float64,) * 5, types.boolean, F1), Water)


def make_water(spec: WorldSpec, tank: Tank) -> Water:
    """Still water in `tank`."""
    is_box = tank.kind == "box"
    extent = [0.5 * tank.size_m[0], 0.5 * tank.size_m[1], tank.size_m[2]] if is_box else [tank.radius_m, tank.radius_m, tank.depth_m]
    return Water(
        np.zeros((3, 3)), spec.density, spec.gravity, spec.gust_smoothing_s, spec.wall_stiffness, spec.wall_damping, is_box,
        np.array(extent, dtype=np.float64),
    )  # fmt: skip


class Gusts:
    """Drives the gust: white noise through two lags, T1 (correlation) and T2 (smoothing), with the wanted variance.

    The output of the first lag, of variance s1^2, has the covariance s1^2 T1/(T1+T2) with that of the second and gives it the
    same figure as variance (Lyapunov's equation of the two lags).
    """

    def __init__(self, spec: WorldSpec, rng: np.random.Generator, period_s: float) -> None:
        t1, t2 = spec.gust_time_s, spec.gust_smoothing_s
        self._sigma = spec.gust_m_s * math.sqrt((t1 + t2) / t1)
        self._keep = math.exp(-period_s / t1)
        self._rng = rng
        self._unit = rng.standard_normal(3)
        angle = rng.uniform(0.0, 2.0 * math.pi)
        self.mean = spec.current_m_s * np.array([math.cos(angle), math.sin(angle), 0.0])
        self.start = spec.gust_m_s * (
            math.sqrt(t1 / (t1 + t2)) * self._unit + math.sqrt(t2 / (t1 + t2)) * rng.standard_normal(3)
        )

    def step(self) -> np.ndarray:
        """(3,) where the gust tends during the next tick, m/s."""
        self._unit = self._keep * self._unit + math.sqrt(1.0 - self._keep**2) * self._rng.standard_normal(3)
        return self._sigma * self._unit


@njit(types.void(WATER, types.float64, F1, F1), cache=True)
def flow_at(water, since_s, velocity, acceleration):
    """Writes velocity and acceleration (3,) of the water, world frame, `since_s` after `water.flow` was set."""
    decay = math.exp(-since_s / water.smoothing_s)
    for i in range(3):
        mean, now, target = water.flow[0, i], water.flow[1, i], water.flow[2, i]
        gust = target + (now - target) * decay
        velocity[i] = mean + gust
        acceleration[i] = (target - gust) / water.smoothing_s


@njit(types.void(WATER, F1, F1, F1), cache=True)
def push_of_walls(water, p, v, f):
    """Writes the force (3,) of walls, bottom and surface on one corner at p with velocity v, world frame.

    Above the surface the hull loses buoyancy: the caller adds that by `surface_stiffness`, since it depends on the hull.
    """
    f[0] = f[1] = f[2] = 0.0
    if water.is_box:
        for i in range(2):
            side = 1.0 if p[i] > 0.0 else -1.0
            _push(water, side * p[i] - water.extent[i], i, side, -1, 0.0, v, f)
    else:
        r = math.hypot(p[0], p[1])
        if r > water.extent[0]:
            _push(water, r - water.extent[0], 0, p[0] / r, 1, p[1] / r, v, f)
    _push(water, p[2] - water.extent[2], 2, 1.0, -1, 0.0, v, f)


@njit(types.void(WATER, types.float64, types.int64, types.float64, types.int64, types.float64, F1, F1), cache=True)
def _push(water, deep, i, ni, j, nj, v, f):
    """Adds the force of one wall, `deep` metres into it, to f; its outward normal has ni on axis i and nj on axis j."""
    if deep <= 0.0:
        return
    n0 = ni if i == 0 else 0.0
    n1 = ni if i == 1 else (nj if j == 1 else 0.0)
    n2 = ni if i == 2 else 0.0
    into = v[0] * n0 + v[1] * n1 + v[2] * n2
    normal = max(0.0, water.stiffness * deep + water.damping * into)
    t0, t1, t2 = v[0] - into * n0, v[1] - into * n1, v[2] - into * n2
    speed = math.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
    rub = min(water.damping, FRICTION * normal / speed) if speed > 1e-9 else 0.0
    f[0] -= normal * n0 + rub * t0
    f[1] -= normal * n1 + rub * t1
    f[2] -= normal * n2 + rub * t2
