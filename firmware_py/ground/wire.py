"""Bytes to messages and back: MAVLink 1 and 2 frames, checksum, signature. Pure; never raises on what comes in.

Not pymavlink's own parser: it stores a stream's time stamp before it verifies the signature, and its allow-unsigned
callback also passes badly signed frames. Source: MAVLink developer guide, "Packet Serialization".
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from pymavlink.generator.mavcrc import x25crc

from firmware_py.ground.dialect import Definition, Dialect, Message
from firmware_py.ground.signing import SIGNATURE_BYTES, Signing

_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_MAGIC = re.compile(b"[\xfd\xfe]")
_SIGNED = 0x01
_HEADER_1, _HEADER_2 = struct.Struct("<BBBBBB"), struct.Struct("<BBBBBBBHB")
_CRC = struct.Struct("<H")
_MOST_FALSE = 256
"""Starts that begin no frame, in what comes at once: what is behind so many is garbage too, and a flood of them takes a millisecond."""


class Packet(NamedTuple):
    """A message that is believed, and the bytes that it came in."""

    message: Message
    raw: bytes


class _Header(NamedTuple):
    """Of a frame, or of what looks like one."""

    size: int
    length: int
    """Of the payload."""
    flags: int
    system: int
    component: int
    number: int

    @property
    def frame_size(self) -> int:
        """Bytes of the whole frame."""
        return self.size + self.length + _CRC.size + (SIGNATURE_BYTES if self.flags & _SIGNED else 0)


class Framer:
    """Cuts the bytes of one peer into frames."""

    def __init__(self, dialect: Dialect, signing: Signing, counts: Counter[str]) -> None:
        self._dialect, self._signing = dialect, signing
        self._buffer = bytearray()
        self.counts = counts
        """Frames by what became of them: good, checksum, unknown, flags, length, refused; bytes of no frame: garbage."""

    def feed(self, data: bytes, goes_on: bool = True) -> list[Packet]:
        """The believed messages that `data` completes. Where it does not go on, what is begun is no frame, and may hold one."""
        self._buffer += data
        packets: list[Packet] = []
        at = false = 0
        while false < _MOST_FALSE and (start := self._next_magic(at)) is not None:
            self.counts["garbage"] += start - at
            at = start
            packet, is_short = self._cut(at)
            if is_short and goes_on:
                break
            if packet is None:
                at += 1  # what looked like a frame may hold a real one
                false += 1
                continue
            at += len(packet.raw)
            if packet.message.name:
                packets.append(packet)
        else:
            self.counts["garbage"] += len(self._buffer) - at
            at = len(self._buffer)
        del self._buffer[:at]
        return packets

    def _cut(self, at: int) -> tuple[Packet | None, bool]:
        """The frame at `at`, if it is one, and whether more would have to come to tell."""
        header = self._header(at)
        definition = None if header is None else self._definition(header)
        if header is None or definition is None:
            return None, header is None
        raw = bytes(self._buffer[at : at + header.frame_size])
        is_short = len(raw) < header.frame_size
        return None if is_short else self._frame(header, definition, raw), is_short

    def _next_magic(self, at: int) -> int | None:
        found = _MAGIC.search(self._buffer, at)
        return None if found is None else found.start()

    def _header(self, at: int) -> _Header | None:
        """The header at `at`, or None while it is incomplete."""
        layout = _HEADER_1 if self._buffer[at] == _MAGIC_1 else _HEADER_2
        if len(self._buffer) - at < layout.size:
            return None
        fields = layout.unpack_from(self._buffer, at)
        if layout is _HEADER_1:
            _, length, _, system, component, number = fields
            return _Header(layout.size, length, 0, system, component, number)
        _, length, flags, _, _, system, component, low, high = fields
        return _Header(layout.size, length, flags, system, component, low | high << 16)

    def _definition(self, header: _Header) -> Definition | None:
        """Of the message; None when this can be no frame: nothing more of it is waited for, a stop may stand behind one byte of noise.

        Only in MAVLink 2 a message may have grown. None of MAVLink 1 is 253 bytes long: that is the first byte of the next frame.
        """
        definition = self._dialect.by_number.get(header.number)
        if header.flags & ~_SIGNED:
            self.counts["flags"] += 1
        elif definition is None:
            self.counts["unknown"] += 1
        elif header.size == _HEADER_1.size and (header.length > definition.struct.size or header.length == _MAGIC_2):
            self.counts["length"] += 1
        else:
            return definition
        return None

    def _frame(self, header: _Header, definition: Definition, raw: bytes) -> Packet | None:
        """The message; None when this is no frame; a nameless one when it is a frame that is not believed."""
        end = header.size + header.length
        if checksum(raw[1:end], definition.crc_extra) != _CRC.unpack_from(raw, end)[0]:
            self.counts["checksum"] += 1
            return None
        signature = raw[end + _CRC.size :]
        if not self._signing.believes(raw[: end + _CRC.size], signature, header.number, header.system, header.component):
            self.counts["refused"] += 1
            return Packet(_NOT_BELIEVED, raw)
        self.counts["good"] += 1
        return Packet(Message(definition.name, definition.decode(raw[header.size : end]), header.system, header.component), raw)


_NOT_BELIEVED = Message("", {})


def checksum(covered: bytes, crc_extra: int) -> int:
    """X.25 checksum of a frame without its magic byte, and of the message's own byte."""
    return int(x25crc(covered + bytes((crc_extra,))).crc)


class Encoder:
    """Makes the frames of one system and component, MAVLink 2."""

    def __init__(self, dialect: Dialect, signing: Signing, system: int, component: int) -> None:
        self._dialect, self._signing = dialect, signing
        self.system, self.component = system, component
        self._sequence = 0

    def encode(self, name: str, values: Mapping[str, Any], link: int = 0) -> bytes:
        """One frame. Raises KeyError for a message or field that there is not."""
        return self.frame(name, self._dialect.by_name[name].encode(values), link)

    def frame(self, name: str, payload: bytes, link: int = 0) -> bytes:
        """The frame of a payload that is encoded already."""
        definition = self._dialect.by_name[name]
        flags = 0 if self._signing.key is None else _SIGNED
        number, sequence = definition.number, self._sequence
        self._sequence = (sequence + 1) & 0xFF
        low, high = number & 0xFFFF, number >> 16
        sender = (self.system, self.component)
        frame = _HEADER_2.pack(_MAGIC_2, len(payload), flags, 0, sequence, *sender, low, high) + payload
        frame += _CRC.pack(checksum(frame[1:], definition.crc_extra))
        return frame + self._signing.sign(frame, link) if flags else frame
