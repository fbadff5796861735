"""Messages that one system sends: to which channel, and how often. Each channel has its own sequence numbers and rates."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any, NamedTuple

from firmware_py.ground.dialect import Dialect
from firmware_py.ground.identity import COMPONENT_AUTOPILOT
from firmware_py.ground.signing import Signing
from firmware_py.ground.wire import Encoder

_HURRY_NS = 100_000_000
"""Least time between two hurried messages of one name."""


class Outgoing(NamedTuple):
    """A frame for one channel."""

    channel: int
    frame: bytes


class Rates:
    """Schedule of the messages on one channel."""

    def __init__(self, intervals_ns: Mapping[str, int], now_ns: int) -> None:
        self.intervals_ns = dict(intervals_ns)
        self._next_ns = dict.fromkeys(intervals_ns, now_ns)
        self._sent_ns: dict[str, int] = {}

    def set(self, name: str, interval_ns: int, now_ns: int) -> None:
        """Sends `name` every `interval_ns` from now on; 0 stops it."""
        if interval_ns <= 0:
            self.intervals_ns.pop(name, None)
            self._next_ns.pop(name, None)
        else:
            self.intervals_ns[name] = interval_ns
            self._next_ns[name] = now_ns

    def hurry(self, name: str, now_ns: int) -> None:
        """Makes `name` due now, or as soon after the last one as allowed; then its interval applies as before."""
        if name in self._next_ns:
            soonest_ns = self._sent_ns.get(name, now_ns - _HURRY_NS) + _HURRY_NS
            self._next_ns[name] = min(self._next_ns[name], max(now_ns, soonest_ns))

    def due(self, now_ns: int, among: Container[str]) -> list[str]:
        """Returns the messages due now, and schedules the next; missed ones are not made up. Messages not in `among` stay due."""
        names = [name for name, next_ns in self._next_ns.items() if next_ns <= now_ns and name in among]
        for name in names:
            interval = self.intervals_ns[name]
            self._next_ns[name] += interval * ((now_ns - self._next_ns[name]) // interval + 1)
            self._sent_ns[name] = now_ns
        return names


class Outbox:
    """Encodes the messages of one system, and appends the frames to a list from which they are taken."""

    def __init__(self, dialect: Dialect, signing: Signing, system: int, frames: list[Outgoing]) -> None:
        self._dialect, self._signing = dialect, signing
        self.system = system
        self._frames = frames
        self._encoders: dict[int, Encoder] = {}

    def send(self, channel: int, name: str, values: Mapping[str, Any]) -> None:
        """Sends one message. Raises KeyError for an unknown message or field."""
        self.send_payload(channel, name, self.payload(name, values))

    def payload(self, name: str, values: Mapping[str, Any]) -> bytes:
        """Encodes a message's payload, to be sent on several channels."""
        return self._dialect.by_name[name].encode(values)

    def send_payload(self, channel: int, name: str, payload: bytes) -> None:
        """Sends one message that is already encoded."""
        encoder = self._encoders.get(channel)
        if encoder is None:
            encoder = self._encoders[channel] = Encoder(self._dialect, self._signing, self.system, COMPONENT_AUTOPILOT)
        self._frames.append(Outgoing(channel, encoder.frame(name, payload, channel)))

    def name_of(self, number: int) -> str:
        """Name of a message number; empty when there is none."""
        definition = self._dialect.by_number.get(number)
        return "" if definition is None else definition.name

    def forget(self, channel: int) -> None:
        """Forgets a channel that is gone."""
        self._encoders.pop(channel, None)
