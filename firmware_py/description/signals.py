"""Logging: the signals of a channel with unit and size, their protobuf message, and readers of logs.

A channel is an MCAP topic with one protobuf message per tick. Firmware and bench each declare their own channels.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Schema
from mcap.stream_reader import StreamReader

PACKAGE = "modcube"
MCAP_MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a complete log (MCAP specification)."""

SPOILT = (McapError, EOFError, ValueError, struct.error, OverflowError, MemoryError)
"""Exceptions raised by reading a truncated log, or one in which a flipped bit makes a length astronomical."""

Columns = dict[str, np.ndarray]
"""One array per signal of a channel, (k,) or (k, n) over its k messages, and `log_time`, (k,) int64 ns."""

_FIELD = descriptor_pb2.FieldDescriptorProto
_FIXED64, _LENGTH, _VARINT = 1, 2, 0  # protobuf wire types
_KINDS: Mapping[str, tuple[int, int, str]] = {
    "double": (_FIELD.TYPE_DOUBLE, _FIXED64, "<f8"),
    "int": (_FIELD.TYPE_SFIXED64, _FIXED64, "<i8"),
    "bool": (_FIELD.TYPE_BOOL, _VARINT, "u1"),
}


class Signal(NamedTuple):
    """One signal: a scalar if `size` is 0, else an array of that length (packed repeated doubles)."""

    name: str
    size: int = 0
    unit: str = ""
    kind: str = "double"


class Layout:
    """The message of one channel. Every field is always written, at full width, so each message has the same length.

    A message therefore is one row of a structured array: written by filling a row that already has its protobuf tags, read by
    viewing the joined bytes of all messages at once.
    """

    def __init__(self, name: str, signals: Sequence[Signal]) -> None:
        """`name` is the message's name within `PACKAGE`. Raises ValueError when an array is not of doubles."""
        if any(signal.size and signal.kind != "double" for signal in signals):
            raise ValueError(f"{name}: only doubles come in arrays")
        self.name = name
        self.signals = tuple(signals)
        self.names = tuple(signal.name for signal in signals)

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Structured dtype of a row: each value `name` is preceded by its tag bytes, `name#`."""
        fields: list[tuple[Any, ...]] = []
        for number, signal in enumerate(self.signals, 1):
            fields.append((f"{signal.name}#", "u1", (len(_prefix(number, signal)),)))
            shape = (signal.size,) if signal.size else ()
            fields.append((signal.name, _KINDS[signal.kind][2], shape))
        return np.dtype(fields)

    def row(self) -> Row:
        """A new row to fill."""
        return Row(self)

    def values(self, data: bytes) -> tuple[Any, ...]:
        """The values of one message, in the order of `signals`. Raises ValueError if its length is no multiple of a row's."""
        row = np.frombuffer(data, self.dtype)[0]
        return tuple(row[name] for name in self.names)

    @cached_property
    def schema(self) -> bytes:
        """The serialised FileDescriptorSet of the message; units are trailing comments."""
        file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{self.name}.proto", package=PACKAGE, syntax="proto3")
        message = file.message_type.add(name=self.name)
        for number, signal in enumerate(self.signals, 1):
            label = _FIELD.LABEL_REPEATED if signal.size else _FIELD.LABEL_OPTIONAL
            message.field.add(name=signal.name, number=number, label=label, type=_KINDS[signal.kind][0])
            if signal.unit:
                place = file.source_code_info.location.add(path=[4, 0, 2, number - 1], span=[number, 0, 1])
                place.trailing_comments = f" {signal.unit}\n"
        return bytes(descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(deterministic=True))

    @property
    def schema_name(self) -> str:
        """Full name of the message."""
        return f"{PACKAGE}.{self.name}"


class Row:
    """A reusable buffer for one message."""

    def __init__(self, layout: Layout) -> None:
        self._array = np.zeros((), layout.dtype)
        for number, signal in enumerate(layout.signals, 1):
            self._array[f"{signal.name}#"] = np.frombuffer(_prefix(number, signal), "u1")
        self._views = [self._array[signal.name] for signal in layout.signals]

    def encode(self, values: Iterable[Any]) -> bytes:
        """Encodes `values`, one per signal, in the layout's order."""
        for view, value in zip(self._views, values, strict=True):
            view[...] = value
        return self._array.tobytes()


class TextLayout:
    """Message of several integers followed by one text, for infrequent data (events, requests)."""

    def __init__(self, name: str, numbers: Sequence[str], text: str) -> None:
        self.name = name
        self._file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{name}.proto", package=PACKAGE, syntax="proto3")
        message = self._file.message_type.add(name=name)
        for i, each in enumerate((*numbers, text), 1):
            kind = _FIELD.TYPE_STRING if each == text else _FIELD.TYPE_SFIXED64
            message.field.add(name=each, number=i, label=_FIELD.LABEL_OPTIONAL, type=kind)
        pool = descriptor_pool.DescriptorPool()
        pool.Add(self._file)
        self.names = (*numbers, text)
        self._class = message_factory.GetMessageClass(pool.FindMessageTypeByName(self.schema_name))

    @property
    def schema_name(self) -> str:
        """Full name of the message."""
        return f"{PACKAGE}.{self.name}"

    @property
    def schema(self) -> bytes:
        """The serialised FileDescriptorSet."""
        return bytes(descriptor_pb2.FileDescriptorSet(file=[self._file]).SerializeToString(deterministic=True))

    def encode(self, *values: int | str) -> bytes:
        """Encodes the numbers and the text."""
        message = self._class(**dict(zip(self.names, values, strict=True)))
        return bytes(message.SerializeToString(deterministic=True))

    def values(self, data: bytes) -> tuple[Any, ...]:
        """The numbers and the text of a message."""
        message = self._class.FromString(data)
        return tuple(getattr(message, name) for name in self.names)


