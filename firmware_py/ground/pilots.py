"""Arbitration of sticks and set-points for one system: one sender has control at a time, until it falls silent. Button states are kept
per sender: two streams do not mix.
"""

from __future__ import annotations

from collections.abc import Callable

from firmware_py.core.types import NOTICE
from firmware_py.ground.system import NS_PER_S, Arrival, System

Sender = tuple[int, int]
"""System id, component id."""


class SenderArbiter:
    """Arbitrates messages of one kind: one sender has control at a time.

    Args of the constructor:
        has: what the sender in control has, as named in messages to people.
        timeout_s: silence after which another sender may take over.
    """

    def __init__(self, system: System, has: str, timeout_s: Callable[[], float]) -> None:
        self._system, self._has, self._timeout_s = system, has, timeout_s
        self._sender: Sender | None = None
        self._refused: set[Sender] = set()
        self._heard_ns = 0

    def is_free(self, time_ns: int) -> bool:
        """Whether no sender has control."""
        return self._sender is None or time_ns - self._heard_ns > self._timeout_s() * NS_PER_S

    def claim(self, arrival: Arrival) -> bool:
        """Registers a message. Returns whether its sender has control, which it takes when no other sender has."""
        sender = sender_of(arrival)
        if sender != self._sender and not self.is_free(arrival.time_ns):
            if sender not in self._refused:
                self._say_who_has_it()
                self._refused.add(sender)
            return False
        before, self._sender, self._heard_ns = self._sender, sender, arrival.time_ns
        if before not in (None, sender):
            self._refused.clear()
            self._say_who_has_it()
        return True

    def _say_who_has_it(self) -> None:
        assert self._sender is not None
        system, component = self._sender
        self._system.say(NOTICE, f"ground station {system}/{component} has the {self._has}")


class Pilots:
    """Senders of sticks to one system.

    Args of the constructor:
        may_steer: whether sticks of a system and component are accepted at all.
        timeout_s: silence after which another sender may take the sticks.
    """

    def __init__(self, system: System, may_steer: Callable[[int, int], bool], timeout_s: Callable[[], float]) -> None:
        self._system, self._may_steer = system, may_steer
        self._arbiter = SenderArbiter(system, "sticks", timeout_s)
        self._pressed: dict[Sender, int] = {}
        self._never: set[Sender] = set()
        """Senders already told that their sticks are not accepted."""

    def are_silent(self, time_ns: int) -> bool:
        """Whether no sender has the sticks."""
        return self._arbiter.is_free(time_ns)

    def claim_sticks(self, arrival: Arrival) -> bool:
        """Registers a message with sticks. Returns whether its sender has control of them."""
        sender = sender_of(arrival)
        if self._may_steer(*sender):
            return self._arbiter.claim(arrival)
        if sender not in self._never:
            self._never.add(sender)
            self._system.say(NOTICE, f"sticks of {sender[0]}/{sender[1]} are not taken: it is not the watched ground station")
        return False

    def freshly_pressed(self, arrival: Arrival, buttons: int) -> int:
        """Returns those `buttons` that were not pressed in the sender's previous message."""
        sender = sender_of(arrival)
        fresh = buttons & ~self._pressed.get(sender, 0)
        self._pressed[sender] = buttons
        return fresh


def sender_of(arrival: Arrival) -> Sender:
    """Returns the sender of a message."""
    return arrival.message.system, arrival.message.component
