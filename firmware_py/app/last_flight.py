"""How the process before this one ended, by the log that it left: which modules were in flight, and which magnets pulled."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from firmware_py.bus.codec import Codec
from firmware_py.description.fleet import Fleet
from firmware_py.runtime.flight_log import LoggedFrame, frame_of
from firmware_py.runtime.log_folder import newest_log_folder
from firmware_py.runtime.recorder import CAN_LOG

RECENT_NS = 60_000_000_000
"""A log that was last written longer ago says nothing of now: the vehicle may be out of the water, in somebody's hands."""
TAIL_BYTES = 32_768
"""Of can.log, for each module: 80 ticks. DOCK_CMD comes in every 40th at 400 Hz, the commands of thrusters in each."""
_THRUSTERS = ("THRUSTER_CMD_A", "THRUSTER_CMD_B")
_ARMED = 1
_PULLS = 1


class LastFlight(NamedTuple):
    """What the process before told its modules last."""

    armed: frozenset[int] = frozenset()
    """Fleet indices."""
    pulling: frozenset[tuple[int, int]] = frozenset()
    """Fleet index and face of every magnet that pulled."""
    let_go: frozenset[tuple[int, int]] = frozenset()
    """Those of every magnet that did not."""


def last_flight(out: Path, fleet: Fleet, codec: Codec, now_ns: int) -> LastFlight:
    """How the newest log under `out` ends. A log that is missing, unreadable or old says nothing.

    Args:
        now_ns: the time of day, to compare with that of the file.
    """
    indices = {(module.bus, module.number): index for index, module in enumerate(fleet.module)}
    armed: dict[int, bool] = {}
    relays: dict[int, tuple[float, ...]] = {}
    for frame in _last_sent(out, now_ns, TAIL_BYTES * len(indices)):
        message, index = codec.by_id(frame.id), indices.get((frame.bus, frame.id & 31))
        if message is None or index is None:
            continue
        if message.name in _THRUSTERS:
            armed[index] = dict(zip(message.fields, message.decode(frame.data), strict=True))["Mode"] == _ARMED
        elif message.name == "DOCK_CMD":
            relays[index] = message.decode(frame.data)
    told = {(index, face): state == _PULLS for index, states in relays.items() for face, state in enumerate(states)}
    pulling = frozenset(side for side, pulls in told.items() if pulls)
    return LastFlight(frozenset(index for index, on in armed.items() if on), pulling, frozenset(told) - pulling)


def _last_sent(out: Path, now_ns: int, most_bytes: int) -> Iterator[LoggedFrame]:
    """The frames that the end of the newest log says were sent; half a line at either end is left out."""
    with suppress(OSError), (newest_log_folder(out) / CAN_LOG).open("rb") as file:
        status = os.fstat(file.fileno())
        if not 0 <= now_ns - status.st_mtime_ns < RECENT_NS:
            return
        file.seek(max(0, status.st_size - most_bytes))
        for line in file.read().decode("ascii", errors="replace").splitlines(keepends=True):
            with suppress(ValueError):
                if line.endswith(" T\n"):
                    yield frame_of(line)
