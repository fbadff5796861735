"""Keeps for the next process whether an e-stop stands: one small file in the folder of the logs, which survives a full disk, a damaged
log and power loss.

Both contents have the same length: on a full disk an existing file can be overwritten, but not extended.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from firmware_py.app.firmware import BusFrame
from firmware_py.app.observers import Observer
from firmware_py.core.transitions import State
from firmware_py.core.types import WARNING, Action, Event, Inputs, Outputs
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.files import FileWriter, write_atomically
from firmware_py.runtime.recorder import Recorder

NOTE = "estop.txt"
STANDS, CLEAR = b"stands\n", b"clear \n"
CLOSE_S = 5.0
"""How long the end of a run waits for a disk."""


def estop_stands(folder: Path) -> bool:
    """Whether the note in `folder` says that an e-stop stands. True, the safe answer, for an unreadable note or other content."""
    try:
        return (folder / NOTE).read_bytes() != CLEAR
    except (FileNotFoundError, NotADirectoryError):
        return False  # no process that logged here reached a tick
    except OSError:
        return True


def write_note(folder: Path, stands: bool) -> None:
    """Writes the note into `folder` and syncs it to the disk before it returns. Raises OSError."""
    path, data = folder / NOTE, STANDS if stands else CLEAR
    try:
        with path.open("r+b", buffering=0) as file:
            file.write(data)
            file.truncate(len(data))
            os.fsync(file.fileno())
    except OSError:  # no note yet, another user's, or a disk without room to overwrite it
        write_atomically(path, data)


def clear(folder: Path) -> bool:
    """Clears the note in `folder`, on a person's order; returns whether an e-stop stood. Raises DescriptionError and OSError.

    Refused while a vehicle runs there, because that vehicle's own e-stop would remain.
    """
    if not (folder / NOTE).exists():
        raise DescriptionError(f"{folder} holds no {NOTE}: no vehicle has logged there; give the folder of modcube run --out")
    handle = lock_folder(folder)
    if handle is None:
        raise DescriptionError(f"a vehicle that runs logs into {folder}: end it first, or send it CLEAR_ESTOP")
    try:
        stood = estop_stands(folder)
        write_note(folder, False)
    finally:
        os.close(handle)
    return stood


def lock_folder(folder: Path) -> int | None:
    """Locks `folder` exclusively; returns a handle to close for release. None where another process holds the lock. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(handle)
        if isinstance(error, BlockingIOError):
            return None
        raise
    return handle


class EstopNote:
    """Writes the note in its own thread, so that no tick waits for a disk. Create it before this process takes its real-time priority.
    Holds the lock on the folder until `close`. Raises DescriptionError where another process holds it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._handle: int | None = None
        with suppress(OSError):  # a folder that cannot be opened is reported by the first failed write
            self._handle = lock_folder(folder)
            if self._handle is None:
                raise DescriptionError(f"another vehicle that runs logs into {folder}: end it first, or give this one another --out")
        self._writer = FileWriter(CLOSE_S, self._keep)

    def write(self, stands: bool) -> None:
        """Queues a write. A failed write is retried until it succeeds or a newer one replaces it."""
        self._writer.write(self._folder / NOTE, STANDS if stands else CLEAR)

    def failures(self) -> list[Event]:
        """A warning that writes fail, if that was not reported yet."""
        failures = self._writer.failures()
        return [Event(WARNING, f"the next start will not know of an e-stop: {path.name}: {error.strerror}") for path, error in failures]

    def close(self) -> None:
        """Writes what is queued, waiting at most CLOSE_S, and releases the folder; a second call does nothing."""
        self._writer.close()
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def _keep(self, path: Path, data: bytes, mode: int) -> None:
        try:
            write_note(path.parent, data == STANDS)
        finally:
            if self._handle is None:  # the folder did not exist before
                with suppress(OSError):
                    self._handle = lock_folder(self._folder)


def noting_estop(note: EstopNote, stands: bool, recorder: Recorder | None = None) -> Observer:
    """An observer that keeps the note of the e-stop for the next process. An e-stop stands from when it is raised, or from before this
    process (`stands`), until a person clears it or arms.

    The first tick writes the note already, in case the disk fills up later. When an e-stop is raised, the note and the log (`recorder`)
    go to the disk at once, because a person who pressed a stop tends to cut the power next. Every e-stop raised is written, even while
    one stands, because a person may have cleared the note by hand meanwhile.
    """
    noted: bool | None = None
    raised = False

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        nonlocal stands, noted, raised
        if stands:
            cleared = any(request.action == Action.CLEAR_ESTOP for request in inputs.requests)
            stands = not cleared and not any(command.armed for command in outputs.modules)
        was_raised, raised = raised, any(record.state == State.ESTOP for record in outputs.records)
        stands = stands or raised
        if stands != noted or (raised and not was_raised):
            note.write(stands)
            if recorder is not None and (stands or noted is not None):
                outputs.events += recorder.flush(to_disk=True)
            noted = stands
        outputs.events += note.failures()

    return observe
