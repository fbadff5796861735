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
GYRO, ACCEL, PRESSURE = MARKS = (1, 2, 4)
"""Marks of the sensors in LEAPS; of several, their sum."""
SENSORS = tuple(zip(MARKS, (0, 3, 6), (3, 6, 7), LEAPS.values(), strict=True))
"""Mark of each sensor, the first of its numbers among the seven of a module, the end of them, and its leap."""
NOTHING = np.full(3, np.nan)


class SensorWatch:
    """Watches the sensors of one body's modules.

    Attributes:
        pressure_heard: whether any pressure sensor gave a plausible sample in this tick.
    """

    def __init__(self, modules: Sequence[int]) -> None:
        self._watches = {module: _ModuleWatch() for module in modules}
        self.pressure_heard = False

    def take_over(self, before: Sequence[SensorWatch]) -> None:
        """Takes over the watches of the body's modules from the previous bodies."""
        for other in before:
            self._watches |= {module: watch for module, watch in other._watches.items() if module in self._watches}

    def step(self, modules: Sequence[ModuleInputs]) -> Sequence[ModuleInputs]:
        """The inputs of the fleet, by fleet index, without the implausible samples of this body's modules."""
        believed = list(modules)
        self.pressure_heard = False
        for index, watch in self._watches.items():
            module = believed[index] = watch.step(modules[index])
            self.pressure_heard = self.pressure_heard or module.pressure_pa is not None
        return believed


class _ModuleWatch:
    """Watches the sensors of one module, whichever body it is in."""

    def __init__(self) -> None:
        self._memory = (*(np.full(7, np.nan) for _ in range(3)), np.zeros(7, dtype=np.int64))
        """What `judge` remembers: its arguments from `sound` on, four arrays (7,)."""

    def step(self, module: ModuleInputs) -> ModuleInputs:
        """The module's inputs without implausible samples."""
        gyro, accel, pressure_pa = module.gyro, module.accel, module.pressure_pa
        came = GYRO * (gyro is not None) + ACCEL * (accel is not None) + PRESSURE * (pressure_pa is not None)
        wrong = judge(
            came, NOTHING if gyro is None else gyro, NOTHING if accel is None else accel,
            math.nan if pressure_pa is None else pressure_pa, *self._memory,
        )  # fmt: skip
        if not wrong:
            return module
        gone: dict[str, Any] = {name: None for name, mark in zip(LEAPS, MARKS, strict=True) if wrong & mark}
        return dataclasses.replace(module, **gone)


@njit(f"boolean({V},{V},float64)", cache=True)
def is_near(a, b, reach):  # type: ignore[no-untyped-def]
    """Whether every number of `a` (k,) is within `reach` of that of `b`; false if any is NaN."""
    near = True
    for i in range(a.size):
        near = near and abs(a[i] - b[i]) <= reach
    return near


@njit(f"boolean({V},{V},{V},float64)", cache=True)
def leaps(sample, sound, odd, reach):  # type: ignore[no-untyped-def]
    """Whether a sample (k,) is far from the last accepted one, and also from a rejected one that followed it; both are updated."""
    expected = sample if math.isnan(sound[0]) else sound
    is_odd = not (is_near(sample, expected, reach) or is_near(sample, odd, reach))
    if is_odd:
        odd[:] = sample
    else:
        sound[:], odd[:] = sample, math.nan
    return is_odd


@njit(f"int64(int64,{V},{V},float64,{V},{V},{V},int64[::1])", cache=True)
def judge(came, gyro, accel, pressure_pa, sound, odd, last, repeats):  # type: ignore[no-untyped-def]
    """Marks of the sensors of a module whose samples are not plausible.

    Args:
        came: marks of the sensors whose samples came.
        gyro, accel: (3,) new samples, rad/s and m/s^2; like `pressure_pa` NaN where none came.
        sound, odd, last, repeats: (7,) numbers of gyro, accelerometer and pressure, all updated: of the last accepted samples, of a
            rejected sample that followed, NaN where there is none, of the last samples, and how often each of these was repeated.
    """
    new = np.empty(7)
    new[:3], new[3:6], new[6] = gyro, accel, pressure_pa
    wrong = 0
    for mark, first, end, reach in SENSORS:
        if came & mark and leaps(new[first:end], sound[first:end], odd[first:end], reach):
            wrong |= mark
    for i in range(7):
        if not math.isnan(new[i]):
            repeats[i] = repeats[i] + 1 if new[i] == last[i] else 0
            last[i] = new[i]
    of_gyro, of_accel = repeats[:3].min(), repeats[3:6].min()
    of_one, of_all = repeats[:6].max(), min(of_gyro, of_accel)
    if of_one >= AXIS_REPEATS or max(of_gyro, of_accel) >= SENSOR_REPEATS or of_all >= IMU_REPEATS:
        wrong |= GYRO | ACCEL
    if repeats[6] >= DEPTH_REPEATS:
        wrong |= PRESSURE
    return wrong
