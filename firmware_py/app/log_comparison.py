"""Finds the first signal, or the first bit of a frame, in which a replayed tick differs from the recorded one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from firmware_py.bus.codec import Codec
from firmware_py.runtime.flight_log import LoggedTick, parts_of, shown
from firmware_py.runtime.tick_messages import Message

SMALL = 1e-3
"""Absolute tolerance over relative tolerance: numbers below this may differ by the tolerance times it."""


class Difference(NamedTuple):
    """One signal whose replayed value differs from the recorded one."""

    tick: int
    time_ns: int
    signal: str
    recorded: str
    replayed: str

    def __str__(self) -> str:
        return f"tick {self.tick}, {self.time_ns * 1e-9:.3f} s: {self.signal}: recorded {self.recorded}, replayed {self.replayed}"


Found = tuple[str, str, str]
"""Signal, recorded value, replayed value."""


class Comparison:
    """Compares byte by byte; with a tolerance, numbers may differ by that relative amount, and signals in frames by one count."""

    def __init__(self, codec: Codec, tolerance: float, thinned: bool) -> None:
        """`thinned`: the log lacks the messages of a body in some ticks."""
        self._codec, self._tolerance, self._thinned = codec, tolerance, thinned

    def first(self, logged: LoggedTick, messages: Sequence[Message], lines: Sequence[str]) -> Difference | None:
        """The first difference: signals in the order in which the tick computes them, then the frames that it sent."""
        found = self._in_signals(logged, messages)
        if found is None and logged.sent != lines:
            pairs = zip_longest(logged.sent, lines, fillvalue="")
            found = next((f for was, now in pairs if was != now and (f := self._in_frame(was, now))), None)
        return Difference(logged.tick, logged.time_ns, *found) if found is not None else None

    def _in_signals(self, logged: LoggedTick, messages: Sequence[Message]) -> Found | None:
        if self._thinned:
            kept = {topic for topic, _ in logged.messages}
            messages = [message for message in messages if message.topic in kept]
        for recorded, replayed in zip_longest(logged.messages, messages):
            if recorded is None:
                return replayed.topic, "nothing", "a message"
            if replayed is None or recorded[0] != replayed.topic:
                return recorded[0], "a message", "nothing" if replayed is None else f"one of {replayed.topic}"
            if recorded[1] != replayed.data and (found := self._in_message(recorded[1], replayed)):
                return found
        return None

    def _in_message(self, recorded: bytes, replayed: Message) -> Found | None:
        topic, layout, data = replayed
        try:
            before = layout.values(recorded)
        except (ValueError, DecodeError):
            return topic, f"{len(recorded)} bytes", f"{len(data)} bytes"
        for name, was, now in zip(layout.names, before, layout.values(data), strict=True):
            for place, (a, b) in enumerate(zip(np.atleast_1d(was), np.atleast_1d(now), strict=True)):
                if not self._same(a, b):
                    return f"{topic} {name}{f'[{place}]' if np.ndim(was) else ''}", _words(a), _words(b)
        if self._tolerance:
            return None
        at = next(i for i, (a, b) in enumerate(zip_longest(recorded, data)) if a != b)
        return f"{topic} from byte {at} on", shown(recorded[at:].hex()), shown(data[at:].hex())

    def _same(self, was: Any, now: Any) -> bool:
        if isinstance(was, np.floating):
            return bool(np.isclose(now, was, rtol=self._tolerance, atol=self._tolerance * SMALL, equal_nan=True))
        return bool(was == now)

    def _in_frame(self, was: str, now: str) -> Found | None:
        (where, number, before), (there, other, after) = _parts_of(was), _parts_of(now)
        message = self._codec.by_id(number)
        if (where, number, len(before)) != (there, other, len(after)) or message is None:
            return "frame", shown(was) if was else "nothing", shown(now) if now else "nothing"
        for field, one, two in zip(message.fields, message.decode_raw(before), message.decode_raw(after), strict=True):
            if abs(one - two) > (1 if self._tolerance else 0):
                return f"{where} {message.name} {field} of number {number & 31}", str(one), str(two)
        return None if self._tolerance else (f"{where} {message.name}", before.hex(), after.hex())


def _words(value: Any) -> str:
    return shown(value) if isinstance(value, str) else str(value)


def _parts_of(line: str) -> tuple[str, int, bytes]:
    """Channel, id and data of a line of can.log; for a line that is no frame, the id -1."""
    try:
        return parts_of(line)
    except ValueError:
        return "", -1, b""
