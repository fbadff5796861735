"""The wire: can_dbc/modcube.dbc compiled once into fast encoders and decoders. Pure; no socket, no clock.

The firmware and the simulated nodes use it at both ends of every frame. cantools reads the DBC; it codes nothing here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, NamedTuple

import cantools.database
import numpy as np

NUMBERS = 32
"""Node numbers 0..31: the low five bits of an id."""
NO_COUNTER = -1
"""Counter of a message that has none."""
PROTECTION = ("Counter", "Crc")
"""Signals that the codec fills and checks itself."""


def _crc_step(byte: int) -> int:
    """CRC-8 SAE J1850, polynomial 0x1D, one byte on."""
    for _ in range(8):
        byte = (byte << 1) ^ 0x1D if byte & 0x80 else byte << 1
    return byte & 0xFF


_CRC_START = 0xFF
_CRC_FINAL = 0xFF
_CRC_TABLE = tuple(_crc_step(byte) for byte in range(256))
_CRC_BYTE = tuple(bytes((register ^ _CRC_FINAL,)) for register in range(256))
_CRC_RESIDUE = _CRC_TABLE[_CRC_FINAL]
"""Register behind a whole frame whose last byte is right; it depends on the final xor alone."""


def _crc_register(data: Iterable[int], register: int = _CRC_START) -> int:
    table = _CRC_TABLE
    for byte in data:
        register = table[register ^ byte]
    return register


def crc8(can_id: int, payload: bytes) -> int:
    """The last byte of a protected frame, from its actual id and the payload before that byte."""
    return _crc_register(payload, _crc_register(can_id.to_bytes(2, "little"))) ^ _CRC_FINAL


class Frame(NamedTuple):
    """One classic CAN frame with an 11-bit id."""

    id: int
    data: bytes


class CodecError(ValueError):
    """The DBC is not what this codec can compile; one line."""


@dataclass(frozen=True, slots=True)
class Field:
    """One signal: where its bits are, and raw * factor + offset = physical."""

    name: str
    start: int
    bits: int
    signed: bool
    factor: float
    offset: float
    raw_low: int
    raw_high: int
    unit: str

    @property
    def is_integer(self) -> bool:
        """Its physical value is its raw value."""
        return self.factor == 1 and self.offset == 0

    @property
    def raw_range(self) -> tuple[int, int]:
        """What its bits can hold; the DBC's limits may be narrower."""
        return (-(1 << self.bits - 1), (1 << self.bits - 1) - 1) if self.signed else (0, (1 << self.bits) - 1)


