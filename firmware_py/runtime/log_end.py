"""The last tick of a signal log: state and mode of each body, without decoding the log of a whole flight."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import breakup_chunk

from firmware_py.description.signals import MCAP_MAGIC, SPOILT, Layout
from firmware_py.runtime.tick_messages import BODY, body_signals

_HEAD = struct.Struct("<BQH")
"""Opcode and length of a record (MCAP specification), and the first two bytes of its content."""
_LEAST = 9
"""Bytes before the content of a record."""


class BodyEnd(NamedTuple):
    """The last recorded state and mode of a body, as numbers."""

    state: int
    mode: int


def last_bodies(path: Path) -> dict[int, BodyEnd]:
    """The bodies of the last tick in a signal log, by number, up to its end or to the point of truncation. Raises OSError."""
    head = Layout("Body", body_signals(0)[:4])
    size = head.dtype.itemsize
    ends = {topic: data[:size] for topic, data in _last_messages(path).items() if topic.startswith(BODY)}
    found = {int(topic.removeprefix(BODY)): head.values(data) for topic, data in ends.items()}
    last_tick = max((tick for tick, *_ in found.values()), default=0)
    return {body: BodyEnd(int(state), int(mode)) for body, (tick, _, state, mode) in found.items() if tick == last_tick}


def _last_messages(path: Path) -> dict[str, bytes]:
    """The last message of each topic. Of the chunks of the log, only those are read in which a channel begins or ends."""
    topics: dict[int, str] = {}
    last: dict[int, _Record] = {}
    """Chunk by channel."""
    chunk: _Record | None = None
    with path.open("rb") as file:
        for record in _records(file.fileno()):
            if record.opcode == Opcode.CHUNK:
                chunk = record
            elif record.opcode == Opcode.MESSAGE_INDEX and chunk is not None:
                if record.channel not in topics:
                    begun = {each.id: each.topic for each in _contents(file.fileno(), chunk) if isinstance(each, Channel)}
                    topics |= {record.channel: "", **begun}
                last[record.channel] = chunk
        return {topics[channel]: data for channel, each in last.items() for data in _messages(file.fileno(), each, channel)[-1:]}


class _Record(NamedTuple):
    """A record of a log, not read yet."""

    opcode: int
    begin: int
    """Byte at which its content begins."""
    length: int
    channel: int
    """Of a message index; of another record its first two bytes."""


def _records(file: int) -> Iterator[_Record]:
    """The records of an open log, up to its end or to the point of truncation. Only their heads are read: a flight leaves 300 MB an hour
    and module, for which a vehicle that restarts in flight cannot wait.
    """
    size, at = os.fstat(file).st_size, len(MCAP_MAGIC)
    if os.pread(file, at, 0) != MCAP_MAGIC:
        return
    while len(head := os.pread(file, _HEAD.size, at)) == _HEAD.size:
        opcode, length, channel = _HEAD.unpack(head)
        begin = at + _LEAST
        at = begin + length
        if not opcode or at > size:  # zeros that a power cut left, or a truncated record
            return
        yield _Record(opcode, begin, length, channel)


def _contents(file: int, chunk: _Record) -> list[McapRecord]:
    """The records in a chunk; none if it is damaged."""
    try:
        stream = ReadDataStream(BytesIO(os.pread(file, chunk.length, chunk.begin)))
        return breakup_chunk(Chunk.read(stream), True)
    except SPOILT:
        return []


def _messages(file: int, chunk: _Record, channel: int) -> list[bytes]:
    """The messages of a channel in a chunk."""
    return [each.data for each in _contents(file, chunk) if isinstance(each, Message) and each.channel_id == channel]
