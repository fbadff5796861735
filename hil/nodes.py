"""The simulated CAN nodes: the MCU of each module and the tag camera, between the frames of a bus and the world.

Per tick, the world advances one period and the received frames are processed in order. On SYNC an MCU applies its last accepted
command, samples its sensors and answers, MCU_STATUS last. This code is independent of the controller.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Protocol

from firmware_py.bus.codec import Codec, Frame, MessageCodec, Receiver
from firmware_py.bus.codec.receiver import KINDS, MESSAGE, NUMBER, VALUES
from firmware_py.description.schema import DescriptionError
from hil.plant.camera import Camera
from hil.plant.draw import Noise, stream
from hil.plant.sensors import Sensors
from hil.plant.spec import SensorSpec
from hil.plant.world import Truth, World
from hil.scenario import Scenario
from hil.tag_camera import TagCamera

TIMEOUT_NS = 100_000_000
"""Age beyond which a half of THRUSTER_CMD is stale and its thrusters are set to zero."""
RELEASE_NS = 200_000_000
"""Time without an ESTOP frame after which an e-stop can be released."""
PUSH_NS = 2_000_000_000
"""Age of the last DOCK_CMD beyond which pushing magnets switch off; pulling magnets hold a joint and stay on."""
OFF, REVERSE = 0, 2
"""Relay states."""
VERSION = 1
BOX_NUMBER, NODE_OK = 30, 1
"""Number of the e-stop box, and NodeState OK of its HEARTBEAT."""
ESTOP_PERIOD_NS = 50_000_000
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


class WireFaults(Protocol):
    """Interface of the fault injection (hil.faults)."""

    def update(self, time_ns: int) -> None:
        """Begins and ends faults that are due."""

    def incoming(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Returns the frames to the plant as they arrive."""

    def outgoing(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Returns the frames from the plant as they leave."""

    def unasked(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Returns the frames that leave once per tick without a SYNC: `frames`, and those of foreign nodes."""


class NoFaults:
    """Fault injection without faults."""

    def update(self, time_ns: int) -> None:
        """Does nothing."""

    def incoming(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Returns all frames unchanged."""
        return list(frames)

    outgoing = unasked = incoming


class EstopBox:
    """The e-stop box: says that it is there, and stops everyone while it is pressed."""

    def __init__(self, codec: Codec, beats: bool) -> None:
        """Creates a box that is not pressed; `beats`: it sends HEARTBEAT."""
        heartbeat = codec.message("HEARTBEAT")
        self._heartbeat = heartbeat.encode(BOX_NUMBER, (NODE_OK, VERSION))
        self._estop = codec.message("ESTOP").encode(BOX_NUMBER)
        self._beat_ns = heartbeat.cycle_ms * 1_000_000
        self._beat_due_ns = self._estop_due_ns = 0
        self.beats = beats
        self.pressed = self.silent = False
        """Whether it is raised; a fault: it sends nothing."""

    def speak(self, time_ns: int) -> list[Frame]:
        """Returns its frames that are due, the lower CAN id first."""
        frames = []
        if self.pressed and not self.silent and time_ns >= self._estop_due_ns:
            self._estop_due_ns = time_ns + ESTOP_PERIOD_NS
            frames.append(self._estop)
        if self.beats and not self.silent and time_ns >= self._beat_due_ns:
            self._beat_due_ns = time_ns + self._beat_ns
            frames.append(self._heartbeat)
        return frames


class Nodes:
    """All nodes of one bus."""

    def __init__(
        self,
        world: World,
        codec: Codec,
        numbers: Mapping[int, int],
        sensors: SensorSpec,
        cameras: Sequence[Camera] = (),
        tick_ns: int = 0,
        box_beats: bool = False,
    ) -> None:
        """Creates all nodes at rest.

        Args:
            numbers: number on this bus -> index of the module in the world.
            tick_ns: period of SYNC; 0: the world's.
            box_beats: whether the e-stop box sends HEARTBEAT.
        """
        self.world, self.codec = world, codec
        tick_ns = tick_ns or world.period_ns
        self.receiver = Receiver(codec)
        self.mcus = {number: Mcu(codec, number, module, world, sensors, tick_ns) for number, module in numbers.items()}
        self.cameras = [TagCamera(codec, cameras, numbers, sensors, world)] if cameras else []
        self.box = EstopBox(codec, box_beats)
        self.faults: WireFaults = NoFaults()
        self._statuses = {codec.message("MCU_STATUS").id_of(number): number for number in numbers}

    def step(self, frames: Iterable[Frame]) -> list[Frame]:
        """Runs one tick of a world with this one bus: advances a period, takes the frames and returns the answers."""
        self.world.advance(self.world.period_ns)
        self.watch()
        return self.answer(frames, self.world.time_ns) + self.speak(self.world.time_ns)

    def speak(self, time_ns: int) -> list[Frame]:
        """Returns what the e-stop box and foreign nodes send in a tick, with the other nodes' answers. Call once per tick."""
        return self.faults.unasked(self.box.speak(time_ns), time_ns)

    def refuse_others(self, frames: Iterable[Frame], address: str, numbers: Container[int] | None = None) -> None:
        """Raises DescriptionError when a frame received at `address` is the MCU_STATUS of an MCU that is simulated here: one of `numbers`,
        by default of `mcus`.
        """
        simulated = self.mcus if numbers is None else numbers
        for frame in frames:
            if (number := self._statuses.get(frame.id)) is not None and number in simulated:
                who = f"somebody else answers as module {number} on {address}"
                raise DescriptionError(f"{who}: another plant, or the robot itself; end it, or take another --bus")

    def answer(self, frames: Iterable[Frame], time_ns: int) -> list[Frame]:
        """Processes the frames on the wire at `time_ns` and returns the answers, both passed through the wire's faults."""
        answers: list[Frame] = []
        arrived = self.faults.incoming(frames, time_ns)
        for frame, row in zip(arrived, self.receiver.rows(arrived).tolist(), strict=True):
            answers += self._handle_frame(frame, row, time_ns)
        return self.faults.outgoing(answers, time_ns)

    def watch(self) -> None:
        """Updates everything that needs no frame: faults, timeouts, pictures. Call after every advance of the world."""
        self.faults.update(self.world.time_ns)
        for camera in self.cameras:
            camera.watch()
        for mcu in self.mcus.values():
            mcu.watch(self.world.time_ns)

    def take(self, frame: Frame, time_ns: int) -> list[Frame]:
        """Processes one frame from the bus at `time_ns`, plant clock, and returns the answers. Bad frames are counted and dropped."""
        return self._handle_frame(frame, self.receiver.rows((frame,)).tolist()[0], time_ns)

    def _handle_frame(self, frame: Frame, row: list[float], time_ns: int) -> list[Frame]:
        """Processes one frame; `row`: the receiver's result for it."""
        which, number, values = int(row[MESSAGE]), row[NUMBER], row[VALUES:]
        if which < 0:
            self._set_error_bit(frame, KINDS[~which])
            return []
        name = self.codec.messages[which].name
        if name == "ESTOP":
            for mcu in self.mcus.values():
                mcu.estop(time_ns)
            return []
        if name == "SYNC":
            tick = int(values[0])
            answers = [f for camera in self.cameras for f in camera.sync(tick, time_ns)]
            for mcu in self.mcus.values():
                answers += mcu.sync(tick, time_ns)
            return answers
        if number in self.mcus:
            self.mcus[int(number)].handle(name, values, time_ns)
        return []

    def _set_error_bit(self, frame: Frame, kind: str) -> None:
        """Sets the error bit of a dropped frame in the status of the MCU it was addressed to."""
        mcu = self.mcus.get(frame.id & 0x1F)
        if mcu is not None:
            mcu.errors |= ERROR_BITS.get(kind, 0)


def _schedule(codec: Codec, number: int, period_ns: int) -> list[tuple[MessageCodec, int, int]]:
    """(message, period in ticks, phase in ticks) of each slow message, staggered by message and module."""
    slow = []
    for index, name in enumerate(SLOW):
        message = codec.message(name)
        every = max(1, round(message.cycle_ms * 1_000_000 / period_ns))
        slow.append((message, every, (index + 3 * number) % every))
    return slow


def make_nodes(world: World, codec: Codec, scenario: Scenario, tick_ns: int = 0) -> Nodes:
    """Creates the nodes of a scenario, all on one bus; `tick_ns` as in `Nodes`."""
    numbers = {module.number: index for index, module in enumerate(scenario.module)}
    cameras = [
        Camera(
            pose,
            scenario.sensors,
            world.vehicles,
            scenario.tags,
            world.seed,
            index,
            scenario.index_of(pose.module) if pose.module else -1,
        )
        for index, pose in enumerate(sorted(scenario.camera, key=lambda pose: pose.module > 0))  # carried cameras use the first one's phase
    ]
    return Nodes(world, codec, numbers, scenario.sensors, cameras, tick_ns, scenario.estop_box)
