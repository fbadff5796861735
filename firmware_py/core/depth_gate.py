"""Checks pressure readings against what can be, and against the depth that the tags tell. Runs after `sensor_watch`, before stage 1.

The filter takes a pressure sensor to err by a few centimetres and drift slowly. One that errs by metres would overrule perfect tags: the
filter would refuse these, and the robot swim to the surface. So while tags come, a reading that is far from the estimate is not used. A
sensor that stays there steadily is corrected by that offset where it may have one: weather, a lake above the sea, the datum of the tags.
One that does not is distrusted, and remains so without tags: then the depth is unknown rather than wrong.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from firmware_py.core.body import Body
from firmware_py.core.measurements import ATMOSPHERE_PA
from firmware_py.core.observation import GRAVITY
from firmware_py.core.types import ExpectedDepth, ModuleInputs
from firmware_py.description.water import WATER_DENSITY

PA_PER_M = WATER_DENSITY * GRAVITY
LEAST_PA = 60_000.0
"""Smallest pressure of a live sensor: that of the air 4200 m above the sea. Titicaca, at 3812 m, has 63 kPa."""
MOST_RATING = 1.5
"""Greatest depth that a reading may tell, as a multiple of the vehicle's depth rating; deeper, its hull would not be whole."""
GATE_SIGMAS, LEAST_GATE_M = 5.0, 0.04
"""Half width of the gate, in sigmas of the innovation, and the least. On the bench healthy sensors differ from the estimate by 33 mm at
most, in force-tracking, elsewhere by 15. With a gate of 50 mm a sensor that drifts by 20 cm/s takes the estimate along."""
MOST_STEP_M = 0.5
"""Largest offset that a sensor may take on in flight: five sigmas of the filter's initial depth bias."""
DOUBT = 25
"""Readings, half a second of DEPTH frames: so many refused ones more than accepted ones make a sensor distrusted, so many steady ones in a
row show an offset, and so many accepted ones make it trusted again. Half of the limit of the fail-safe `depth_lost`."""


class DepthGate:
    """Judges the pressure sensors of one body's modules.

    Attributes:
        heard: whether any pressure reading was left in this tick.
    """

    def __init__(self, body: Body) -> None:
        self._r_bi = dict(zip(body.modules, body.r_bi.tolist(), strict=True))
        self._most_pa = 1.1 * ATMOSPHERE_PA + MOST_RATING * body.depth_rating_m * PA_PER_M
        self._sensors = {module: _Sensor() for module in body.modules}
        self.heard = False

    def take_over(self, before: Sequence[DepthGate]) -> None:
        """Takes over what the previous bodies knew of the modules' sensors."""
        for other in before:
            self._sensors |= {module: sensor for module, sensor in other._sensors.items() if module in self._sensors}

    def step(self, modules: Sequence[ModuleInputs], expected: ExpectedDepth | None, armed: bool) -> Sequence[ModuleInputs]:
        """Returns the inputs of the fleet, by fleet index, without the false pressures of this body, the others less their offset.

        Args:
            expected: where the depth is to be by the estimate; None unless tags tell it.
            armed: whether the body flies; while it does not, a sensor that was trusted may take on any offset, as in another tank.
        """
        self.heard, believed = False, list(modules)
        for index, sensor in self._sensors.items():
            pressure_pa = modules[index].pressure_pa
            if pressure_pa is None:
                continue
            passed = LEAST_PA <= pressure_pa <= self._most_pa and self._passes(index, pressure_pa, expected, armed)
            self.heard = self.heard or passed
            if not passed or sensor.offset_m:
                corrected_pa = pressure_pa - sensor.offset_m * PA_PER_M if passed else None
                believed[index] = dataclasses.replace(modules[index], pressure_pa=corrected_pa)
        return believed

    def _passes(self, index: int, pressure_pa: float, expected: ExpectedDepth | None, armed: bool) -> bool:
        """Whether a possible reading may be used."""
        sensor = self._sensors[index]
        if expected is None:
            return not sensor.is_distrusted
        below_m = sum(r * down for r, down in zip(self._r_bi[index], expected.down_b, strict=True))
        error_m = (pressure_pa - ATMOSPHERE_PA) / PA_PER_M - below_m - expected.depth_m
        most_m = MOST_STEP_M if armed and sensor.was_trusted else math.inf
        return sensor.agrees(error_m, max(LEAST_GATE_M, GATE_SIGMAS * expected.sigma_m), most_m)


class _Sensor:
    """What is known of one pressure sensor.

    Attributes:
        offset_m: what it tells too much beyond what the filter has learnt of it, m.
        is_distrusted: whether it is not used, with tags or without.
        was_trusted: whether it ever agreed with the tags.
    """

    def __init__(self) -> None:
        self.offset_m = 0.0
        self.is_distrusted = self.was_trusted = False
        self._doubt, self._steady, self._low, self._high = 0, 0, 0.0, 0.0

    def agrees(self, error_m: float, gate_m: float, most_m: float) -> bool:
        """Whether a reading that is off by `error_m` is within the gate and the sensor trusted. Learns an offset of at most `most_m`."""
        error_m -= self.offset_m
        if abs(error_m) > gate_m:
            self._differ(error_m, gate_m, most_m)
            return False
        self._steady, self._doubt = 0, max(self._doubt - 1, 0)
        self.is_distrusted = self.is_distrusted and self._doubt > 0
        self.was_trusted = self.was_trusted or self._doubt == 0
        return not self.is_distrusted

    def _differ(self, error_m: float, gate_m: float, most_m: float) -> None:
        """Notes a reading outside the gate."""
        self._doubt = min(self._doubt + 1, DOUBT)
        self.is_distrusted = self.is_distrusted or self._doubt == DOUBT
        self._low, self._high = (min(self._low, error_m), max(self._high, error_m)) if self._steady else (error_m, error_m)
        if self._high - self._low > gate_m:
            self._steady, self._low, self._high = 0, error_m, error_m
        self._steady += 1
        offset_m = 0.5 * (self._low + self._high)
        if self._steady >= DOUBT and abs(offset_m) <= most_m:
            self.offset_m += offset_m
            self._steady, self._doubt, self.is_distrusted, self.was_trusted = 0, 0, False, True
