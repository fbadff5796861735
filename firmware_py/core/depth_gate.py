"""Checks pressure readings against what can be, and against the depth that the tags tell. Runs after `sensor_watch`, before stage 1.

The filter takes a pressure sensor to err by a few centimetres and drift slowly. One that errs by metres would overrule perfect tags: the
filter would refuse these, and the robot swim to the surface. So while tags come, a reading that is far from the estimate is not used, nor
one of a sensor that drifts away from the tags (`depth_datum`). A sensor that stays off steadily is corrected by that offset where it may
have one: weather, a lake above the sea, the datum of the tags. One that does not is distrusted, and remains so without tags: then the depth
is unknown rather than wrong.

Without tags the estimate is no judge of a sensor: a push that no model knows makes it wrong, and the sensor is right. But no body goes
farther than it can between two readings. A sensor that does is not used until it is back; the filter would explain metres within a tick by
tilt, and turn the robot over.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from firmware_py.core.body import Body
from firmware_py.core.depth_datum import DepthDatum
from firmware_py.core.rotations import to_matrix
from firmware_py.core.topology import DEPTH_BIAS_SPREAD_M
from firmware_py.core.types import NEVER_NS, BodyPose, ExpectedDepth, ModuleInputs
from firmware_py.description.water import ATMOSPHERE_PA, PA_PER_M

LEAST_PA = 60_000.0
"""Smallest pressure of a live sensor: that of the air 4200 m above the sea. Titicaca, at 3812 m, has 63 kPa."""
MOST_RATING = 1.5
"""Greatest depth that a reading may tell, as a multiple of the vehicle's depth rating; deeper, its hull would not be whole."""
GATE_SIGMAS, LEAST_GATE_M = 5.0, 0.04
"""Half width of the gate, in sigmas of the innovation, and the least. On the bench healthy sensors differ from the estimate by 33 mm at
most, in force-tracking, elsewhere by 15. With a gate of 50 mm a sensor that drifts by 20 cm/s takes the estimate along. In a body of
several modules each differs from the mean bias that the estimate knows, so that the gate is wider; in the mean of all, a reading counts
for less than within the least gate alone."""
MOST_STEP_M = 0.5
"""Largest offset that a sensor may take on in flight: five sigmas of the filter's initial depth bias."""
MOST_SPEED_M_S, DROP_SPEED_M_S = 2.0, 6.0
"""Greatest speed up or down of a body that is armed, twice that of a module at full thrust; and of one that is not, dropped from 2 m."""
PERIOD_NS, EARLY_NS = 20_000_000, 10_000_000
"""Period of a sensor's readings (can_dbc/modcube.dbc), and how much earlier one may come. Others in between are not used: the counts below,
and those of `depth_datum`, are for half a second and two; a sensor that is heard in every tick would end them within 62 and 250 ms."""
DOUBT = 25
"""Readings, half a second of DEPTH frames: so many refused ones more than accepted ones make a sensor distrusted, so many steady ones with
none near between them show an offset, and so many accepted ones make it trusted again. Half of the limit of the fail-safe `depth_lost`."""
SETTLED = 100
"""Readings, two seconds of DEPTH frames, without a jump, after which a body that does not fly believes a sensor that had jumped: after a
silence, or a false first reading, nothing else would give the depth back without tags."""
LEVEL = (0.0, 0.0, 1.0)
"""Downward unit vector of a level body."""
NEAR_SHARE = 0.5
"""Share of the gate within which a reading is near: 2.5 sigmas of the innovation, beyond which one reading in 80 is by chance. A sensor at
the edge of the gate has every other reading refused, and no near one."""


class DepthGate:
    """Judges the pressure sensors of one body's modules."""

    def __init__(self, body: Body) -> None:
        self._most_pa = 1.1 * ATMOSPHERE_PA + MOST_RATING * body.depth_rating_m * PA_PER_M
        self._sensors = {module: _Sensor() for module in body.modules}
        self._r_bi = body.r_bi
        """(m, 3) places of the sensors, in the order of `_sensors`."""
        self._spread_m = DEPTH_BIAS_SPREAD_M * math.sqrt(1.0 - 1.0 / len(body.modules))
        """Sigma of a sensor's bias less the mean of all."""

    def take_over(self, before: Sequence[DepthGate]) -> None:
        """Takes over what the previous bodies knew of the modules' sensors."""
        for other in before:
            self._sensors |= {module: sensor for module, sensor in other._sensors.items() if module in self._sensors}

    def compare(self, pictures: Sequence[BodyPose]) -> None:
        """Compares the sensors with the pictures that the filter accepted in this tick."""
        for pose in pictures:
            down = to_matrix(pose.q_wb)[2]
            depth_m = float(pose.p_wt[2] - down.dot(pose.lever_b))
            for sensor, below_m in zip(self._sensors.values(), self._r_bi.dot(down).tolist(), strict=True):
                sensor.datum.compare(pose.capture_ns, depth_m + below_m)

    def step(
        self, time_ns: int, modules: Sequence[ModuleInputs], expected: ExpectedDepth | None, armed: bool
    ) -> Sequence[ModuleInputs]:
        """Returns the inputs of the fleet, by fleet index, without the false pressures of this body, the others less their offset.

        Args:
            time_ns: time of this tick.
            expected: where the depth is to be by the estimate; None unless tags tell it.
            armed: whether the body flies; while it does not, a sensor that was trusted may take on any offset, as in another tank, and the
                body may fall into the water.
        """
        believed = list(modules)
        below_m = self._r_bi.dot(LEVEL if expected is None else expected.down_b).tolist()
        for k, (index, sensor) in enumerate(self._sensors.items()):
            pressure_pa = modules[index].pressure_pa
            if pressure_pa is None:
                continue
            is_taken = time_ns >= sensor.due_ns and LEAST_PA <= pressure_pa <= self._most_pa
            passed = is_taken and sensor.passes(time_ns, pressure_pa, expected, below_m[k], self._spread_m, armed)
            if not passed or sensor.offset_m:
                corrected_pa = pressure_pa - sensor.offset_m * PA_PER_M if passed else None
                believed[index] = dataclasses.replace(modules[index], pressure_pa=corrected_pa)
        return believed


