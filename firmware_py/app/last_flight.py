"""How the process before this one ended, by the log that it left: which modules were in flight when it was killed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from firmware_py.bus.codec import Codec
from firmware_py.description.fleet import Fleet
from firmware_py.runtime.flight_log import LoggedFrame, frame_of
from firmware_py.runtime.log_folder import newest_log_folder
from firmware_py.runtime.recorder import CAN_LOG

RECENT_NS = 60_000_000_000
"""A log that was last written longer ago says nothing of now: the vehicle may be out of the water, in somebody's hands."""
TAIL_BYTES = 65_536
"""Of can.log: 40 ticks of four modules; one would do, for each commands every module."""
_COMMANDS = ("THRUSTER_CMD_A", "THRUSTER_CMD_B")
_ARMED = 1


def modules_in_flight(out: Path, fleet: Fleet, codec: Codec, now_ns: int) -> set[int]:
    """Fleet indices of the modules that the newest log under `out` left armed. A log that is missing, unreadable or old left none.

    Args:
        now_ns: the time of day, to compare with that of the file.
    """
    last: dict[tuple[int, int], bool] = {}
    for frame in _last_sent(out, now_ns):
        message = codec.by_id(frame.id)
        if message is not None and message.name in _COMMANDS:
            values = dict(zip(message.fields, message.decode(frame.data), strict=True))
            last[frame.bus, frame.id & 31] = values["Mode"] == _ARMED
    return {index for index, module in enumerate(fleet.module) if last.get((module.bus, module.number))}


def _last_sent(out: Path, now_ns: int) -> Iterator[LoggedFrame]:
    """The frames that the end of the newest log says were sent; half a line at either end is left out."""
    with suppress(OSError), (newest_log_folder(out) / CAN_LOG).open("rb") as file:
        status = os.fstat(file.fileno())
        if not 0 <= now_ns - status.st_mtime_ns < RECENT_NS:
            return
        file.seek(max(0, status.st_size - TAIL_BYTES))
        for line in file.read().decode("ascii", errors="replace").splitlines(keepends=True):
            with suppress(ValueError):
                if line.endswith(" T\n"):
                    yield frame_of(line)
