"""CRC-8 SAE J1850 (polynomial 0x1D, start 0xFF, final xor 0xFF), table driven: the last byte of a frame marked E."""

from __future__ import annotations

from collections.abc import Iterable


def _step(byte: int) -> int:
    """CRC-8 SAE J1850, polynomial 0x1D, one byte on."""
    for _ in range(8):
        byte = (byte << 1) ^ 0x1D if byte & 0x80 else byte << 1
    return byte & 0xFF


_START = 0xFF
_FINAL = 0xFF
TABLE = tuple(_step(byte) for byte in range(256))
"""Register after one byte, by (register xor byte)."""
LAST_BYTE = tuple(bytes((value ^ _FINAL,)) for value in range(256))
"""Last byte of a frame, by the register before it."""
RESIDUE = TABLE[_FINAL]
"""Register behind a whole frame whose last byte is right; it depends on the final xor alone."""


def register(data: Iterable[int], start: int = _START) -> int:
    """The register after `data`, before the final xor; `start` is the register before it."""
    value = start
    for byte in data:
        value = TABLE[value ^ byte]
    return value


def register_of_id(can_id: int) -> int:
    """The register after the id, two bytes little endian, which goes before the payload."""
    return register(can_id.to_bytes(2, "little"))


def crc8(can_id: int, payload: bytes) -> int:
    """The last byte of a protected frame, from its actual id and the payload before that byte."""
    return register(payload, register_of_id(can_id)) ^ _FINAL
