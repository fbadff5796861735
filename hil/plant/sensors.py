"""Gyro, accelerometer and depth sensor of one module: truth plus random-walk bias plus noise. Sampled at SYNC."""

from __future__ import annotations

import math

import numpy as np
from numba import types

from hil.plant.draw import Noise, stream
from hil.plant.spec import SensorSpec, WorldSpec
from hil.plant.vectors import F1, F8, compiled
from hil.plant.world import Truth


class Channel:
    """Error of one sensor: a bias drawn once, its random walk, and white noise."""

    def __init__(self, rng: np.random.Generator, width: int, sigma: float, bias: float, walk: float) -> None:
        self._noise = Noise(rng, 2 * width)
        self._sigma, self._walk = sigma, walk
        self.bias: np.ndarray = bias * rng.standard_normal(width)
        self._then_ns = 0

    def sample(self, truth: np.ndarray, time_ns: int) -> np.ndarray:
        """(width,) the truth with its current error; advances the random walk by the time since the last sample."""
        walked = self._walk * math.sqrt(1e-9 * (time_ns - self._then_ns))
        self._then_ns = time_ns
        out = np.empty(self.bias.size)
        _sample(self._noise.take(), walked, self._sigma, self.bias, truth, out)
        return out


@compiled(types.void(F1, F8, F8, F1, F1, F1))
def _sample(draw, walked, sigma, bias, truth, out):
    """Advances `bias` (w,) by a step of standard deviation `walked`; writes `truth` (w,) with bias and noise. draw: (2 w,), variance 1."""
    width = bias.shape[0]
    for i in range(width):
        bias[i] += walked * draw[i]
        out[i] = truth[i] + (bias[i] + sigma * draw[width + i])


class Sensors:
    """Motion sensors of one module, as its MCU reads them."""

    def __init__(self, spec: SensorSpec, world: WorldSpec, seed: int, module: int) -> None:
        s = spec
        self._world = world
        self._gyro = Channel(stream(seed, "gyro", module), 3, s.gyro_sigma, s.gyro_bias, s.gyro_walk)
        self._accel = Channel(stream(seed, "accel", module), 3, s.accel_sigma, s.accel_bias, s.accel_walk)
        self._depth = Channel(stream(seed, "depth", module), 1, s.depth_sigma_m, s.depth_bias_m, s.depth_walk)

    def gyro(self, truth: Truth) -> np.ndarray:
        """(3,) angular rate, module frame, rad/s."""
        return self._gyro.sample(truth.w_b, truth.time_ns)

    def accel(self, truth: Truth) -> np.ndarray:
        """(3,) specific force at the hull centre, module frame, m/s^2: (0, 0, -g) at rest and level."""
        return self._accel.sample(truth.specific_force, truth.time_ns)

    def pressure_pa(self, truth: Truth) -> float:
        """Absolute pressure at the hull centre, Pa."""
        depth = float(self._depth.sample(truth.p_wm[2:], truth.time_ns)[0])
        return self._world.atmosphere_pa + self._world.density * self._world.gravity * depth
