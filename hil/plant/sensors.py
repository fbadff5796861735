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


class DepthSensor:
    """Pressure sensor of one module.

    Attributes:
        frozen, absent: faults: it repeats its last reading; it gives none.
    """

    def __init__(self, spec: SensorSpec, world: WorldSpec, seed: int, module: int) -> None:
        self._channel = Channel(stream(seed, "depth", module), 1, spec.depth_sigma_m, spec.depth_bias_m, spec.depth_walk)
        self._atmosphere_pa, self._pa_per_m = world.atmosphere_pa, world.density * world.gravity
        self._last_pa = math.nan
        self.repair()

    def repair(self) -> None:
        """Ends all faults."""
        self.frozen = self.absent = False
        self._offset_m = self._drift_m_s = 0.0

    def err(self, offset_m: float, drift_m_s: float, since_ns: int) -> None:
        """Adds a fault: an offset, m, that grows by `drift_m_s` from `since_ns` on. Several add up."""
        self._offset_m += offset_m - drift_m_s * since_ns * 1e-9
        self._drift_m_s += drift_m_s

    def error_m(self, time_s: float) -> float:
        """Error by the faults at a time, m."""
        return self._offset_m + self._drift_m_s * time_s

    def pressure_pa(self, truth: Truth) -> float:
        """Absolute pressure at the hull centre, Pa, as the sensor reads it."""
        depth_m = float(self._channel.sample(truth.p_wm[2:], truth.time_ns)[0]) + self.error_m(truth.time_ns * 1e-9)
        if not self.frozen or math.isnan(self._last_pa):
            self._last_pa = self._atmosphere_pa + self._pa_per_m * depth_m
        return self._last_pa


class Sensors:
    """Motion sensors of one module, as its MCU reads them.

    Attributes:
        depth: its pressure sensor.
    """

    def __init__(self, spec: SensorSpec, world: WorldSpec, seed: int, module: int) -> None:
        s = spec
        self._gyro = Channel(stream(seed, "gyro", module), 3, s.gyro_sigma, s.gyro_bias, s.gyro_walk)
        self._accel = Channel(stream(seed, "accel", module), 3, s.accel_sigma, s.accel_bias, s.accel_walk)
        self.depth = DepthSensor(s, world, seed, module)

    def gyro(self, truth: Truth) -> np.ndarray:
        """(3,) angular rate, module frame, rad/s."""
        return self._gyro.sample(truth.w_b, truth.time_ns)

    def accel(self, truth: Truth) -> np.ndarray:
        """(3,) specific force at the hull centre, module frame, m/s^2: (0, 0, -g) at rest and level."""
        return self._accel.sample(truth.specific_force, truth.time_ns)

    def pressure_pa(self, truth: Truth) -> float:
        """Absolute pressure at the hull centre, Pa."""
        return self.depth.pressure_pa(truth)
