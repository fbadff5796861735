"""One MAVLink system, which is one body: the state that its services (commands, parameters, missions ...) share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from firmware_py.core.types import WARNING, Action, Request
from firmware_py.ground.dialect import Message
from firmware_py.ground.outbox import Outbox, Rates
from firmware_py.ground.subject import Subject
from firmware_py.ground.telemetry import DEFAULT_HZ, STREAMS

NS_PER_S = 1_000_000_000
_TEXT = 50
"""Characters of one STATUSTEXT."""
_SELDOM_NS = 5 * NS_PER_S
"""Least time between two refusals in text: refused messages may stream in."""
_AGAIN_NS = NS_PER_S
"""Time within which a text is not said a second time in a row: texts go to every link and never wait, and a client may ask in a loop for
what is refused.
"""
NEVER_WAITS = ("HEARTBEAT", "STATUSTEXT")
"""Messages sent even to busy channels: without HEARTBEAT clients lose the vehicle, and STATUSTEXT is sent only once."""
_SEND_ON_CHANGE = ("HEARTBEAT", "MISSION_CURRENT")
"""Messages sent as soon as they change. HEARTBEAT shows a pilot arming, modes and stops; MISSION_CURRENT tells a client that the mission
it uploaded has arrived, and where it begins.
"""
STOPPING = frozenset({Action.ESTOP, Action.DISARM})
"""Actions that reach a module whichever body it is part of."""
TASK_CHANGING_ACTIONS = STOPPING | {Action.SET_MODE, Action.HOLD, Action.DOCK, Action.UNDOCK, Action.MOTOR_TEST}
"""Actions that give the body another task."""


class Arrival(NamedTuple):
    """A message for this system."""

    message: Message
    channel: int
    time_ns: int
    trusted: bool
    """Whether the link may set the signing key."""

    @property
    def sender(self) -> dict[str, int]:
        """The sender as the target fields of an answer."""
        return {"target_system": self.message.system, "target_component": self.message.component}


Handler = Callable[[Arrival], None]


@dataclass(slots=True)
class System:
    """A body as clients see it."""

    subject: Subject
    outbox: Outbox
    busy: set[int] = field(default_factory=set)
    """Channels under back-pressure: messages that can wait are not sent to them now. One set for all systems."""
    channels: dict[int, Rates] = field(default_factory=dict)
    """Present channels with their message rates."""
    requests: list[Request] = field(default_factory=list)
    """Requests for the next tick."""
    task_changes: int = 0
    """Number of TASK_CHANGING_ACTIONS requested so far: a change means that the body was given another task."""
    _text_number: int = 0
    _last_text: tuple[str, int] = "", 0
    """The text said last, and when."""
    _said: dict[str, Any] = field(default_factory=dict)
    """Last values of each message of `_SEND_ON_CHANGE`."""
    _refused_ns: int = -_SELDOM_NS

    @property
    def body(self) -> int:
        """Number of the body."""
        return self.subject.body

    @property
    def body_is_known(self) -> bool:
        """Whether the last tick reported the body."""
        return self.body in self.subject.picture.records

    def add_channel(self, channel: int, time_ns: int) -> None:
        """Adds a channel with the default rates, unless it is there already."""
        if channel not in self.channels:
            intervals = {name: round(NS_PER_S / hz) for name, hz in DEFAULT_HZ.items()}
            self.channels[channel] = Rates(intervals, time_ns)

    def remove_channel(self, channel: int) -> None:
        """Removes a channel that is gone."""
        self.channels.pop(channel, None)
        self.outbox.forget(channel)

    def ask(self, action: Action, argument: Any = None) -> None:
        """Adds a request for the next tick; those that stop go to the body that contains this body's own module."""
        self.task_changes += action in TASK_CHANGING_ACTIONS
        body = self.subject.leader if action in STOPPING else self.body
        self.requests.append(Request(action, body, argument))

    def refuse(self, time_ns: int, why: str = "") -> None:
        """Reports why the body is not steered: `why`, or which system leads it if it is gone. Rate-limited, since messages stream in."""
        if time_ns - self._refused_ns < _SELDOM_NS:
            return
        self._refused_ns = time_ns
        own, leader = self.outbox.system, self.outbox.system - self.body + self.subject.leader
        gone = f"docked, system {leader} leads it now" if leader != own else "no tick has told of its body"
        self.say(WARNING, f"system {own} is not steered: {why or gone}")

    def is_ambiguous_broadcast(self, arrival: Arrival) -> bool:
        """Whether a message addresses all systems while there are several bodies, all of which it would steer to one place."""
        return arrival.message["target_system"] == 0 and len(self.subject.picture.records) > 1

    def send(self, channel: int, name: str, values: Mapping[str, Any]) -> None:
        """Sends a message to one channel. If the channel is gone, the message is dropped and leaves no state behind."""
        if channel in self.channels:
            self.outbox.send(channel, name, values)

    def broadcast(self, name: str, values: Mapping[str, Any]) -> None:
        """Sends a message to all channels."""
        for channel in self.channels:
            self.outbox.send(channel, name, values)

    def say(self, severity: int, text: str) -> None:
        """Broadcasts a STATUSTEXT; long texts are sent in chunks. Leaves out one that was said just before."""
        now_ns = self.subject.picture.time_ns
        if text == self._last_text[0] and now_ns - self._last_text[1] < _AGAIN_NS:
            return
        self._last_text = text, now_ns
        pieces = [text[i : i + _TEXT] for i in range(0, len(text), _TEXT)] or [""]
        self._text_number = self._text_number % 0xFFFF + 1
        number = self._text_number if len(pieces) > 1 else 0
        if number and len(pieces[-1]) == _TEXT:
            pieces.append("")  # a chunk that is not full marks the last one
        for i, piece in enumerate(pieces):
            self.broadcast("STATUSTEXT", {"severity": severity, "text": piece, "id": number, "chunk_seq": i})

    def stream(self, time_ns: int) -> None:
        """Sends the messages due on every channel; each is built once. A slow link gets fewer of every kind, but all heartbeats.

        A message of `_SEND_ON_CHANGE` is due at once when its values change.
        """
        for name in _SEND_ON_CHANGE:
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
