"""MAVLink messages as values: name and fields to payload and back. The dialects define the messages, not this module.

Definitions come from pymavlink's dialect `all` and from modcube.xml, read with mavgen's own parser.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import all as shipped
from pymavlink.generator import mavparse

_LETTERS = {
    "char": "s", "int8_t": "b", "uint8_t": "B", "uint8_t_mavlink_version": "B", "int16_t": "h", "uint16_t": "H",
    "int32_t": "i", "uint32_t": "I", "int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d",
}  # fmt: skip


class Field(NamedTuple):
    """One field in wire order."""

    name: str
    letter: str
    """Format character of struct."""
    length: int
    """Length of an array or a text; 0 for a single number."""


class Definition:
    """Payload layout of one message."""

    def __init__(self, number: int, name: str, crc_extra: int, fields: Sequence[Field]) -> None:
        self.number, self.name, self.crc_extra, self.fields = number, name, crc_extra, tuple(fields)
        self.struct = struct.Struct("<" + "".join(f"{f.length or ''}{f.letter}" for f in fields))
        self._flat = all(f.length == 0 and f.letter != "s" for f in fields)
        self.names = tuple(f.name for f in fields)
        self.zero = {f.name: "" if f.letter == "s" else (0,) * f.length if f.length else 0 for f in fields}

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Returns the payload without trailing zeros. Missing fields are zero; numbers outside their field's range saturate.

        Raises:
            KeyError: the message has no such field.
        """
        if not values.keys() <= self.zero.keys():
            raise KeyError(f"{self.name} has no field {sorted(values.keys() - self.zero.keys())}")
        row = [values.get(name, self.zero[name]) for name in self.names]
        try:
            payload = self.struct.pack(*(row if self._flat else self._flatten(row)))
        except (struct.error, OverflowError):
            payload = self.struct.pack(*self._flatten([_fit(v, f) for v, f in zip(row, self.fields, strict=True)]))
        return payload.rstrip(b"\0") or b"\0"

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Returns the fields of a payload. Bytes that were cut off count as zero; bytes beyond the message's size are ignored."""
        size = self.struct.size
        raw = self.struct.unpack(payload[:size].ljust(size, b"\0"))
        if self._flat:
            return dict(zip(self.names, raw, strict=True))
        values: dict[str, Any] = {}
        at = 0
        for field in self.fields:
            if field.letter == "s":
                values[field.name] = raw[at].split(b"\0", 1)[0].decode("ascii", "replace")
                at += 1
            elif field.length:
                values[field.name] = raw[at : at + field.length]
                at += field.length
            else:
                values[field.name] = raw[at]
                at += 1
        return values

    def _flatten(self, row: Sequence[Any]) -> list[Any]:
        flat: list[Any] = []
        for value, field in zip(row, self.fields, strict=True):
            if field.letter == "s":
                flat.append(value.encode("ascii", "replace")[: field.length])
            elif field.length:
                flat += [*value, *[0] * field.length][: field.length]
            else:
                flat.append(value)
        return flat


@dataclass(frozen=True, slots=True)
class Message:
    """One message, from `system` and `component` (0, 0 before it is sent)."""

    name: str
    values: dict[str, Any]
    system: int = 0
    component: int = 0

    def __getitem__(self, name: str) -> Any:
        return self.values[name]


class Dialect:
    """All definitions, by number and by name."""

    def __init__(self, definitions: Sequence[Definition]) -> None:
        self.by_number = {d.number: d for d in definitions}
        self.by_name = {d.name: d for d in definitions}


@cache
def load_dialect() -> Dialect:
    """Returns the dialect of this package: `all`, extended by modcube.xml. Read once and shared; read-only."""
    definitions = [_of_class(cls) for cls in shipped.mavlink_map.values()]
    with resources.as_file(resources.files("firmware_py.ground") / "modcube.xml") as path:
        definitions += [_of_xml(message) for message in mavparse.MAVXML(str(path), mavparse.PROTOCOL_2_0).message]
    return Dialect(definitions)


def _of_class(cls: Any) -> Definition:
    kinds = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True))
    fields = [
        Field(name, _LETTERS[kinds[name]], array)
        for name, array in zip(cls.ordered_fieldnames, cls.array_lengths, strict=True)
    ]
    return Definition(cls.id, cls.msgname, cls.crc_extra, fields)


def _of_xml(message: Any) -> Definition:
    fields = [Field(f.name, _LETTERS[f.type], f.array_length) for f in message.ordered_fields]
    return Definition(message.id, message.name, message.crc_extra, fields)


_RANGES = {
    "b": (-(2**7), 2**7 - 1), "B": (0, 2**8 - 1), "h": (-(2**15), 2**15 - 1), "H": (0, 2**16 - 1),
    "i": (-(2**31), 2**31 - 1), "I": (0, 2**32 - 1), "q": (-(2**63), 2**63 - 1), "Q": (0, 2**64 - 1),
}  # fmt: skip
_LARGEST_FLOAT = 3.4e38


def _fit(value: Any, field: Field) -> Any:
    """Returns `value` limited to the range of `field`."""
    if field.letter == "s":
        return value
    if isinstance(value, Sequence) or hasattr(value, "__len__"):
        return tuple(_fit_number(v, field.letter) for v in value)
    return _fit_number(value, field.letter)


def _fit_number(value: float, letter: str) -> float:
    if letter in "fd":
        return value if not math.isfinite(value) else min(max(float(value), -_LARGEST_FLOAT), _LARGEST_FLOAT)
    low, high = _RANGES[letter]
    if math.isnan(value):
        return 0
    return int(min(max(value, low), high))
