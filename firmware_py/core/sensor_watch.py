"""Removes implausible samples: those of a frozen IMU or pressure sensor, and readings that leap. Runs before stage 1 of a tick.

A live sensor's noise never repeats itself for long. Gyro and accelerometer are judged each by itself, and so is each of their axes: a gyro
that reads zeros beside a live accelerometer would make the robot tumble. If either is stuck, neither is believed: without the IMU the body
flies on by tags, depth and its model. A reading far from the one before counts as a transmission error unless the next one confirms it: no
thruster moves a body so suddenly, and a real blow costs one sample.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit

from firmware_py.core.rotations import V
from firmware_py.core.types import ModuleInputs

IMU_REPEATS, SENSOR_REPEATS, AXIS_REPEATS = 10, 20, 70
"""Repetitions in a row that mark an IMU as stuck: of all six numbers, of the three of gyro or accelerometer, of one number. The stillest
sensor has half a count of noise about the middle of a count (docs/mcu.md): one number repeats itself with a probability of 0.68. Such a
module is then wrongly distrusted 0.015, 0.07 and 0.005 times in 1000 hours at 400 Hz; with 18 and 56 it would be once."""
DEPTH_REPEATS = 100
"""The same for pressure, two seconds of DEPTH frames: a live sensor has tens of pascals of noise, and the frames resolve single pascals."""
LEAPS = {"gyro": 1.0, "accel": 2.0, "pressure_pa": 2000.0}
"""Largest plausible change between samples, rad/s, m/s^2, Pa. A module's full moment, 3.2 N m on 0.088 kg m^2, adds 0.7 rad/s in a tick at
50 Hz; its force, 40 N on 15.5 kg, has a lag of 80 ms: reversed, 1.2 m/s^2 in that tick. Twenty centimetres of water are 2000 Pa."""
FROZEN = {"gyro": None, "accel": None}
"""Replacement fields for the samples of a stuck IMU."""
NOTHING = np.full(3, np.nan)
Trace = tuple[np.ndarray, np.ndarray]
"""The last accepted sample (k,), and the rejected one that followed it; NaN where there is none."""


class SensorWatch:
    """Watches the sensors of one body's modules.

    Attributes:
        imu_heard, pressure_heard: whether any IMU, or any pressure sensor, gave a plausible sample in this tick.
    """

    def __init__(self, modules: Sequence[int]) -> None:
        self._watches = {module: _ModuleWatch() for module in modules}
        self.imu_heard = self.pressure_heard = False

    def take_over(self, before: Sequence[SensorWatch]) -> None:
        """Takes over the watches of the body's modules from the previous bodies."""
        for other in before:
            self._watches |= {module: watch for module, watch in other._watches.items() if module in self._watches}

    def step(self, modules: Sequence[ModuleInputs]) -> Sequence[ModuleInputs]:
        """The inputs of the fleet, by fleet index, without the implausible samples of this body's modules."""
        believed = list(modules)
        self.imu_heard = self.pressure_heard = False
        for index, watch in self._watches.items():
            module = believed[index] = watch.step(modules[index])
            self.imu_heard = self.imu_heard or (module.gyro is not None and module.accel is not None)
            self.pressure_heard = self.pressure_heard or module.pressure_pa is not None
        return believed


class _ModuleWatch:
    """Watches the sensors of one module, whichever body it is in."""

    def __init__(self) -> None:
        self._imu, self._imu_repeats = np.full(6, np.nan), np.zeros(6, dtype=np.int64)
        """Last numbers of gyro and accelerometer, and how often each has been repeated; unchanged while none comes."""
        self._last_pa, self._pressure_repeats = math.nan, 0
        self._traces: dict[str, Trace] = {}

    def step(self, module: ModuleInputs) -> ModuleInputs:
        """The module's inputs without implausible samples."""
        gyro, accel = (NOTHING if sample is None else sample for sample in (module.gyro, module.accel))
        gone: dict[str, Any] = {name: None for name in LEAPS if self._leaps(name, getattr(module, name))}
        if is_stuck(gyro, accel, self._imu, self._imu_repeats):
            gone |= FROZEN
        if module.pressure_pa is not None and self._pressure_repeats_itself(module.pressure_pa):
            gone["pressure_pa"] = None
        return dataclasses.replace(module, **gone) if gone else module

    def _pressure_repeats_itself(self, pressure_pa: float) -> bool:
        self._pressure_repeats = self._pressure_repeats + 1 if pressure_pa == self._last_pa else 0
        self._last_pa = pressure_pa
        return self._pressure_repeats >= DEPTH_REPEATS

    def _leaps(self, name: str, reading: np.ndarray | float | None) -> bool:
        """Whether a reading is far from the last accepted one, and also from a rejected one that followed it."""
        if reading is None:
            return False
        sample = reading if isinstance(reading, np.ndarray) else np.array([reading])
        sound, odd = self._traces.get(name, (sample, NOTHING))
        is_odd = not (is_near(sample, sound, LEAPS[name]) or is_near(sample, odd, LEAPS[name]))
        self._traces[name] = (sound, sample) if is_odd else (sample, NOTHING)
        return is_odd


@njit(f"boolean({V},{V},float64)", cache=True)
def is_near(a, b, reach):  # type: ignore[no-untyped-def]
    """Whether every number of `a` (k,) is within `reach` of that of `b`; false if any is NaN."""
    near = True
    for i in range(a.size):
        near = near and abs(a[i] - b[i]) <= reach
    return near


@njit(f"boolean({V},{V},{V},int64[::1])", cache=True)
def is_stuck(gyro, accel, last, repeats):  # type: ignore[no-untyped-def]
    """Whether a gyro or an accelerometer has repeated itself too often; takes their new samples into account.

    Args:
        gyro, accel: (3,) new samples, rad/s and m/s^2; NaN where none came.
        last, repeats: (6,) last numbers of both, and how often each was repeated; updated.
    """
    for i in range(6):
        number = gyro[i] if i < 3 else accel[i - 3]
        if not math.isnan(number):
            repeats[i] = repeats[i] + 1 if number == last[i] else 0
            last[i] = number
    of_gyro, of_accel = repeats[:3].min(), repeats[3:].min()
    of_one, of_all = repeats.max(), min(of_gyro, of_accel)
    return of_one >= AXIS_REPEATS or max(of_gyro, of_accel) >= SENSOR_REPEATS or of_all >= IMU_REPEATS
