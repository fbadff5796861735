"""How much a torn or damaged log holds, and whether it only ends too early (kill -9, power loss) or is damaged with more data behind."""

from __future__ import annotations

import re
from io import BytesIO
from itertools import groupby
from pathlib import Path

from mcap.stream_reader import StreamReader

from firmware_py.description.signals import MCAP_MAGIC, SPOILT, read_messages
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG
from firmware_py.runtime.tick_messages import TICKS

_STAMP = re.compile(r"\(\d+\.\d{6}\)")


def is_stamp(text: str) -> bool:
    """Whether `text` is the time stamp of a line of can.log."""
    return _STAMP.fullmatch(text) is not None


def damaged_at(path: Path) -> int | None:
    """Byte of the first record of a signal log that cannot be read although more data follows; None for a log that is whole or only ends
    too early. Zeros do not count as data: a file system leaves them behind a power loss. Raises OSError.
    """
    data = path.read_bytes()
    log, good = BytesIO(data), 0
    try:
        for _ in StreamReader(log, validate_crcs=True).records:
            good = log.tell()
    except SPOILT:
        return good if data.endswith(MCAP_MAGIC) or data[log.tell() :].strip(b"\0") else None
    return None


def ticks_held(folder: Path) -> int:
    """Number of ticks of which the log in `folder` holds anything that can be read. Raises OSError."""
    signals = sum(message.topic == TICKS for message in read_messages(folder / SIGNAL_LOG))
    with (folder / CAN_LOG).open(encoding="ascii", errors="replace") as file:
        stamps = (stamp for stamp, _ in groupby(line.partition(" ")[0] for line in file if line.endswith("\n")))
        return max(signals, len({stamp for stamp in stamps if is_stamp(stamp)}))
