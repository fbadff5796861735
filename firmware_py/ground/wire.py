"""Bytes to messages and back: MAVLink 1 and 2 frames, checksum, signature. Pure; never raises on received bytes.

Not pymavlink's own parser: it stores a stream's time stamp before it verifies the signature, and its allow-unsigned
callback also passes badly signed frames. Source: MAVLink developer guide, "Packet Serialization".
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from typing import NamedTuple

from pymavlink.generator.mavcrc import x25crc

from firmware_py.ground.dialect import Definition, Dialect, Message
from firmware_py.ground.signing import SIGNATURE_BYTES, Signing

_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_MAGIC = re.compile(b"[\xfd\xfe]")
_SIGNED = 0x01
_HEADER_1, _HEADER_2 = struct.Struct("<BBBBBB"), struct.Struct("<BBBBBBBHB")
_CRC = struct.Struct("<H")
_MOST_FALSE = 256
"""Most false frame starts examined per call; everything after them counts as garbage. A flood of them takes a millisecond."""


class Packet(NamedTuple):
    """A believed message, and the bytes of its frame."""

    message: Message
    raw: bytes


class _Header(NamedTuple):
    """Header of a frame, or of bytes that look like one."""

    size: int
    length: int
    """Length of the payload."""
    flags: int
    system: int
    component: int
    number: int

    @property
    def frame_size(self) -> int:
        """Size of the whole frame, bytes."""
        return self.size + self.length + _CRC.size + (SIGNATURE_BYTES if self.flags & _SIGNED else 0)


class Framer:
    """Cuts the bytes of one peer into frames."""

    def __init__(self, dialect: Dialect, signing: Signing, counts: Counter[str]) -> None:
        self._dialect, self._signing = dialect, signing
        self._buffer = bytearray()
        self.counts = counts
        """Frames by outcome: good, checksum, unknown, flags, length, refused; bytes outside frames: garbage."""

    def feed(self, data: bytes, goes_on: bool = True) -> list[Packet]:
        """Returns the believed packets that `data` completes. Unless `goes_on`, an incomplete frame is invalid, but may hold others."""
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
        """Returns the frame at `at`, or None, and whether more bytes are needed to decide."""
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
        """Returns the header at `at`, or None while it is incomplete."""
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
        """Returns the message's definition; None if this cannot be a frame. Its rest is not awaited: a stop may follow one byte of noise.

        Only in MAVLink 2 may a message have grown. No MAVLink 1 message is 253 bytes long: that is the first byte of the next frame.
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
        """Returns the packet; None if the checksum is wrong; one with a nameless message if the frame is not believed."""
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
    """X.25 checksum of a frame without its magic byte, followed by the message's CRC_EXTRA byte."""
    return int(x25crc(covered + bytes((crc_extra,))).crc)


class Encoder:
    """Makes the MAVLink 2 frames of one system and component."""

    def __init__(self, dialect: Dialect, signing: Signing, system: int, component: int) -> None:
        self._dialect, self._signing = dialect, signing
        self.system, self.component = system, component
        self._sequence = 0

    def frame(self, name: str, payload: bytes, link: int) -> bytes:
        """Returns the frame of an encoded payload."""
        definition = self._dialect.by_name[name]
        flags = 0 if self._signing.key is None else _SIGNED
        number, sequence = definition.number, self._sequence
        self._sequence = (sequence + 1) & 0xFF
        low, high = number & 0xFFFF, number >> 16
        sender = (self.system, self.component)
        frame = _HEADER_2.pack(_MAGIC_2, len(payload), flags, 0, sequence, *sender, low, high) + payload
        frame += _CRC.pack(checksum(frame[1:], definition.crc_extra))
        return frame + self._signing.sign(frame, link) if flags else frame
