"""The simulated CAN nodes of a bus, MCUs, tag camera and e-stop box, between its frames and the world.

Per tick, the world advances one period and the received frames are processed in order. This code is independent of the controller.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Protocol

from firmware_py.bus.codec import Codec, Frame, Receiver
from firmware_py.bus.codec.receiver import KINDS, MESSAGE, NUMBER, VALUES
from firmware_py.description.schema import DescriptionError
from hil.mcu import ERROR_BITS, VERSION, Mcu
from hil.plant.camera import Camera
from hil.plant.spec import SensorSpec
from hil.plant.world import World
from hil.scenario import Scenario
from hil.tag_camera import TagCamera

BOX_NUMBER, NODE_OK = 30, 1
"""Number of the e-stop box, and NodeState OK of its HEARTBEAT."""
ESTOP_PERIOD_NS = 50_000_000


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
