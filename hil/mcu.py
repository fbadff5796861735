"""The simulated microcontroller of a module: its timeouts, e-stop, relays and sensors behind the messages of the bus.

On SYNC it applies its last accepted command, samples its sensors and answers, MCU_STATUS last. This code is independent of the controller.
"""

from __future__ import annotations

from collections.abc import Sequence

from firmware_py.bus.codec import Codec, Frame, MessageCodec
from hil.plant.draw import Noise, stream
from hil.plant.sensors import Sensors
from hil.plant.spec import SensorSpec
from hil.plant.world import Truth, World

TIMEOUT_NS = 100_000_000
"""Age beyond which a half of THRUSTER_CMD is stale and its thrusters are set to zero."""
RELEASE_NS = 200_000_000
"""Time without an ESTOP frame after which an e-stop can be released."""
PUSH_NS = 2_000_000_000
"""Age of the last DOCK_CMD beyond which pushing magnets switch off; pulling magnets hold a joint and stay on."""
OFF, REVERSE = 0, 2
"""Relay states."""
VERSION = 1
CABIN_PA = 101325.0
CABIN_C = 30.0

DISARMED, ARMED, TIMED_OUT, STOPPED = 1, 2, 3, 4
"""MCU_STATUS states."""
ERROR_BITS = {"crc": 1, "counter": 2, "length": 4}
ERROR_TIMEOUT = 8

SLOW = (
    "DEPTH", "DOCK_CURRENT_ABC", "DOCK_CURRENT_DEF", "ESC_FEEDBACK_1", "ESC_FEEDBACK_2", "ESC_FEEDBACK_3",
    "ESC_FEEDBACK_4", "POWER", "ENVIRONMENT",
)  # fmt: skip
"""Messages that are sent less often than every tick, at the cycle times of the DBC."""