class MessageCodec:
    """One message of the DBC, for all node numbers.

    Encoder and decoder are generated as one expression each, like collections.namedtuple does: measured on the 8-byte
    THRUSTER_CMD_A they take a third of a loop over the fields.
    """

    def __init__(self, message: Any) -> None:
        self.name: str = message.name
        self.function: int = message.frame_id >> 5
        self.length: int = message.length
        attributes = {name: attribute.value for name, attribute in (message.dbc.attributes or {}).items()}
        self.protected: bool = bool(attributes.get("Protected", 0))
        self.per_tick: bool = bool(attributes.get("PerTick", 0))
        self.cycle_ms: int = int(message.cycle_time or 0)
        self.field_details: tuple[Field, ...] = tuple(
            _field(message, signal) for signal in message.signals if signal.name not in PROTECTION
        )
        self.fields: tuple[str, ...] = tuple(field.name for field in self.field_details)
        self.numbers: frozenset[int] = _numbers(self.name)
        self._counter_shift = 8 * (self.length - 2) + 4
        self._head = self.length - 1 if self.protected else self.length
        ids = (self.function << 5 | number for number in range(NUMBERS))
        self._crc_start = tuple(_crc_register(can_id.to_bytes(2, "little")) for can_id in ids)
        self._unpack: Callable[[int], tuple[Any, ...]] = _compile(_decode_source(self.field_details))
        self._pack: Callable[[Sequence[Any]], int] = _compile(_encode_source(self.field_details))
        source = _range_source(self.field_details)
        self.in_range: Callable[[tuple[Any, ...]], bool] | None = _compile(source) if source else None
        """Whether physical values keep the DBC's limits; None where the bits cannot hold anything beyond them."""

    def id_of(self, number: int) -> int:
        """The id of this message for node `number`. Raises ValueError where the number is not valid for it."""
        if number not in self.numbers:
            raise ValueError(f"{self.name}: number {number} is not valid for it")
        return self.function << 5 | number

    def encode(self, number: int, values: Sequence[float] = (), counter: int = 0) -> Frame:
        """The frame of physical `values`, one per name in `fields`, rounded to nearest, saturated at the limits.

        Args:
            number: node number of the id, 0..31.
            values: physical values in the units of the DBC.
            counter: modulo 16; ignored where the message carries none.

        Raises:
            ValueError: a value is NaN, there are too few or too many, or the number is not valid.
        """
        try:
            raw = self._pack(values)
        except (ValueError, TypeError):
            raise ValueError(self._complaint(values)) from None
        return self._frame(number, raw, counter)

    def encode_raw(self, number: int, raws: Sequence[int], counter: int = 0) -> Frame:
        """The frame of raw integers, which need only fit their bits: what a faulty node may send.

        Raises:
            ValueError: a raw value does not fit, there are too few or too many, or the number is not valid.
        """
        packed = 0
        for field, raw in zip(self.field_details, raws, strict=True):
            low, high = field.raw_range
            if not low <= raw <= high:
                raise ValueError(f"{self.name}.{field.name}: raw {raw} does not fit; {low} to {high}")
            packed |= (int(raw) & ((1 << field.bits) - 1)) << field.start
        return self._frame(number, packed, counter)

    def decode(self, data: bytes) -> tuple[Any, ...]:
        """Values in the order of `fields`: int where the factor is 1, else float in the DBC's unit. Checks nothing."""
        return self._unpack(int.from_bytes(data, "little"))

    def decode_raw(self, data: bytes) -> tuple[int, ...]:
        """Raw integers in the order of `fields`. Checks nothing."""
        packed = int.from_bytes(data, "little")
        bits = ((field, packed >> field.start & ((1 << field.bits) - 1)) for field in self.field_details)
        return tuple(raw - (1 << f.bits) if f.signed and raw >> (f.bits - 1) else raw for f, raw in bits)

    def counter_of(self, data: bytes) -> int:
        """The counter that a frame of the right length carries; NO_COUNTER where the message has none."""
        return data[-2] >> 4 if self.protected else NO_COUNTER

    def crc_ok(self, number: int, data: bytes) -> bool:
        """Whether the last byte of a protected frame is the CRC of its id and payload. Needs the right length."""
        table, crc = _CRC_TABLE, self._crc_start[number]
        for byte in data:
            crc = table[crc ^ byte]
        return crc == _CRC_RESIDUE

    def _frame(self, number: int, packed: int, counter: int) -> Frame:
        if number not in self.numbers:
            raise ValueError(f"{self.name}: number {number} is not valid for it")
        can_id = self.function << 5 | number
        if not self.protected:
            return Frame(can_id, packed.to_bytes(self._head, "little"))
        head = (packed | (counter & 15) << self._counter_shift).to_bytes(self._head, "little")
        table, crc = _CRC_TABLE, self._crc_start[number]
        for byte in head:
            crc = table[crc ^ byte]
        return Frame(can_id, head + _CRC_BYTE[crc])

    def _complaint(self, values: Sequence[float]) -> str:
        if len(values) != len(self.fields):
            return f"{self.name}: {len(values)} values; needs {len(self.fields)}: {', '.join(self.fields)}"
        wrong = [name for name, value in zip(self.fields, values, strict=True) if not _is_number(value)]
        return f"{self.name}: not a number: {', '.join(wrong)}"


