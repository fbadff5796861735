"""Checks of a node before it believes a frame: all frames of a call in one compiled pass."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from firmware_py.bus.codec import crc
from firmware_py.bus.codec.database import Codec
from firmware_py.bus.codec.message import NO_COUNTER, NUMBERS, Frame, MessageCodec

KINDS = ("id", "number", "length", "crc", "counter", "range")
"""Reasons to drop a frame; its row of `Receiver.rows` then begins with ~index."""
MESSAGE, NUMBER, COUNTER, VALUES = range(4)
"""Columns of a row; its values begin at VALUES."""
MOST_VALUES = 8
_WIRE = struct.Struct("<iB8s").pack
_WIRE_BYTES = 13
_IDS = 2048
_CRC = np.array(crc.TABLE, dtype=np.int64)


class Received(NamedTuple):
    """A frame that passed every check."""

    message: MessageCodec
    number: int
    values: tuple[Any, ...]
    counter: int
    """0..15, or NO_COUNTER."""


class Receiver:
    """Checks the frames of one bus as one node receives them; drops invalid ones, counts them by kind, never raises.

    A frame is dropped when its id is unknown, its number not valid for the message, its length wrong, its CRC wrong,
    its counter equal to that of the last accepted frame of the same id, or a value outside the DBC's limits (such as
    raw -2048 of a thruster). Any other step of the counter is accepted, so a node that restarts is heard from its first
    or second frame on. ESTOP stops every node whatever its length.
    """

    def __init__(self, codec: Codec) -> None:
        self._messages = codec.messages
        self._ids, self._fields = _tables(codec)
        self._counters = np.full(_IDS, NO_COUNTER, dtype=np.int64)
        self._dropped = np.zeros(len(KINDS), dtype=np.int64)

    @property
    def dropped(self) -> dict[str, int]:
        """Frames dropped so far, by kind."""
        return dict(zip(KINDS, self._dropped.tolist(), strict=True))

    @property
    def dropped_in_all(self) -> int:
        """Frames dropped so far."""
        return sum(self._dropped.tolist())

    def rows(self, frames: Sequence[Frame]) -> np.ndarray:
        """(n, 3 + 8) one row for each frame: index of its message in the codec, or ~index of the kind of fault; number; counter; values.

        Values are in the order of the message's `fields`, all as floats.
        """
        wire = np.frombuffer(bytearray().join([_WIRE(can_id, len(data), data) for can_id, data in frames]), dtype=np.uint8)
        rows = np.zeros((len(frames), VALUES + MOST_VALUES))
        check(wire, self._ids, self._fields, self._counters, self._dropped, rows)
        return rows

    def judge(self, frames: Sequence[Frame]) -> list[Received | str]:
        """Returns the contents of each frame, or the kind of its fault."""
        found: list[Received | str] = []
        for row, frame in zip(self.rows(frames).tolist(), frames, strict=True):
            which = int(row[MESSAGE])
            if which < 0:
                found.append(KINDS[~which])
                continue
            message = self._messages[which]
            values = message.decode(frame.data) if len(frame.data) == message.length else ()
            found.append(Received(message, int(row[NUMBER]), values, int(row[COUNTER])))
        return found

    def accept(self, frame: Frame) -> Received | None:
        """Returns the contents of the frame, or None when it is dropped."""
        received = self.judge((frame,))[0]
        return None if isinstance(received, str) else received


def _tables(codec: Codec) -> tuple[np.ndarray, np.ndarray]:
    """(2048, 5) per id: message or ~kind, length, protected, number of values, CRC register after the id; (k, 8, 7) per field."""
    ids = np.zeros((_IDS, 5), dtype=np.int64)
    ids[:, 0] = ~KINDS.index("id")
    fields = np.zeros((len(codec.messages), MOST_VALUES, 7))
    for index, message in enumerate(codec.messages):
        for number in range(NUMBERS):
            can_id = message.function << 5 | number
            which = index if number in message.numbers else ~KINDS.index("number")
            ids[can_id] = which, message.length, message.protected, len(message.fields), crc.register_of_id(can_id)
        for place, field in enumerate(message.field_details):
            half = 1 << field.bits - 1 if field.signed else 0
            fields[index, place] = field.start, field.bits, half, field.factor, field.offset, field.raw_low, field.raw_high
    return ids, fields


@njit("void(uint8[::1],int64[:,::1],float64[:,:,::1],int64[::1],int64[::1],float64[:,::1])", cache=True)
def check(wire, ids, fields, counters, dropped, rows):  # type: ignore[no-untyped-def]
    """Fills `rows`; updates the counters of the ids (2048,) and the counts of faults (6,).

    Args:
        wire: (13 n,) for each frame its id, four bytes little endian, its length, eight bytes of data.
        ids, fields: from `_tables`.
    """
    for i in range(rows.shape[0]):
        here = wire[_WIRE_BYTES * i : _WIRE_BYTES * (i + 1)]
        can_id, size, data, row = int(here[0]) | int(here[1]) << 8, int(here[4]), here[5:], rows[i]
        row[MESSAGE], row[NUMBER], row[COUNTER] = -1, can_id & 31, NO_COUNTER
        if can_id >= _IDS or here[2] or here[3]:
            dropped[0] += 1
            continue
        which, length, protected, count, register = ids[can_id]
        fault, counter = -1, NO_COUNTER
        if which < 0:
            fault = ~which
        elif size != length:
            fault = -1 if can_id < NUMBERS else 2
            count = 0
        elif protected:
            for k in range(length):
                register = _CRC[register ^ data[k]]
            counter = int(data[length - 2]) >> 4
            if register != crc.RESIDUE:
                fault = 3
            elif counters[can_id] == counter:
                fault = 4
        if fault < 0:
            packed = np.uint64(0)
            for k in range(length):
                packed |= np.uint64(data[k]) << np.uint64(8 * k)
            for k in range(count):
                start, bits, half, factor, offset, low, high = fields[which, k]
                raw = int(packed >> np.uint64(start) & ((np.uint64(1) << np.uint64(bits)) - np.uint64(1)))
                raw = (raw ^ int(half)) - int(half)
                if raw < low or raw > high:
                    fault = 5
                row[VALUES + k] = raw * factor + offset
        if fault >= 0:
            dropped[fault] += 1
            row[MESSAGE] = ~fault
            continue
        row[MESSAGE], row[COUNTER] = which, counter
        if protected and size == length:
            counters[can_id] = counter
