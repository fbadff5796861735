"""Somebody else who commands modules on the bus: a person is told, at once and then every ten seconds while it goes on."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_py.core.types import WARNING, Event

TELL_EVERY_NS = 10_000_000_000


@dataclass(slots=True)
class Strangers:
    """What has been told of another sender of THRUSTER_CMD or DOCK_CMD."""

    _told: int = 0
    _due_ns: int = 0

    def events(self, commands: int, time_ns: int) -> list[Event]:
        """A warning where there are more `commands` of others, counted from the start, than were told of, and one is due."""
        if commands <= self._told or (self._told and time_ns < self._due_ns):
            return []
        self._told, self._due_ns = commands, time_ns + TELL_EVERY_NS
        return [Event(WARNING, f"somebody else commands modules: {commands} frames")]