class Codec:
    """All messages of the DBC."""

    def __init__(self, database: Any) -> None:
        self.messages: tuple[MessageCodec, ...] = tuple(MessageCodec(message) for message in database.messages)
        self._by_name = {message.name: message for message in self.messages}
        self._by_function = {message.function: message for message in self.messages}
        if len(self._by_function) != len(self.messages):
            raise CodecError("two messages of the DBC have the same function")

    @classmethod
    def load(cls) -> Codec:
        """The codec of the DBC that the package carries (20 ms; make one and pass it on)."""
        text = (resources.files("can_dbc") / "modcube.dbc").read_text(encoding="utf-8")
        return cls(cantools.database.load_string(text, "dbc", frame_id_mask=0x7E0))

    def message(self, name: str) -> MessageCodec:
        """The message called `name`. Raises KeyError, with the names that there are."""
        try:
            return self._by_name[name]
        except KeyError:
            raise KeyError(f"no message {name!r}; there are {', '.join(self._by_name)}") from None

    def by_id(self, can_id: int) -> MessageCodec | None:
        """The message of an 11-bit id, whatever its number; None where the DBC has none. 0x000..0x01F is ESTOP."""
        return self._by_function.get(can_id >> 5) if 0 <= can_id <= 0x7FF else None


class Received(NamedTuple):
    """A frame that passed every check."""

    message: MessageCodec
    number: int
    values: tuple[Any, ...]
    counter: int
    """0..15, or NO_COUNTER."""


class Receiver:
    """Checks the frames of one bus as one node hears them; drops, counts by kind, never raises.

    A frame is dropped when its id is unknown, its number not valid for the message, its length wrong, its CRC wrong,
    its counter that of the last accepted frame of the same id, or a value outside the DBC's limits (such as raw -2048
    of a thruster). Any other step of the counter is accepted, so a node that restarts is heard from its first or second
    frame on.
    """

    def __init__(self, codec: Codec) -> None:
        self.dropped: dict[str, int] = dict.fromkeys(("id", "number", "length", "crc", "counter", "range"), 0)
        self._counters: dict[int, int] = {}
        self._known: dict[int, tuple[MessageCodec, int]] = {}
        self._wrong_number: set[int] = set()
        for message in codec.messages:
            for number in range(NUMBERS):
                can_id = message.function << 5 | number
                if number in message.numbers:
                    self._known[can_id] = (message, number)
                else:
                    self._wrong_number.add(can_id)

    def accept(self, frame: Frame) -> Received | None:
        """What the frame says, or None when it is dropped."""
        can_id, data = frame
        known = self._known.get(can_id)
        if known is None:
            return self._drop("number" if can_id in self._wrong_number else "id")
        message, number = known
        if len(data) != message.length:
            # ESTOP stops everyone whatever its length.
            return Received(message, number, (), NO_COUNTER) if message.function == 0 else self._drop("length")
        counter = NO_COUNTER
        if message.protected:
            if not message.crc_ok(number, data):
                return self._drop("crc")
            counter = data[-2] >> 4
            if self._counters.get(can_id) == counter:
                return self._drop("counter")
        values = message.decode(data)
        if message.in_range is not None and not message.in_range(values):
            return self._drop("range")
        if counter >= 0:
            self._counters[can_id] = counter
        return Received(message, number, values, counter)

    def _drop(self, kind: str) -> Received | None:
        self.dropped[kind] += 1
        return None


def pack_quaternion(q: Sequence[float]) -> tuple[int, int, int, int]:
    """A unit quaternion (w, x, y, z) as TAG_ATTITUDE carries it: index of the largest component, the other three raw.

    Smallest three: the largest is made positive and left out, the others lie in +-1/sqrt(2), raw 0..510, 255 for zero.
    """
    w, x, y, z = (float(c) for c in q)
    components = [w, x, y, z]
    largest = max(range(4), key=lambda i: abs(components[i]))
    scale = math.copysign(255.0 * math.sqrt(2.0), components[largest])
    del components[largest]
    a, b, c = (min(510, max(0, round(255.0 + scale * value))) for value in components)
    return largest, a, b, c


