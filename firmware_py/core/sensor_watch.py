"""Removes implausible samples: those of a frozen IMU or pressure sensor, and readings that leap. Runs before stage 1 of a tick.

A live sensor's noise never repeats itself for long; without the IMU the body flies on by tags, depth and its model. A reading far from
the one before counts as a transmission error unless the next one confirms it: no thruster moves a body so suddenly, and a real blow costs
one sample.
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

REPEATS = 10
"""Repetitions of all six numbers that mark an IMU as frozen. A quiet sensor with one count of noise does that once a day at 100 Hz."""
DEPTH_REPEATS = 100
"""The same for pressure, two seconds of DEPTH frames: a live sensor has tens of pascals of noise, and the frames resolve single pascals."""
LEAPS = {"gyro": 1.0, "accel": 2.0, "pressure_pa": 2000.0}
"""Largest plausible change between samples, rad/s, m/s^2, Pa. A module's full moment, 3.2 N m on 0.088 kg m^2, adds 0.7 rad/s in a tick at
50 Hz; its force, 40 N on 15.5 kg, has a lag of 80 ms: reversed, 1.2 m/s^2 in that tick. Twenty centimetres of water are 2000 Pa."""
FROZEN = {"gyro": None, "accel": None}
"""Replacement fields for the samples of a frozen IMU."""
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
        self._last_rate, self._last_accel = b"", np.zeros(0)
        self._repeats = 0
        """How often the last sample of the IMU has been repeated; unchanged while none comes."""
        self._last_pa, self._pressure_repeats = math.nan, 0
        self._traces: dict[str, Trace] = {}

    def step(self, module: ModuleInputs) -> ModuleInputs:
        """The module's inputs without implausible samples."""
        if module.gyro is not None and module.accel is not None:
            self._take_imu(module.gyro, module.accel)
        gone: dict[str, Any] = {name: None for name in LEAPS if self._leaps(name, getattr(module, name))}
        if self._repeats >= REPEATS:
            gone |= FROZEN
        if module.pressure_pa is not None and self._pressure_repeats_itself(module.pressure_pa):
            gone["pressure_pa"] = None
        return dataclasses.replace(module, **gone) if gone else module

    def _take_imu(self, gyro: np.ndarray, accel: np.ndarray) -> None:
        rate = gyro.tobytes()
        repeats = rate == self._last_rate and accel.tobytes() == self._last_accel.tobytes()
        self._repeats = self._repeats + 1 if repeats else 0
        self._last_rate, self._last_accel = rate, accel

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