class Mcu:
    """The microcontroller of one module."""

    def __init__(self, codec: Codec, number: int, module: int, world: World, spec: SensorSpec, tick_ns: int) -> None:
        self.number, self.module = number, module
        self.stopped = False
        self.timed_out = False
        self.relays: list[int] = world.docks.relays[module].tolist()
        self.errors = 0
        self._world, self._spec = world, spec
        self._sensors = Sensors(spec, world.spec, world.seed, module)
        self.depth = self._sensors.depth
        self._thrusters = len(world.vehicles[module].thruster)
        self._command = [0.0] * 8
        self._armed = [False, False]
        self._accepted_ns: list[int | None] = [None, None]
        self._applied = [0.0] * 8
        self._last_estop_ns = 0
        self._last_dock_cmd_ns = 0
        self._power = Noise(stream(world.seed, "power", module), 2)
        self._rpm = Noise(stream(world.seed, "rpm", module), 8)
        self._dock = Noise(stream(world.seed, "dock", module), 6)
        self._fast = [codec.message(name) for name in ("GYRO", "ACCEL", "MCU_STATUS")]
        self._slow = _schedule(codec, number, tick_ns)
        self.imu_frozen = self.leaks = self.readings_absent = False
        """Faults: the IMU repeats its last sample; water in the cabin; POWER and ENVIRONMENT are not sent."""
        self._motion: tuple[list[float], list[float]] | None = None
        self._counters = dict.fromkeys(SLOW, 0)

    @property
    def applied(self) -> tuple[float, ...]:
        """Commands, share of full, that the thrusters have now."""
        return tuple(self._applied)

    @property
    def accepted_ns(self) -> tuple[int | None, ...]:
        """When each half of THRUSTER_CMD was last accepted, on the plant's clock."""
        return tuple(self._accepted_ns)

    def handle(self, name: str, values: Sequence[float], time_ns: int) -> None:
        """Handles a checked message addressed to this module."""
        if name in ("THRUSTER_CMD_A", "THRUSTER_CMD_B"):
            half = 0 if name == "THRUSTER_CMD_A" else 1
            self._command[4 * half : 4 * half + 4] = values[:4]
            self._armed[half] = values[4] == 1
            self._accepted_ns[half] = time_ns
            if values[4] == 0 and time_ns - self._last_estop_ns >= RELEASE_NS:
                self.stopped = False
        elif name == "DOCK_CMD":
            self._last_dock_cmd_ns = time_ns
            barred = REVERSE if self.stopped else None
            self._switch([OFF if v == barred else int(v) for v in values[:6]])

    def estop(self, time_ns: int) -> None:
        """Handles an ESTOP frame: thrust and pushing magnets stop at once, without waiting for SYNC."""
        self.stopped = True
        self._last_estop_ns = time_ns
        self._apply([0.0] * 8)
        self._end_push()

    def watch(self, time_ns: int) -> None:
        """Runs the MCU's timeouts, independent of SYNC: zeroes each stale half of the command, and ends a push after PUSH_NS."""
        if time_ns - self._last_dock_cmd_ns > PUSH_NS:
            self._end_push()
        for half, accepted in enumerate(self._accepted_ns):
            if accepted is None or time_ns - accepted > TIMEOUT_NS:
                self._armed[half] = False
                if any(self._applied[4 * half : 4 * half + 4]):
                    self._apply([0.0 if i // 4 == half else u for i, u in enumerate(self._applied)])

    def sync(self, tick: int, time_ns: int) -> list[Frame]:
        """Applies the last accepted command, samples the sensors and returns the answers."""
        live = [a is not None and time_ns - a <= TIMEOUT_NS for a in self._accepted_ns]
        self.timed_out = not all(live)
        # A fresh half marked disarmed disarms both halves; a stale half is zeroed on its own.
        disarmed = any(fresh and not armed for fresh, armed in zip(live, self._armed, strict=True))
        allowed = [fresh and not disarmed and not self.stopped for fresh in live]
        self._apply([u if allowed[i // 4] else 0.0 for i, u in enumerate(self._command)])
        truth = self._world.truth(self.module)
        gyro, accel, status = self._fast
        sample = (self._sensors.gyro(truth).tolist(), self._sensors.accel(truth).tolist())
        if not self.imu_frozen or self._motion is None:
            self._motion = sample
        frames = [
            gyro.encode(self.number, [*self._motion[0], 0], tick),
            accel.encode(self.number, [*self._motion[1], 0], tick),
        ]
        for message, every, phase in self._slow:
            if tick % every == phase and not self._withholds(message.name):
                counter = self._counters[message.name]
                self._counters[message.name] = (counter + 1) & 15
                frames.append(message.encode(self.number, self._reading(message.name, truth), counter))
        errors = self.errors | (ERROR_TIMEOUT if self.timed_out else 0)
        self.errors = 0
        frames.append(status.encode(self.number, [tick & 0xFFFF, VERSION, errors, self._state(disarmed)], tick))
        return frames

    def _withholds(self, name: str) -> bool:
        """Whether a fault keeps the MCU from sending this slow message."""
        return self.depth.absent if name == "DEPTH" else self.readings_absent and name in ("POWER", "ENVIRONMENT")

    def _apply(self, command: list[float]) -> None:
        self._applied = command
        self._world.set_command(self.module, command[: self._thrusters])

    def _switch(self, relays: list[int]) -> None:
        self.relays = relays
        self._world.set_relays(self.module, relays)

    def _end_push(self) -> None:
        if REVERSE in self.relays:
            self._switch([OFF if relay == REVERSE else relay for relay in self.relays])

    def _state(self, disarmed: bool) -> int:
        if self.stopped:
            return STOPPED
        if self.timed_out:
            return TIMED_OUT
        return DISARMED if disarmed else ARMED

    def _reading(self, name: str, truth: Truth) -> list[float]:
        """Values of one slow message, in the order of its fields."""
        if name == "DEPTH":
            return [self._sensors.pressure_pa(truth), self._world.spec.temperature_c, 0]
        if name.startswith("DOCK_CURRENT"):
            first = 0 if name.endswith("ABC") else 3
            current = self._world.docks.current_ma()[self.module] + self._spec.dock_sigma_ma * self._dock.take()
            return [*current[first : first + 3].tolist(), *self.relays[first : first + 3]]
        if name.startswith("ESC_FEEDBACK"):
            return self._esc(2 * (int(name[-1]) - 1))
        if name == "POWER":
            noise = self._power.take() * (self._spec.voltage_sigma_v, self._spec.current_sigma_a)
            return [truth.voltage_v + float(noise[0]), truth.current_a + float(noise[1]), 0]
        if name == "ENVIRONMENT":
            return [CABIN_C, CABIN_PA, int(self.leaks)]
        raise KeyError(f"no reading for {name}")

    def _esc(self, first: int) -> list[float]:
        noise = self._spec.rpm_sigma * self._rpm.take()
        values: list[float] = []
        readings = self._world.esc(self.module)
        for i in (first, first + 1):
            if i < self._thrusters:
                rpm, current = readings[i]
                values += [float(rpm + (noise[i] if rpm else 0.0)), float(current), 0]
            else:
                values += [0.0, 0.0, 3]
        return values


def _schedule(codec: Codec, number: int, period_ns: int) -> list[tuple[MessageCodec, int, int]]:
    """(message, period in ticks, phase in ticks) of each slow message, staggered by message and module."""
    slow = []
    for index, name in enumerate(SLOW):
        message = codec.message(name)
        every = max(1, round(message.cycle_ms * 1_000_000 / period_ns))
        slow.append((message, every, (index + 3 * number) % every))
    return slow
