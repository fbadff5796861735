"""How much a torn or damaged log holds, and whether it only ends too early (kill -9, power loss) or is damaged with more data behind."""

from __future__ import annotations

import re
from functools import partial
from itertools import groupby
from pathlib import Path

from firmware_py.description.signals import SPOILT, is_closed, open_reader, read_messages
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG
from firmware_py.runtime.tick_messages import TICKS

_PIECE_BYTES = 1 << 16
_STAMP = re.compile(r"\(\d+\.\d{6}\)")


def is_stamp(text: str) -> bool:
    """Whether `text` is the time stamp of a line of can.log."""
    return _STAMP.fullmatch(text) is not None


def damaged_at(path: Path) -> int | None:
    """Byte of the first record of a signal log that cannot be read although more data follows; None for a log that is whole or only ends
    too early. Zeros do not count as data: a file system leaves them behind a power loss. Raises OSError.
    """
    good = 0
    with path.open("rb") as log:
        try:
            for _ in open_reader(log).records:
                good = log.tell()
        except SPOILT:
            rest = iter(partial(log.read, _PIECE_BYTES), b"")
            return good if is_closed(path) or any(piece.strip(b"\0") for piece in rest) else None
    return None


def ticks_held(folder: Path) -> int:
    """Number of ticks of which the log in `folder` holds anything that can be read. Raises OSError."""
    signals = sum(message.topic == TICKS for message in read_messages(folder / SIGNAL_LOG))
    with (folder / CAN_LOG).open(encoding="ascii", errors="replace") as file:
        stamps = (stamp for stamp, _ in groupby(line.partition(" ")[0] for line in file if line.endswith("\n")))
        return max(signals, len({stamp for stamp in stamps if is_stamp(stamp)}))
