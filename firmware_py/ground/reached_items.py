"""MISSION_ITEM_REACHED: told when the body has reached an item, and repeated, as a message may be lost."""

from __future__ import annotations

from firmware_py.ground.system import System

_REPEATS, _EVERY_NS = 3, 300_000_000


class ReachedItems:
    """Tells which items of the mission are reached. Repeats the newest alone: MAVSDK takes the last one that it heard of for the farthest.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self._due: list[tuple[int, int]] = []
        """Number and time of each repeat that is due."""

    def tell(self, sequence: int, time_ns: int) -> None:
        """Tells that an item is reached."""
        self._system.broadcast("MISSION_ITEM_REACHED", {"seq": sequence})
        self._due = [(sequence, time_ns + n * _EVERY_NS) for n in range(1, _REPEATS)]

    def tell_again(self, time_ns: int) -> None:
        """Repeats what is due."""
        while self._due and self._due[0][1] <= time_ns:
            self._system.broadcast("MISSION_ITEM_REACHED", {"seq": self._due.pop(0)[0]})

    def forget(self, first: int = 0) -> None:
        """No longer repeats items from `first` on: a client would take them for reached anew, or for items of a new mission."""
        self._due = [repeat for repeat in self._due if repeat[0] < first]
