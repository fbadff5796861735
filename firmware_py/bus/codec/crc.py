"""CRC-8 SAE J1850 (polynomial 0x1D, start 0xFF, final xor 0xFF), table-driven: the last byte of a protected frame."""

from __future__ import annotations

from collections.abc import Iterable


def _step(byte: int) -> int:
    """Returns the register after `byte`, from a register of 0 (CRC-8 SAE J1850, polynomial 0x1D)."""
    for _ in range(8):
        byte = (byte << 1) ^ 0x1D if byte & 0x80 else byte << 1
    return byte & 0xFF


_START = 0xFF
_FINAL = 0xFF
TABLE = tuple(_step(byte) for byte in range(256))
"""Register after one byte, indexed by (register xor byte)."""
LAST_BYTE = tuple(bytes((value ^ _FINAL,)) for value in range(256))
"""Last byte of a frame, indexed by the register before it."""
RESIDUE = TABLE[_FINAL]
"""Register after a whole frame whose last byte is correct; it depends on the final xor alone."""


def register(data: Iterable[int], start: int = _START) -> int:
    """Returns the register after `data`, without the final xor; `start` is the register before `data`."""
    value = start
    for byte in data:
        value = TABLE[value ^ byte]
    return value


def register_of_id(can_id: int) -> int:
    """Returns the register after the id, two bytes little endian, which the CRC covers before the payload."""
    return register(can_id.to_bytes(2, "little"))


def crc8(can_id: int, payload: bytes) -> int:
    """Returns the last byte of a protected frame, from its actual id and the payload before that byte."""
    return register(payload, register_of_id(can_id)) ^ _FINAL
