"""Log folders of the vehicle's process: the given folder, or 0002, 0003, ... in it once it holds a log.

A service that restarts after a crash thus keeps the log of the crash.
"""

from __future__ import annotations

from pathlib import Path

from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG

_FIRST = 1
_DIGITS = 4


def make_log_folder(out: Path) -> Path:
    """Creates a folder for a new log: `out`, or a folder in it with the next number. Raises OSError."""
    number = max(_numbers(out), default=_FIRST - 1) + 1
    folder = _folder(out, number)
    folder.mkdir(parents=True, exist_ok=number == _FIRST)
    return folder


def log_folders(out: Path) -> list[Path]:
    """The folders of the logs under `out`, newest first; empty where `out` cannot be read."""
    try:
        return [_folder(out, number) for number in sorted(set(_numbers(out)), reverse=True)]
    except OSError:
        return []


def _numbers(out: Path) -> list[int]:
    """Numbers of the logs under `out`; a log in `out` itself is number 1."""
    if not out.is_dir():
        return []
    names = [path.name for path in out.iterdir()]
    numbers = [int(name) for name in names if len(name) >= _DIGITS and name.isdecimal()]
    return numbers + [_FIRST for name in names if name in (CAN_LOG, SIGNAL_LOG)]


def _folder(out: Path, number: int) -> Path:
    return out if number == _FIRST else out / f"{number:0{_DIGITS}d}"
