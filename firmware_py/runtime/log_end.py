"""The last tick of a signal log: state and mode of each body, without decoding the log of a whole flight."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader, breakup_chunk

from firmware_py.description.signals import SPOILT, Layout
from firmware_py.runtime.tick_messages import BODY, body_signals


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
    """The last message of each topic. Of the chunks of the log, only those are opened in which a channel begins or ends."""
    topics: dict[int, str] = {}
    last: dict[int, Chunk] = {}
    """By channel."""
    chunk: Chunk | None = None
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    chunk = record
                elif isinstance(record, MessageIndex) and chunk is not None:
                    if record.channel_id not in topics:
                        begun = {each.id: each.topic for each in breakup_chunk(chunk, True) if isinstance(each, Channel)}
                        topics |= {record.channel_id: "", **begun}
                    last[record.channel_id] = chunk
        except SPOILT:
            pass  # truncated: the records before stay valid
    return {topics[channel]: data for channel, each in last.items() if channel in topics for data in _messages(each, channel)[-1:]}


def _messages(chunk: Chunk, channel: int) -> list[bytes]:
    """The messages of a channel in a chunk; none if it is damaged."""
    try:
        return [each.data for each in breakup_chunk(chunk, True) if isinstance(each, Message) and each.channel_id == channel]
    except SPOILT:
        return []
