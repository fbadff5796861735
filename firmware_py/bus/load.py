"""Load of a bus, from the DBC alone: worst-case bits and rate of every frame, and the fullest tick.

Used by `tools/bus_load.py` and `modcube doctor`; `mapping` counts the frames of a flight by `bits_of`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from firmware_py.bus.codec import Codec, Frame, MessageCodec

BIT_RATE = 1_000_000
"""bit/s of every bus."""
MEAN_LIMIT = 0.5
"""Highest permitted share of a bus in use on average."""
TICK_LIMIT = 0.8
"""Highest permitted share of any one tick."""
FRAME_BITS, BYTE_BITS = 55, 10
"""A classic frame with 11-bit id and n bytes takes at most 55 + 10 n bits: 47 + 8 n with the interframe space, and a stuff bit
after each four of the 34 + 8 n that are stuffed (ISO 11898-1)."""
HEARTBEATS = 2
"""Nodes that send nothing else periodically: the firmware on a quiet bus, the e-stop box."""
NUMBER_STEP = 3
"""Ticks by which the slow frames of each module are shifted against those of the module before."""


class MessageLoad(NamedTuple):
    """Load of a bus by one message."""

    name: str
    bits: int
    frames_per_s: float
    share: float


class BusLoad(NamedTuple):
    """Load of a bus by all frames, as shares of its capacity: on average, and in the fullest tick."""

    mean: float
    fullest_tick: float
    messages: tuple[MessageLoad, ...]

    @property
    def is_allowed(self) -> bool:
        """Whether both shares are within their limits."""
        return self.mean <= MEAN_LIMIT and self.fullest_tick <= TICK_LIMIT


def frame_bits(length: int) -> int:
    """Returns the worst-case bits of a frame of `length` bytes on the wire, including the interframe space."""
    return FRAME_BITS + BYTE_BITS * length


def bits_of(frames: Sequence[Frame]) -> int:
    """Returns the same for all of these frames together."""
    return FRAME_BITS * len(frames) + BYTE_BITS * sum([len(data) for _, data in frames])


def slow_schedule(codec: Codec, number: int, rate_hz: int) -> list[tuple[MessageCodec, int, int]]:
    """Returns (message, period in ticks, phase in ticks) of a module's slow frames, staggered by message and module."""
    slow = [message for message in codec.messages if is_of_a_module(message) and not message.per_tick]
    every = [max(1, round(message.cycle_ms * rate_hz / 1000)) for message in slow]
    return [(m, n, (i + NUMBER_STEP * number) % n) for i, (m, n) in enumerate(zip(slow, every, strict=True))]


def bus_load(codec: Codec, numbers: Sequence[int], rate_hz: int) -> BusLoad:
    """Computes the load of a bus with modules `numbers` at `rate_hz` ticks a second, one tag of each module in every picture.

    The fullest tick holds the frames of every tick, the slow frames scheduled for it, and those that may come at any
    time: a picture, docking commands to all modules, an e-stop and heartbeats.
    """
    messages = []
    for message in codec.messages:
        senders = _senders(message, len(numbers))
        rate = senders * (float(rate_hz) if message.per_tick else 1000.0 / message.cycle_ms)
        bits = frame_bits(message.length)
        messages.append(MessageLoad(message.name, bits, rate, rate * bits / BIT_RATE))
    fullest = _steady_bits(codec, len(numbers), rate_hz) + _most_slow_bits(codec, numbers, rate_hz)
    return BusLoad(sum(m.share for m in messages), fullest * rate_hz / BIT_RATE, tuple(messages))


def is_of_a_module(message: MessageCodec) -> bool:
    """Whether a module's MCU sends the message: in the order of the DBC's ids GYRO and all that follow, before HEARTBEAT."""
    return 0x100 >> 5 <= message.function < 0x700 >> 5


def _senders(message: MessageCodec, modules: int) -> int:
    """Returns the number of ids on one bus that carry the message."""
    return {"ESTOP": 1, "SYNC": 1, "HEARTBEAT": HEARTBEATS}.get(message.name, modules)


def _steady_bits(codec: Codec, modules: int, rate_hz: int) -> int:
    """Bits in a tick of everything but the modules' slow frames."""
    bits = 0
    for message in codec.messages:
        if message.per_tick or not is_of_a_module(message):
            times = 1 if message.per_tick else math.ceil(1000 / (message.cycle_ms * rate_hz))
            bits += _senders(message, modules) * times * frame_bits(message.length)
    return bits


def _most_slow_bits(codec: Codec, numbers: Sequence[int], rate_hz: int) -> int:
    """Bits of the modules' slow frames in the fullest tick of the whole schedule."""
    schedule = [entry for number in numbers for entry in slow_schedule(codec, number, rate_hz)]
    ticks = math.lcm(*(every for _, every, _ in schedule)) if schedule else 1
    return max(
        sum(frame_bits(message.length) for message, every, phase in schedule if tick % every == phase)
        for tick in range(ticks)
    )