class LogMessage(NamedTuple):
    """One message of a log, not decoded."""

    topic: str
    data: bytes


def read_messages(path: Path) -> Iterator[LogMessage]:
    """All messages of an MCAP log in order, up to its end or to the point of truncation. Raises OSError."""
    topics: dict[int, str] = {}
    for record in log_records(path):
        if isinstance(record, Message):
            yield LogMessage(topics[record.channel_id], record.data)
        elif isinstance(record, Channel):
            topics[record.id] = record.topic


def is_closed(path: Path) -> bool:
    """Whether an MCAP log was written to its end. Raises OSError."""
    with path.open("rb") as file:
        file.seek(-min(len(MCAP_MAGIC), os.fstat(file.fileno()).st_size), os.SEEK_END)
        return file.read() == MCAP_MAGIC


def read_attachment(path: Path, name: str) -> bytes | None:
    """The attachment called `name` of an MCAP log, or None; nothing after it is read. Raises OSError."""
    with path.open("rb") as file:
        attachments = (record for record in _records_of(file) if isinstance(record, Attachment))
        return next((bytes(attachment.data) for attachment in attachments if attachment.name == name), None)


def read_signals(path: Path) -> dict[str, Columns]:
    """All channels of an MCAP log of protobuf messages, up to its end or to the point of truncation.

    Messages of one channel may differ in the length of their arrays (after bodies merge): short rows are padded with NaN.

    Raises:
        OSError: the file cannot be read.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    times: dict[int, list[int]] = {}
    payloads: dict[int, list[bytes]] = {}
    for record in log_records(path):
        if isinstance(record, Message):
            times.setdefault(record.channel_id, []).append(record.log_time)
            payloads.setdefault(record.channel_id, []).append(record.data)
        elif isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
    result: dict[str, Columns] = {}
    for number, messages in payloads.items():
        columns = _columns(schemas[channels[number].schema_id], messages)
        result[channels[number].topic] = {"log_time": np.array(times[number], np.int64), **columns}
    return result


def log_records(path: Path) -> Iterator[Any]:
    """The records of an MCAP log (mcap.records), up to its end or to the point of truncation. Raises OSError."""
    with path.open("rb") as file:
        yield from _records_of(file)


def open_reader(log: BinaryIO) -> StreamReader:
    """A reader of an open log. A record longer than the whole log spoils it; nothing is allocated for it."""
    return StreamReader(log, validate_crcs=True, record_size_limit=os.fstat(log.fileno()).st_size)


def _records_of(log: BinaryIO) -> Iterator[Any]:
    try:
        yield from open_reader(log).records
    except SPOILT:
        return  # truncated: the records before stay valid


def _columns(schema: Schema, messages: list[bytes]) -> Columns:
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    fields = files.file[0].message_type[0].field
    if any(field.type == _FIELD.TYPE_STRING for field in fields):
        return _text_columns(schema, files, messages)
    kinds = {number: name for name, (number, _, _) in _KINDS.items()}
    by_length: dict[int, list[int]] = {}
    for i, message in enumerate(messages):
        by_length.setdefault(len(message), []).append(i)
    parts: list[_Part] = []
    for indices in by_length.values():
        counts = _counts(messages[indices[0]])
        signals = [Signal(f.name, counts.get(f.number, 0), kind=kinds[f.type]) for f in fields]
        rows = np.frombuffer(b"".join(messages[i] for i in indices), Layout(schema.name, signals).dtype)
        parts.append((indices, rows, signals))
    return {field.name: _column(i, field.name, parts, len(messages)) for i, field in enumerate(fields)}


_Part = tuple[list[int], np.ndarray, list[Signal]]
"""Messages of one length: their indices in the channel, their rows, their signals."""


def _column(position: int, name: str, parts: list[_Part], total: int) -> np.ndarray:
    if len(parts) == 1:
        return np.ascontiguousarray(parts[0][1][name])
    width = max(signals[position].size for _, _, signals in parts)
    first = parts[0][1][name]
    column = np.full((total, width), np.nan) if width else np.zeros(total, first.dtype)
    for indices, rows, signals in parts:
        if width:
            column[indices, : signals[position].size] = rows[name]
        else:
            column[indices] = rows[name]
    return column


def _text_columns(schema: Schema, files: descriptor_pb2.FileDescriptorSet, messages: list[bytes]) -> Columns:
    classes = message_factory.GetMessages(list(files.file))
    parsed = [classes[schema.name].FromString(message) for message in messages]
    return {f.name: np.array([getattr(m, f.name) for m in parsed]) for f in files.file[0].message_type[0].field}


def _varint(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def _prefix(number: int, signal: Signal) -> bytes:
    """Tag of a field, followed by its length if it is an array (Protocol Buffers, "Encoding")."""
    if signal.size:
        return _varint(number << 3 | _LENGTH) + _varint(8 * signal.size)
    return _varint(number << 3 | _KINDS[signal.kind][1])


def _counts(message: bytes) -> dict[int, int]:
    """Field number -> length of its array of doubles, by walking one message."""
    counts, at = {}, 0
    while at < len(message):
        tag, at = _read_varint(message, at)
        if tag & 7 == _LENGTH:
            size, at = _read_varint(message, at)
            counts[tag >> 3] = size // 8
            at += size
        else:
            at += 8 if tag & 7 == _FIXED64 else 1
    return counts


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value, shift = 0, 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
