"""Random, mutated, forged and replayed packets against a ground side, for tests/unit/test_ground_attack.py.

A quarter each: noise; frames with flipped bits; frames cut, joined and repeated; random payloads with a valid checksum.
"""

import math

import numpy as np

from firmware_py.core.types import Action, Mode, Request
from firmware_py.description.parameters import invalid
from firmware_py.ground.dialect import load_dialect
from firmware_py.ground.signing import Signing, units_of
from firmware_py.ground.wire import checksum
from tests.unit.ground_world import Client, World

KEY = bytes(range(1, 33))
NOW = units_of(1_800_000_000 * 1_000_000_000)
MESSAGES_A_TICK = 50


def samples(client: Client) -> list[bytes]:
    """Valid frames of every kind that has an effect."""
    nan = float("nan")
    frames = [client.pack("COMMAND_LONG", 1, 1, number, 0, *p) for number, p in COMMANDS.items()]
    frames += [
        client.pack("HEARTBEAT", 6, 8, 0, 0, 4, 3),
        client.pack("PARAM_SET", 1, 1, b"POS_BW", 3.0, 9),
        client.pack("MANUAL_CONTROL", 1, 500, 0, 500, 0, 1),
        client.pack("SET_POSITION_TARGET_LOCAL_NED", 0, 1, 1, 1, 0xDF8, 0.1, 0.1, 0.4, 0, 0, 0, 0, 0, 0, 0, 0),
        client.pack("MISSION_COUNT", 1, 1, 2, 0),
        client.pack("MISSION_ITEM_INT", 1, 1, 0, 6, 16, 0, 1, 0, 0, 0, nan, 302084010, 1201614010, -0.4, 0),
        client.pack("MISSION_ITEM_INT", 1, 1, 1, 6, 16, 0, 1, 0, 0, 0, nan, 302084020, 1201614000, -0.3, 0),
        client.pack("SET_MODE", 1, 1, 65536),
    ]
    return frames


COMMANDS: dict[int, tuple[float, ...]] = {
    400: (1, 0, 0, 0, 0, 0, 0), 176: (1, 1, 0, 0, 0, 0, 0), 185: (1, 0, 0, 0, 0, 0, 0), 246: (1, 0, 0, 0, 0, 0, 0),
    209: (1, 0, 20, 1, 0, 0, 0), 31010: (0, 0, 1, 1, 0, 0, 0), 300: (0, 0, 0, 0, 0, 0, 0),
    511: (30, 1e4, 0, 0, 0, 0, 0),
}  # fmt: skip


def is_sound(request: Request) -> bool:
    """Whether a request is one that a well-meaning client could make."""
    argument = request.argument
    if request.action == Action.STICKS:
        return all(-1 <= v <= 1 for v in (*argument.force, *argument.moment))
    if request.action == Action.SET_POINT:
        return all(bool(np.all(np.isfinite(v))) for v in argument)
    if request.action == Action.SET_MODE:
        return isinstance(argument, Mode)
    if request.action == Action.SET_PARAMETER:
        return math.isfinite(argument[1])
    if request.action == Action.MOTOR_TEST:
        return -1 <= argument[1] <= 1 and 0 <= argument[2] <= 10
    return True


