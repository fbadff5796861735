"""Cache of drag outlines on disk. A file that is damaged, truncated, of an older version or of another shape is never used.

File: one line of text (magic, version, shape of the array), one line with the key, one with the SHA-256 of key and data,
then little-endian float64.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_MAGIC = "modcube drag outlines"

VERSION = 1
"""Increment it when the meaning of the figures changes: older files are then rebuilt."""


def default_folder(environment: Mapping[str, str], home: Path) -> Path:
    """The user's cache folder by the XDG base directory specification: $XDG_CACHE_HOME or ~/.cache."""
    base = environment.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else home / ".cache") / "modcube" / "drag"


@dataclass(frozen=True, slots=True)
class DragCache:
    """One folder of cached outlines.

    Attributes:
        folder: holds the files; created when the first is stored.
    """

    folder: Path

    def path_of(self, key: str) -> Path:
        """File for `key`; same key, same file."""
        return self.folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.drag"

    def load(self, key: str, shape: tuple[int, ...]) -> np.ndarray | None:
        """The array stored under `key`, or None where there is no valid one."""
        try:
            raw = self.path_of(key).read_bytes()
        except OSError:
            return None
        data = raw[len(_header(key, shape, b"")) :]
        if len(data) != 8 * int(np.prod(shape)) or raw != _header(key, shape, data) + data:
            return None
        values = np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)
        return values if bool(np.all(np.isfinite(values))) else None

    def store(self, key: str, values: np.ndarray) -> None:
        """Stores `values` under `key`. A folder that cannot be written is no error; it only costs the next run time."""
        data = np.ascontiguousarray(values, dtype="<f8").tobytes()
        path = self.path_of(key)
        partial = path.with_suffix(f".{os.getpid()}.part")
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(_header(key, values.shape, data) + data)
            os.replace(partial, path)


def _header(key: str, shape: tuple[int, ...], data: bytes) -> bytes:
    check = hashlib.sha256(key.encode() + data).hexdigest()
    return f"{_MAGIC} {VERSION} {shape}\n{key}\n{check}\n".encode()
