"""Output and exit status of `modcube replay`."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from firmware_py.app.replay import replay
from firmware_py.runtime.flight_log import LogError

SAME, DIFFERENT = 0, 1
"""Exit statuses."""


def replay_and_say(folder: Path, tolerance: float, say: Callable[[str], None]) -> int:
    """Replays the log in `folder`; returns the exit status. A log that only ends too early is the same if all that it holds is; one that is
    damaged is not, because what follows the damage was not compared.

    Raises LogError, DescriptionError and OSError.
    """
    began = time.perf_counter()
    outcome = replay(folder, tolerance)
    took_s = time.perf_counter() - began
    if not outcome.ticks:
        raise LogError(f"{folder}: no tick of the log is whole, so nothing can be replayed: {outcome.torn or 'it holds none'}")
    compared = f"{outcome.ticks} ticks"
    if outcome.torn:
        say(f"the log is {'damaged' if outcome.is_damaged else 'torn'}: {outcome.torn}; `modcube log recover {folder}` mends it")
        compared = f"compared {outcome.ticks} of {outcome.held} ticks"
    say(f"{compared}, {outcome.seconds:.2f} s, replayed in {took_s:.2f} s: {outcome.seconds / took_s:.1f} x real time")
    if outcome.first is not None:
        say(f"differs first in {outcome.first}")
        return DIFFERENT
    same = "every byte is the same" if tolerance == 0.0 else f"all within {tolerance:g}"
    say(f"{same} up to there" if outcome.torn else same)
    return DIFFERENT if outcome.is_damaged else SAME
