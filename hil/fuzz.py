"""Bad frames fed to a robot in flight: flipped bits, wrong lengths, random ids, repeated frames, and valid frames with false content."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from firmware_py.app.firmware import compose
from firmware_py.bus.codec import Codec, Frame, MessageCodec, Receiver
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Mode, Outputs, Request, Sticks
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import Vehicle
from hil.bench import fleet_of
from hil.nodes import make_nodes
from hil.plant.draw import stream
from hil.scenario import load_scenario, make_world
from hil.task import MODES

STOPPING = 0.0002
"""Share of frames with the ids of ESTOP and SYNC. Small, because these stop the robot."""
LOWEST_OTHER_ID = 0x040
A_TICK = 100
ARM_EVERY, CLEAR_EVERY = 20, 30
"""Ticks between a pilot's requests: another mode with forced arming, and the release of the e-stop."""


class Fuzzer:
    """Generates bad frames of all kinds from a seed."""

    def __init__(self, codec: Codec, seed: int) -> None:
        self._rng = stream(seed, "fuzz")
        self._messages = [message for message in codec.messages if message.function << 5 >= LOWEST_OTHER_ID]
        self._stopping = [message for message in codec.messages if message.function << 5 < LOWEST_OTHER_ID]
        self._old: list[Frame] = [Frame(0x101, bytes(8))]
        self._kinds = (self._noise, self._turned, self._cut, self._again, self._lie)

    def frames(self, count: int, real: Sequence[Frame]) -> list[Frame]:
        """`count` bad frames. `real` are the genuine frames of this tick, available for corruption and repetition from now on."""
        self._old = [*self._old[-200:], *real]
        return [self._one() for _ in range(count)]

    def _one(self) -> Frame:
        if self._rng.random() < STOPPING:
            return self._random_of(self._stopping[int(self._rng.integers(len(self._stopping)))])
        return self._kinds[int(self._rng.integers(len(self._kinds)))]()

    def _noise(self) -> Frame:
        return Frame(int(self._rng.integers(LOWEST_OTHER_ID, 0x800)), self._rng.bytes(int(self._rng.integers(0, 9))))

    def _turned(self) -> Frame:
        frame = self._again()
        if not frame.data:
            return frame
        data = bytearray(frame.data)
        data[int(self._rng.integers(len(data)))] ^= 1 << int(self._rng.integers(8))
        return Frame(frame.id, bytes(data))

    def _cut(self) -> Frame:
        frame = self._again()
        length = int(self._rng.integers(0, 9))
        return Frame(frame.id, (frame.data + self._rng.bytes(8))[:length])

    def _again(self) -> Frame:
        return self._old[int(self._rng.integers(len(self._old)))]

    def _lie(self) -> Frame:
        """A frame that passes every check, with random content."""
        return self._random_of(self._messages[int(self._rng.integers(len(self._messages)))])

    def _random_of(self, message: MessageCodec) -> Frame:
        number = 1 if 1 in message.numbers and self._rng.random() < 0.8 else int(self._rng.choice(sorted(message.numbers)))
        raws = [int(self._rng.integers(low, high, endpoint=True)) for low, high in (f.raw_range for f in message.field_details)]
        return message.encode_raw(number, raws, int(self._rng.integers(16)))


@dataclass(slots=True)
class Fuzzed:
    """Counts of one fuzzed flight."""

    frames: int = 0
    """All frames fed to the firmware, fuzzed and real."""
    accepted: int = 0
    """Frames that a second receiver beside the firmware accepted: as many as `frames` less those that the firmware dropped."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Frames that the firmware dropped, by reason."""
    beyond: int = 0
    """Commands that were not finite or beyond their limits, plus ticks in which not exactly eight shares were sent."""
    armed_ticks: int = 0
    ticks: int = 0


def fuzz_flight(frames: int, seed: int = 0) -> Fuzzed:
    """Flies a hover until the firmware was fed `frames` frames, A_TICK fuzzed ones in every tick. The firmware's exceptions propagate."""
    scenario = load_scenario("hover")
    fleet = fleet_of(scenario, "virtual:fuzz")
    codec = Codec.load()
    firmware = compose(fleet, Parameters())
    world = make_world(scenario, seed, fleet.period_ns)
    nodes = make_nodes(world, codec, scenario)
    fuzzer, result, listener = Fuzzer(codec, seed), Fuzzed(), Receiver(codec)
    halves = {codec.message(name).id_of(1): codec.message(name) for name in ("THRUSTER_CMD_A", "THRUSTER_CMD_B")}
    sent: list[Frame] = []
    while result.frames < frames:
        result.ticks += 1
        tick, time_ns = result.ticks, result.ticks * fleet.period_ns
        sync = [frame for _, frame in firmware.sync(tick, time_ns)]
        real = nodes.step([*sent, *sync])
        taken = [*real, *fuzzer.frames(A_TICK, real)]
        _, outputs, out = firmware.step(tick, time_ns, [(0, frame) for frame in taken], _asked(tick))
        sent = [frame for _, frame in out]
        result.frames += len(taken)
        result.accepted += sum(listener.accept(frame) is not None for frame in taken)
        result.beyond += _beyond(outputs, sent, halves, world.vehicles[0])
        result.armed_ticks += outputs.records[0].state == State.ARMED
    result.dropped = firmware.collector.dropped
    return result


def _asked(tick: int) -> list[Request]:
    asked = [Request(Action.CLEAR_ESTOP)] if tick % CLEAR_EVERY == 0 else []
    if tick % ARM_EVERY == 0:
        mode = Mode[MODES[tick // ARM_EVERY % len(MODES)]]
        asked += [Request(Action.STICKS, 0, Sticks()), Request(Action.SET_MODE, 0, mode), Request(Action.ARM, 0, True)]
    return asked


def _beyond(outputs: Outputs, sent: Sequence[Frame], halves: dict[int, MessageCodec], vehicle: Vehicle) -> int:
    """Number of invalid commands in one tick: forces, shares, and shares in the frames sent."""
    force, command = outputs.records[0].commanded_n, outputs.modules[0].thrusters
    wrong = int(np.sum(~np.isfinite(force) | (force > vehicle.force_max_n) | (force < vehicle.force_min_n)))
    wrong += int(np.sum(~np.isfinite(command) | (np.abs(command) > 1.0)))
    shares = [value for frame in sent if frame.id in halves for value in halves[frame.id].decode(frame.data)[:4]]
    return wrong + sum(not -1.0 <= share <= 1.0 for share in shares) + (len(shares) != 8)
