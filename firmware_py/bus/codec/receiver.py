"""What a node checks before it believes a frame."""

from __future__ import annotations

from typing import Any, NamedTuple

from firmware_py.bus.codec.database import Codec
from firmware_py.bus.codec.message import NO_COUNTER, NUMBERS, Frame, MessageCodec


class Received(NamedTuple):
    """A frame that passed every check."""

    message: MessageCodec
    number: int
    values: tuple[Any, ...]
    counter: int
    """0..15, or NO_COUNTER."""


class Receiver:
    """Checks the frames of one bus as one node hears them; drops, counts by kind, never raises.

    A frame is dropped when its id is unknown, its number not valid for the message, its length wrong, its CRC wrong,
    its counter that of the last accepted frame of the same id, or a value outside the DBC's limits (such as raw -2048
    of a thruster). Any other step of the counter is accepted, so a node that restarts is heard from its first or second
    frame on.
    """

    def __init__(self, codec: Codec) -> None:
        self.dropped: dict[str, int] = dict.fromkeys(("id", "number", "length", "crc", "counter", "range"), 0)
        self._counters: dict[int, int] = {}
        self._known: dict[int, tuple[MessageCodec, int]] = {}
        self._wrong_number: set[int] = set()
        for message in codec.messages:
            for number in range(NUMBERS):
                can_id = message.function << 5 | number
                if number in message.numbers:
                    self._known[can_id] = (message, number)
                else:
                    self._wrong_number.add(can_id)

    def accept(self, frame: Frame) -> Received | None:
        """What the frame says, or None when it is dropped."""
        can_id, data = frame
        known = self._known.get(can_id)
        if known is None:
            return self._drop("number" if can_id in self._wrong_number else "id")
        message, number = known
        if len(data) != message.length:
            # ESTOP stops everyone whatever its length.
            return Received(message, number, (), NO_COUNTER) if message.function == 0 else self._drop("length")
        counter = NO_COUNTER
        if message.protected:
            if not message.crc_ok(number, data):
                return self._drop("crc")
            counter = data[-2] >> 4
            if self._counters.get(can_id) == counter:
                return self._drop("counter")
        values = message.decode(data)
        if message.in_range is not None and not message.in_range(values):
            return self._drop("range")
        if counter >= 0:
            self._counters[can_id] = counter
        return Received(message, number, values, counter)

    def _drop(self, kind: str) -> Received | None:
        self.dropped[kind] += 1
        return None
