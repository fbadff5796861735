"""Random link events of a bus, from a seed: an interface goes down, comes up, is deleted, made again, or its buffer is full."""

import random
import time
from collections import Counter
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event

from tests.vcan.links import Interface

EVENTS = {
    "up": ("down", "delete", "make_again", "fill"),
    "down": ("up", "delete"),
    "deleted": ("create_up",),
    "full": ("empty", "delete", "make_again"),
}
"""Events that may happen next, by the state of the interface."""
STATE_AFTER = {
    "down": "down",
    "up": "up",
    "delete": "deleted",
    "make_again": "up",
    "create_up": "up",
    "fill": "full",
    "empty": "up",
}
USABLE_S = (0.1, 0.8)
"""Shortest and longest time that a link stays usable, in real time."""
BROKEN_S = (0.02, 0.2)


class BadDay:
    """Random events on one interface, which is up at first and after `heal`."""

    def __init__(self, link: Interface, seed: int) -> None:
        self.random = random.Random(seed)
        self.state = "up"
        self.counts: Counter[str] = Counter()
        self._link = link

    def strike(self) -> str:
        """Causes one event; returns the state afterwards: up, down, deleted, full."""
        event = self.random.choice(EVENTS[self.state])
        self.counts[event] += 1
        if event == "create_up":
            self._link.create()
            self._link.up()
        else:
            getattr(self._link, event)()
        self.state = STATE_AFTER[event]
        return self.state

    def heal(self) -> None:
        """Causes events until the interface is usable."""
        while self.state != "up":
            self.strike()


def break_link(link: Interface, seed: int, events: int, begin: Event, done: SimpleQueue) -> None:
    """Runs as a separate process: waits for `begin`, then causes events until `events` have happened and the link is up.

    Puts into `done` a list of (time on the machine's clock in ns, state from then on).
    """
    day = BadDay(link, seed)
    history: list[tuple[int, str]] = []
    begin.wait()
    while len(history) < events or day.state != "up":
        time.sleep(day.random.uniform(*(USABLE_S if day.state == "up" else BROKEN_S)))
        state = day.strike()
        history.append((time.monotonic_ns(), state))
    done.put(history)
