"""One command of a client, and how it may be answered."""

from __future__ import annotations

import math
from typing import NamedTuple

from firmware_py.ground.system import Arrival

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, COMMAND_INT_ONLY = 0, 1, 2, 3, 4, 8
"""MAV_RESULT."""

Answer = int | None
"""A MAV_RESULT, or None when the answer comes later."""


class Command(NamedTuple):
    """One command, whichever message carried it."""

    number: int
    parameters: tuple[float, ...]
    """Seven parameters; unused ones may be NaN."""
    arrival: Arrival

    def get(self, index: int, default: float = 0.0) -> float:
        """Parameter `index` (1 to 7), or `default` where it is NaN or infinite."""
        value = self.parameters[index - 1]
        return value if math.isfinite(value) else default
