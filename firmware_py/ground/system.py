"""One MAVLink system: one body. What its services (commands, parameters, missions ...) share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from firmware_py.core.types import WARNING, Action, Request
from firmware_py.ground.dialect import Message
from firmware_py.ground.outbox import Outbox, Rates
from firmware_py.ground.telemetry import DEFAULT_HZ, STREAMS, Subject

NS_PER_S = 1_000_000_000
_TEXT = 50
"""Characters of one STATUSTEXT."""
_SELDOM_NS = 5 * NS_PER_S
"""Between two texts about what streams in."""
NEVER_WAITS = ("HEARTBEAT", "STATUSTEXT")
"""Without the one clients lose the vehicle; the other is said once."""
_AT_ONCE = ("HEARTBEAT", "MISSION_CURRENT")
"""What is told as soon as it changes. A pilot sees arming, modes and stops in the one; a client that has sent a mission knows by the other
that it is there, and where it begins.
"""
STOPPING = frozenset({Action.ESTOP, Action.DISARM})
"""What reaches a module whichever body it is part of."""
STEERING = STOPPING | {Action.SET_MODE, Action.HOLD, Action.DOCK, Action.UNDOCK, Action.MOTOR_TEST}
"""By which somebody takes the body for something else."""


class Arrival(NamedTuple):
    """A message for this system."""

    message: Message
    channel: int
    time_ns: int
    trusted: bool
    """Its link may set the key."""

    @property
    def sender(self) -> dict[str, int]:
        """As the target of an answer."""
        return {"target_system": self.message.system, "target_component": self.message.component}


Handler = Callable[[Arrival], None]


@dataclass(slots=True)
class System:
    """A body as clients see it."""

    subject: Subject
    outbox: Outbox
    busy: set[int] = field(default_factory=set)
    """Channels that take their time: what can wait is not sent to them now. One set for all systems."""
    channels: dict[int, Rates] = field(default_factory=dict)
    """Everybody who is there, with the rates that they want."""
    requests: list[Request] = field(default_factory=list)
    """For the next tick."""
    taken: int = 0
    """How often somebody asked the body for something else than what it does."""
    _text_number: int = 0
    _said: dict[str, Any] = field(default_factory=dict)
    """What the last of each of `_AT_ONCE` said."""
    _refused_ns: int = -_SELDOM_NS

    @property
    def body(self) -> int:
        """Number of the body."""
        return self.subject.body

    @property
    def body_is_known(self) -> bool:
        """Whether a tick has told of it."""
        return self.body in self.subject.picture.records

    def add_channel(self, channel: int, time_ns: int) -> None:
        """Somebody came."""
        if channel not in self.channels:
            intervals = {name: round(NS_PER_S / hz) for name, hz in DEFAULT_HZ.items()}
            self.channels[channel] = Rates(intervals, time_ns)

    def remove_channel(self, channel: int) -> None:
        """Somebody is gone."""
        self.channels.pop(channel, None)
        self.outbox.forget(channel)

    def ask(self, action: Action, argument: Any = None) -> None:
        """Put a request to the next tick."""
        self.taken += action in STEERING
        body = self.subject.leader if action in STOPPING else self.body
        self.requests.append(Request(action, body, argument))

    def refuse(self, time_ns: int, why: str = "") -> None:
        """Say why the body is not steered, or who leads it that is gone; what streams in is told of seldom."""
        if time_ns - self._refused_ns < _SELDOM_NS:
            return
        self._refused_ns = time_ns
        own, leader = self.outbox.system, self.outbox.system - self.body + self.subject.leader
        gone = f"docked, system {leader} leads it now" if leader != own else "no tick has told of its body"
        self.say(WARNING, f"system {own} is not steered: {why or gone}")

    def is_one_of_several(self, arrival: Arrival) -> bool:
        """Whether a message is for all, and this is not the one body that there is: they would be steered to one place."""
        return arrival.message["target_system"] == 0 and len(self.subject.picture.records) > 1

    def send(self, channel: int, name: str, values: Mapping[str, Any]) -> None:
        """To one channel; what is for one that is gone goes nowhere, and leaves nothing behind."""
        if channel in self.channels:
            self.outbox.send(channel, name, values)

    def broadcast(self, name: str, values: Mapping[str, Any]) -> None:
        """To everybody."""
        for channel in self.channels:
            self.outbox.send(channel, name, values)

    def say(self, severity: int, text: str) -> None:
        """STATUSTEXT to everybody; long texts go in pieces."""
        pieces = [text[i : i + _TEXT] for i in range(0, len(text), _TEXT)] or [""]
        self._text_number = self._text_number % 0xFFFF + 1
        number = self._text_number if len(pieces) > 1 else 0
        if number and len(pieces[-1]) == _TEXT:
            pieces.append("")  # by a text that is not full a client knows the last
        for i, piece in enumerate(pieces):
            self.broadcast("STATUSTEXT", {"severity": severity, "text": piece, "id": number, "chunk_seq": i})

    def stream(self, time_ns: int) -> None:
        """Send what is due on every channel; each message is made once. A slow link gets fewer of all kinds, and every heartbeat.

        Of `_AT_ONCE` one that says something new is due at once.
        """
        for name in _AT_ONCE:
            before, self._said[name] = self._said.get(name), STREAMS[name](self.subject)
            if self._said[name] != before:
                for rates in self.channels.values():
                    rates.hurry(name, time_ns)
        made: dict[str, list[bytes]] = {}
        for channel, rates in self.channels.items():
            for name in rates.due(time_ns, NEVER_WAITS if channel in self.busy else STREAMS):
                if name not in made:
                    made[name] = [self.outbox.payload(name, values) for values in self._said.get(name) or STREAMS[name](self.subject)]
                for payload in made[name]:
                    self.outbox.send_payload(channel, name, payload)