class _Sensor:
    """What is known of one pressure sensor.

    Attributes:
        offset_m: what it tells too much beyond what the filter has learnt of it, m.
        is_distrusted: whether it is not used, with tags or without.
        was_trusted: whether it ever agreed with the tags.
        due_ns: earliest time of the next reading that is used.
    """

    def __init__(self) -> None:
        self.offset_m = 0.0
        self.is_distrusted = self.was_trusted = False
        self.datum = DepthDatum()
        self._doubt, self._steady, self._low, self._high = 0, 0, 0.0, 0.0
        self.due_ns = NEVER_NS
        self._last_m, self._last_ns, self._jumped_m = math.nan, 0, 0.0
        """Last possible reading, and how far the sensor has jumped since it last agreed with tags or came back."""
        self._unbroken, self._only_jumped = 0, False
        """Readings since it last jumped; whether a jump is all that it is distrusted for."""

    def passes(
        self, time_ns: int, pressure_pa: float, expected: ExpectedDepth | None, below_m: float, spread_m: float, armed: bool
    ) -> bool:
        """Whether a possible reading may be used.

        Args:
            below_m: how far the sensor is expected below the centre of mass.
            spread_m: sigma of what it tells beyond the mean of the body's sensors, which the estimate knows.
        """
        told_m = (pressure_pa - ATMOSPHERE_PA) / PA_PER_M
        self.hear(time_ns, told_m, MOST_SPEED_M_S if armed else DROP_SPEED_M_S)
        if expected is None:
            return self.is_continuous(armed)
        most_m = MOST_STEP_M if armed and self.was_trusted else math.inf
        gate_m = max(LEAST_GATE_M, GATE_SIGMAS * math.hypot(expected.sigma_m, spread_m))
        return self.agrees(told_m - below_m - expected.depth_m, gate_m, most_m)

    def hear(self, time_ns: int, depth_m: float, speed_m_s: float) -> None:
        """Notes a possible reading, and whether the sensor jumped to it: farther than a body goes at `speed_m_s` since the one before."""
        self.datum.hear(time_ns, depth_m)
        moved_m, most_m = depth_m - self._last_m, min(LEAST_GATE_M + speed_m_s * 1e-9 * (time_ns - self._last_ns), MOST_STEP_M)
        self._unbroken += 1
        if abs(moved_m) > most_m:
            self._unbroken = 0
            self._jumped_m += moved_m
            self._jumped_m = self._jumped_m if abs(self._jumped_m) > most_m else 0.0
        self._last_m, self._last_ns = depth_m, time_ns
        self.due_ns = max(self.due_ns, time_ns - EARLY_NS) + PERIOD_NS

    def is_continuous(self, armed: bool) -> bool:
        """Whether a reading without tags may be used: the sensor is trusted, and has not jumped, or has settled while the body rests."""
        if self._jumped_m:
            self._only_jumped = self._only_jumped or not self.is_distrusted
            self._count_doubt()
        if not armed and self._unbroken >= SETTLED:
            self._jumped_m = 0.0
            if self._only_jumped:
                self._doubt, self.is_distrusted = 0, False
        return not self.is_distrusted and not self._jumped_m

    def agrees(self, error_m: float, gate_m: float, most_m: float) -> bool:
        """Whether a reading that is off by `error_m` is within the gate and the sensor trusted. Learns an offset of at most `most_m`."""
        error_m -= self.offset_m
        if abs(error_m) > gate_m or self.datum.errs:
            self._differ(error_m, gate_m, most_m)
            return False
        self._steady = self._steady if abs(error_m) > NEAR_SHARE * gate_m else 0
        self._doubt, self._jumped_m = max(self._doubt - 1, 0), 0.0
        self.is_distrusted = self.is_distrusted and self._doubt > 0
        self.was_trusted = self.was_trusted or self._doubt == 0
        return not self.is_distrusted

    def _differ(self, error_m: float, gate_m: float, most_m: float) -> None:
        """Notes a reading outside the gate, which is doubtful, or of a sensor that drifts or follows waves, which is not yet."""
        self._only_jumped = False
        if abs(error_m) > gate_m:
            self._count_doubt()
        self._low, self._high = (min(self._low, error_m), max(self._high, error_m)) if self._steady else (error_m, error_m)
        if self._high - self._low > gate_m:
            self._steady, self._low, self._high = 0, error_m, error_m
        self._steady += 1
        middle_m = 0.5 * (self._low + self._high)
        offset_m = middle_m if abs(middle_m) > gate_m or math.isnan(self.datum.shift_m) else self.datum.shift_m
        if self._steady >= DOUBT and self.datum.is_steady and abs(offset_m) <= most_m:
            self.offset_m += offset_m
            self.datum.take_as_usual()
            self._steady, self._doubt, self._jumped_m, self.is_distrusted, self.was_trusted = 0, 0, 0.0, False, True

    def _count_doubt(self) -> None:
        self._doubt = min(self._doubt + 1, DOUBT)
        self.is_distrusted = self.is_distrusted or self._doubt == DOUBT
