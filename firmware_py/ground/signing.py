"""MAVLink 2 signing: which frames are believed. Verifies before it stores anything: a forged packet changes only counts.

Source: MAVLink developer guide, "Message Signing". Times are in units of 10 us since 1 January 2015, UTC.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

KEY_BYTES = 32
FILE_MODE = 0o600
SIGNATURE_BYTES = 13
EPOCH_S = 1_420_070_400
"""1 January 2015 as Unix time."""
_UNITS_PER_S = 100_000
_NEW_STREAM_UNITS = 60 * _UNITS_PER_S
"""How far a new stream may be behind: one minute."""
_AHEAD_UNITS = 60 * _UNITS_PER_S
"""How far a time stamp may be ahead of the clock: one minute."""
_FLOOR_MARGIN = _UNITS_PER_S
"""Margin by which the stored time stamp is ahead; as long as the interval at which it is stored."""
_MOST_STREAMS = 256
_LATEST = (1 << 48) - 1
"""Largest possible time stamp."""
RADIO_STATUS = 109
"""The one message that is believed unsigned: radios inject it and have no key."""

Stream = tuple[int, int, int]
"""Link id, system, component."""


def units_of(unix_ns: int) -> int:
    """Signing time of a Unix time."""
    return max(0, unix_ns - EPOCH_S * 1_000_000_000) // 10_000


@dataclass(slots=True)
class Signing:
    """Key, own time stamp, and the newest time stamp of every believed stream."""

    key: bytes | None = None
    timestamp: int = 0
    """Time stamp that the next frame sent exceeds by one; at least that of every believed frame."""
    clock: int = 0
    """Latest time of day received by `advance`; 0: none."""
    floor: int = 0
    """New streams must start above this, so that no frame from before the last start is believed again."""
    streams: dict[Stream, int] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    """Frames by outcome: good, unsigned, bad, ahead, replayed, old, full."""
    changed: bool = False
    """Whether there is something to store. Whoever stores it clears this."""

    def advance(self, unix_ns: int) -> None:
        """Follows the clock. Neither clock nor time stamp goes back, since stations continue from the time stamps that they heard."""
        self.clock = max(self.clock, units_of(unix_ns))
        self.timestamp = max(self.timestamp, self.clock)

    def is_ahead(self, stamp: int) -> bool:
        """Whether a time stamp is in the future. False while the clock is not set or lags the stored time stamp, and so cannot tell."""
        is_set = self.clock > max(0, self.floor - _AHEAD_UNITS - _FLOOR_MARGIN)
        return is_set and stamp > self.clock + _AHEAD_UNITS

    def adopt(self, key: bytes, timestamp: int) -> None:
        """Takes a new key; all zeros turn signing off."""
        self.key = key if any(key) else None
        self.timestamp = max(self.timestamp, min(timestamp, _LATEST))
        self.streams.clear()
        self.changed = True

    def sign(self, frame: bytes, link: int) -> bytes:
        """Returns the signature of 13 bytes that follows `frame`."""
        assert self.key is not None
        self.timestamp = min(self.timestamp + 1, _LATEST)
        tail = bytes([link & 0xFF]) + self.timestamp.to_bytes(6, "little")
        return tail + _digest(self.key, frame + tail)

    def believes(self, frame: bytes, signature: bytes, message: int, system: int, component: int) -> bool:
        """Whether a frame with a valid checksum may take effect. `signature` is empty for an unsigned frame."""
        if self.key is None:
            return True
        if not signature:
            self.counts["unsigned"] += 1
            return message == RADIO_STATUS
        if not hmac.compare_digest(_digest(self.key, frame + signature[:7]), signature[7:]):
            self.counts["bad"] += 1
            return False
        return self._is_new(int.from_bytes(signature[1:7], "little"), (signature[0], system, component))

    def _is_new(self, stamp: int, stream: Stream) -> bool:
        newest = self.streams.get(stream)
        verdict = "good"
        if self.is_ahead(stamp):
            verdict = "ahead"
        elif newest is not None and stamp <= newest:
            verdict = "replayed"
        elif newest is None and (stamp <= self.floor or stamp < self.timestamp - _NEW_STREAM_UNITS):
            verdict = "old"
        elif newest is None and len(self.streams) >= _MOST_STREAMS:
            verdict = "full"
        self.counts[verdict] += 1
        if verdict != "good":
            return False
        self.streams[stream] = stamp
        self.timestamp = max(self.timestamp, stamp)
        self.changed = True
        return True

    def to_json(self) -> str:
        """Returns key and time stamp as `load_signing` reads them, from a file that only its owner may read (FILE_MODE)."""
        newest = max([self.floor - _FLOOR_MARGIN, *self.streams.values()])
        return json.dumps({"key": self.key.hex() if self.key else "", "timestamp": newest + _FLOOR_MARGIN})


def load_signing(path: Path) -> Signing:
    """Reads the signing state from `path`; without a file there is no key.

    Raises:
        ValueError: the file exists but is invalid, or others may read it; one line. Never falls back to no key.
    """
    if not path.exists():
        return Signing()
    if path.stat().st_mode & 0o077:
        raise ValueError(f"{path}: others may read this key; allow it only to its owner: chmod 600 {path}")
    try:
        table = json.loads(path.read_text())
        key, stamp = bytes.fromhex(table["key"]), int(table["timestamp"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a key file: {error}") from None
    if len(key) not in (0, KEY_BYTES):
        raise ValueError(f"{path}: the key has {len(key)} bytes; it needs {KEY_BYTES}")
    return Signing(key=key or None, timestamp=stamp, floor=stamp)


def _digest(key: bytes, covered: bytes) -> bytes:
    return hashlib.sha256(key + covered).digest()[:6]
