"""Wanted relay states of all docking faces, and when each module is next sent its own (DOCK_CMD)."""

from __future__ import annotations

import numpy as np

from firmware_py.core.joints import sides
from firmware_py.core.types import FACES, NEVER_NS, DockRequest

PERIOD_NS = 100_000_000
"""DOCK_CMD goes out at 10 Hz, and at once when a relay changes."""
AT_ONCE_NS = NEVER_NS
"""Due time of a module whose relays have changed."""


class MagnetRelays:
    """Wanted relay states by module and face. All off at first."""

    def __init__(self, modules: int) -> None:
        self._states = np.zeros((modules, FACES), dtype=np.int64)
        self._due_ns = [AT_ONCE_NS] * modules

    @property
    def states(self) -> list[list[int]]:
        """Six relay states of each module, by fleet index."""
        return self._states.tolist()

    def switch(self, state: int, *joints: DockRequest) -> None:
        """Sets the relays of both faces of each joint to `state`."""
        for module, face in (side for joint in joints for side in sides(joint)):
            if self._states[module, face] != state:
                self._states[module, face], self._due_ns[module] = state, AT_ONCE_NS

    def due(self, time_ns: int) -> list[int]:
        """Returns the modules whose states are to be sent in this tick, and schedules their next time."""
        if min(self._due_ns) > time_ns:
            return []
        due = [module for module, at_ns in enumerate(self._due_ns) if at_ns <= time_ns]
        for module in due:
            self._due_ns[module] = time_ns + PERIOD_NS
        return due
