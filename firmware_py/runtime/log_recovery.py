"""Repairs a log that was torn by kill -9 or power loss, or is damaged: keeps the whole ticks before that, and closes its files.
A log of the bench beside them, if torn too, is cut to the same ticks.

The original files are kept beside it as `NAME.torn`, or, where that name is taken, as `NAME.torn2` and so on.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Channel, Message, Schema
from mcap.writer import CompressionType, Writer

from firmware_py.description.signals import is_closed, log_records
from firmware_py.runtime.flight_log import FlightLog, LogError
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, candump_stamp

TORN = ".torn"


class Recovery(NamedTuple):
    """Result of a recovery."""

    ticks: int
    """Whole ticks in the log."""
    torn: str
    """What was wrong; empty for a whole log, which is left unchanged."""


def recover(folder: Path) -> Recovery:
    """Repairs the log in `folder`. Raises LogError where no tick of it is whole or its run still writes it, and OSError."""
    log = FlightLog(folder)
    _refuse_in_flight(folder)
    ticks, last_ns = 0, 0
    for logged in log.ticks():
        ticks, last_ns = ticks + 1, logged.time_ns
    if not ticks and log.torn:
        raise LogError(f"{folder}: no tick of the log is whole")
    beside = [path.name for path in sorted(folder.glob("*.mcap")) if path.name != SIGNAL_LOG and not is_closed(path)]  # of the bench
    torn = "; ".join([*([log.torn] if log.torn else ()), *(f"{name} was not closed" for name in beside)])
    mended = {name: folder / f"{name}.mended" for name in (*((SIGNAL_LOG, CAN_LOG) if log.torn else ()), *beside)}
    for name, path in mended.items():  # a file that goes on longer is cut to the same ticks
        if name == CAN_LOG:
            _cut_frames(folder / name, path, candump_stamp(last_ns))
        else:
            rewrite(folder / name, path, lambda topic, message: message.log_time <= last_ns)
    for name, path in mended.items():
        shutil.copystat(folder / name, path)  # `app.last_flight` takes the age of the flight from this time
        _set_aside(folder / name)
        os.replace(path, folder / name)
    return Recovery(ticks, torn)


def _set_aside(path: Path) -> None:
    """Gives a file a second name and keeps the first, so that a killed recovery leaves no log without one of its files."""
    aside = _free_name(path.with_name(f"{path.name}{TORN}"))
    try:
        os.link(path, aside)
    except OSError:  # a file system without hard links, such as a memory stick
        shutil.copy2(path, aside)


def _free_name(path: Path) -> Path:
    """`path`, or else `path` with the first free number appended: files set aside by an earlier recovery are the only whole copy."""
    names = (path.with_name(f"{path.name}{number if number > 1 else ''}") for number in count(1))
    return next(each for each in names if not each.exists())


def _refuse_in_flight(folder: Path) -> None:
    """Raises LogError while a run still writes the log, because it would continue in the file that is set aside."""
    with (folder / CAN_LOG).open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LogError(f"{folder}: is still being written; mend it when its run has ended") from None
        except OSError:
            return  # a file system without locks


def rewrite(source: Path, target: Path, keep: Callable[[str, Message], bool], attach: Callable[[bytes], bytes] = bytes) -> None:
    """Writes a whole MCAP log `target` with the messages of `source` that `keep` selects, and its attachments passed through `attach`."""
    with target.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="", library="modcube")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        topics: dict[int, str] = {}
        for record in log_records(source):
            if isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                topics[record.id] = record.topic
                channels[record.id] = writer.register_channel(record.topic, record.message_encoding, schemas[record.schema_id])
            elif isinstance(record, Attachment):
                data = attach(record.data)
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, data)
            elif isinstance(record, Message) and keep(topics[record.channel_id], record):
                number = channels[record.channel_id]
                writer.add_message(number, record.log_time, record.data, record.publish_time, record.sequence)
        writer.finish()  # type: ignore[no-untyped-call]


def _cut_frames(source: Path, target: Path, last: str) -> None:
    """Copies `source` up to the end of the first run of lines with the stamp `last`; damaged data further on may repeat that stamp."""
    stamp, end, here = f"{last} ".encode(), 0, 0
    with source.open("rb") as file:
        for line in file:
            here += len(line)
            if line.startswith(stamp):
                end = here
            elif end:
                break
    shutil.copyfile(source, target)
    os.truncate(target, end)