class Attack:
    """Sends packets and checks their effects."""

    def __init__(self, seed: int) -> None:
        self.world = World(modules=2)
        self.client = self.world.client()
        self._rng = np.random.default_rng(seed)
        self._samples = samples(self.client)
        self._definitions = list(load_dialect().by_number.values())
        self.packets = 0
        self.crafted = 0

    def run(self, count: int) -> None:
        """Sends `count` packets. Raises AssertionError if one has an effect that it must not have."""
        kinds = (self._noise, self._flipped, self._cut, self._crafted)
        while self.packets < count:
            kind = kinds[self.packets % len(kinds)]
            self._send(kind(), may_act=kind in (self._cut, self._crafted))
            self.packets += 1
            if self.packets % MESSAGES_A_TICK == 0:
                self._tick()

    def _send(self, data: bytes, may_act: bool) -> None:
        station = self.world.station
        good = station.counts["good"]
        before = self._state() if not may_act else None
        station.take(0, data, self.world.time_ns, datagram=True)
        if not may_act and station.counts["good"] == good:
            assert self._state() == before, data.hex()

    def _state(self) -> tuple[object, ...]:
        services = self.world.station.services.values()
        return (
            id(self.world.station.store.values),
            tuple(len(s.system.requests) for s in services),
            tuple(id(s.flight.items) for s in services),
            tuple(s.commands.reboot_asked for s in services),
        )

    def _tick(self) -> None:
        requests = self.world.station.requests()
        assert all(is_sound(request) for request in requests), [r for r in requests if not is_sound(r)]
        assert not invalid(self.world.station.store.values)
        self.world.station.jobs()
        inputs, outputs = self.world.robot.step(requests)
        self.world.robot.asked.clear()
        self.world.station.observe(inputs, outputs, self.world.robot.bodies)
        self.world.station.frames(outputs.time_ns)

    def _noise(self) -> bytes:
        data = self._rng.bytes(int(self._rng.integers(1, 300)))
        return b"\xfd" + data if self._rng.random() < 0.5 else data

    def _flipped(self) -> bytes:
        frame = bytearray(self._pick())
        for _ in range(int(self._rng.integers(1, 4))):
            bit = int(self._rng.integers(8 * len(frame)))
            frame[bit // 8] ^= 1 << bit % 8
        return bytes(frame)

    def _cut(self) -> bytes:
        a, b = self._pick(), self._pick()
        return a[: int(self._rng.integers(len(a)))] + b * int(self._rng.integers(1, 3))

    def _crafted(self) -> bytes:
        """Returns a frame with a valid checksum and random content."""
        definition = self._definitions[int(self._rng.integers(len(self._definitions)))]
        payload = bytearray(self._rng.bytes(int(self._rng.integers(1, 256))))
        for name in ("target_system", "target_component", "target"):
            self._aim(definition, payload, name)
        head = bytes([0xFD, len(payload), 0, 0, 0, 255, 190]) + definition.number.to_bytes(3, "little")
        frame = head + payload
        return frame + checksum(frame[1:], definition.crc_extra).to_bytes(2, "little")

    def _aim(self, definition, payload: bytearray, name: str) -> None:  # type: ignore[no-untyped-def]
        at = 0
        sizes = {"b": 1, "B": 1, "s": 1, "h": 2, "H": 2, "i": 4, "I": 4, "f": 4, "q": 8, "Q": 8, "d": 8}
        for field in definition.fields:
            if field.name == name and at < len(payload):
                payload[at] = 1
            at += sizes[field.letter] * max(field.length, 1)

    def _pick(self) -> bytes:
        return self._samples[int(self._rng.integers(len(self._samples)))]


def forge(count: int, seed: int) -> tuple[World, Client, int]:
    """Sends `count` forged and replayed packets on a signed link. Returns world, genuine client, and how many packets were accepted."""
    signing = Signing(key=KEY, timestamp=NOW)
    world = World(signing=signing)
    real = world.client()
    real.mav.signing.secret_key, real.mav.signing.timestamp, real.mav.signing.sign_outgoing = KEY, NOW, True
    rng = np.random.default_rng(seed)
    forger = world.client()
    overheard = samples(real)
    for frame in overheard:
        real.send_raw(frame)
    world.run(5)
    world.robot.asked.clear()
    good = world.station.counts["good"]
    for n in range(count):
        forger.send_raw(_forged(n, rng, overheard, forger, NOW + 10**9))
        if n % 1000 == 0:
            world.run(1)
    assert not world.robot.asked
    return world, real, world.station.counts["good"] - good


def _forged(n: int, rng: np.random.Generator, overheard: list[bytes], forger: Client, stamp: int) -> bytes:
    frame = bytearray(overheard[int(rng.integers(len(overheard)))])
    kind = n % 4
    if kind == 0:
        return bytes(frame)  # replayed as it was
    if kind == 1:  # a later time stamp under the old signature
        frame[-12:-6] = int(stamp + n).to_bytes(6, "little")
        return bytes(frame)
    if kind == 2:  # a random signature
        frame[-12:-6] = int(stamp + n).to_bytes(6, "little")
        frame[-6:] = rng.bytes(6)
        return bytes(frame)
    forger.mav.signing.sign_outgoing = bool(n & 4)  # a random key, or unsigned
    forger.mav.signing.secret_key, forger.mav.signing.timestamp = rng.bytes(32), stamp + n
    return forger.pack("COMMAND_LONG", 1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