def unpack_quaternion(largest: int, a: int, b: int, c: int) -> np.ndarray:
    """(4,) unit quaternion of the four raw values of TAG_ATTITUDE; the component left out is not negative."""
    scale = 1.0 / (255.0 * math.sqrt(2.0))
    components = [(a - 255) * scale, (b - 255) * scale, (c - 255) * scale]
    square = sum(value * value for value in components)
    components.insert(largest, math.sqrt(max(0.0, 1.0 - square)))
    q = np.array(components)
    return q / math.sqrt(square) if square > 1.0 else q


def _numbers(name: str) -> frozenset[int]:
    """Numbers that are valid for a message: DESIGN section 5 (0 firmware, 1..29 modules, 30 e-stop box, 31 camera)."""
    if name in ("ESTOP", "HEARTBEAT"):
        return frozenset(range(NUMBERS))
    return frozenset((0,)) if name == "SYNC" else frozenset(range(1, 30))


def _field(message: Any, signal: Any) -> Field:
    if signal.byte_order != "little_endian" or signal.minimum is None or signal.maximum is None:
        raise CodecError(f"{message.name}.{signal.name}: needs little endian and limits")
    factor, offset = signal.scale, signal.offset
    low, high = (round((limit - offset) / factor) for limit in (signal.minimum, signal.maximum))
    return Field(
        signal.name, signal.start, signal.length, signal.is_signed, factor, offset, low, high, signal.unit or ""
    )


def _is_number(value: float) -> bool:
    try:
        return not math.isnan(value)
    except TypeError:
        return False


def _decode_source(fields: Sequence[Field]) -> str:
    items = []
    for field in fields:
        raw = f"(x >> {field.start} & {(1 << field.bits) - 1})"
        if field.signed:
            half = 1 << field.bits - 1
            raw = f"(({raw} ^ {half}) - {half})"
        shift = f" + {field.offset!r}" if field.offset else ""
        items.append(raw if field.is_integer else f"{raw} * {field.factor!r}{shift}")
    return f"lambda x: ({' '.join(item + ',' for item in items)})"


def _encode_source(fields: Sequence[Field]) -> str:
    """`round` of a value that passed both comparisons: NaN fails them and makes round() raise ValueError."""
    lines = ["def pack(values):"]
    names = [f"v{index}" for index in range(len(fields))]
    lines.append(f"    ({''.join(name + ', ' for name in names)}) = values")
    terms = []
    for name, field in zip(names, fields, strict=True):
        if not field.is_integer:
            shift = f" - {field.offset!r}" if field.offset else ""
            lines.append(f"    {name} = ({name}{shift}) / {field.factor!r}")
        limited = f"{field.raw_low} if {name} <= {field.raw_low} else {field.raw_high} if {name} >= {field.raw_high}"
        terms.append(f"(({limited} else round({name})) & {(1 << field.bits) - 1}) << {field.start}")
    lines.append(f"    return {' | '.join(terms) or '0'}")
    return "\n".join(lines)


def _range_source(fields: Sequence[Field]) -> str:
    checks = []
    for index, field in enumerate(fields):
        low, high = field.raw_range
        if field.raw_low > low:
            checks.append(f"v[{index}] >= {field.raw_low * field.factor + field.offset!r}")
        if field.raw_high < high:
            checks.append(f"v[{index}] <= {field.raw_high * field.factor + field.offset!r}")
    return f"lambda v: {' and '.join(checks)}" if checks else ""


def _compile(source: str) -> Any:
    """The function that `source` defines: a lambda, or a def called pack."""
    if source.startswith("lambda"):
        return eval(source, {"__builtins__": {}})
    namespace: dict[str, Any] = {"__builtins__": {"round": round}}
    exec(source, namespace)
    return namespace["pack"]
