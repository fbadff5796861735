"""Who has the sticks of one system: one sender at a time, until it is silent. Buttons are kept by sender: two streams do not mix."""

from __future__ import annotations

from collections.abc import Callable

from firmware_py.ground.system import NS_PER_S, Arrival, System

_NOTICE = 5
Sender = tuple[int, int]
"""System id, component id."""


class Pilots:
    """Everybody who sends sticks to one system.

    Args of the constructor:
        may_steer: whether sticks of a system and component are taken at all.
        timeout_s: after so much silence another may have the sticks.
    """

    def __init__(self, system: System, may_steer: Callable[[int, int], bool], timeout_s: Callable[[], float]) -> None:
        self._system, self._may_steer, self._timeout_s = system, may_steer, timeout_s
        self._pilot: Sender | None = None
        self._heard_ns = 0
        self._pressed: dict[Sender, int] = {}

    def are_silent(self, time_ns: int) -> bool:
        """Whether nobody has the sticks."""
        return self._pilot is None or time_ns - self._heard_ns > self._timeout_s() * NS_PER_S

    def steers(self, arrival: Arrival) -> bool:
        """Whether a sender of sticks has them, now that it was heard."""
        sender = sender_of(arrival)
        if not self._may_steer(*sender) or (sender != self._pilot and not self.are_silent(arrival.time_ns)):
            return False
        if self._pilot not in (None, sender):
            self._system.say(_NOTICE, f"ground station {sender[0]}/{sender[1]} has the sticks")
        self._pilot, self._heard_ns = sender, arrival.time_ns
        return True

    def freshly_pressed(self, arrival: Arrival, buttons: int) -> int:
        """The buttons that the sender did not hold in its message before."""
        sender = sender_of(arrival)
        fresh = buttons & ~self._pressed.get(sender, 0)
        self._pressed[sender] = buttons
        return fresh


def sender_of(arrival: Arrival) -> Sender:
    """Who sent a message."""
    return arrival.message.system, arrival.message.component
