"""Whether an e-stop stands, for the next process: one small file in the folder of the logs, which no full disk, spoilt log or pulled plug
takes away.

It has one length whatever it says: a disk that is full has no room for more, but what is there can be written over.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue

from firmware_py.app.firmware import BusFrame
from firmware_py.app.observers import Observer
from firmware_py.core.transitions import State
from firmware_py.core.types import WARNING, Action, Event, Inputs, Outputs
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.files import write_atomically
from firmware_py.runtime.recorder import Recorder

NOTE = "estop.txt"
STANDS, CLEAR = b"stands\n", b"clear \n"
CLOSE_S = 5.0
"""How long the end of a run waits for a disk."""
AGAIN_S = 1.0
"""How long after a note could not be written it is tried again."""


def estop_stands(folder: Path) -> bool:
    """Whether the note in `folder` says so. One that says neither, or cannot be read, does: who cannot tell arms nobody."""
    try:
        return (folder / NOTE).read_bytes() != CLEAR
    except (FileNotFoundError, NotADirectoryError):
        return False  # no process that logged here came to a tick
    except OSError:
        return True


def write_note(folder: Path, stands: bool) -> None:
    """Notes in `folder` that an e-stop stands, or that none does; when this returns it is on the disk. Raises OSError."""
    path, data = folder / NOTE, STANDS if stands else CLEAR
    try:
        with path.open("r+b", buffering=0) as file:
            file.write(data)
            file.truncate(len(data))
            os.fsync(file.fileno())
    except OSError:  # there is none, it is somebody else's, or this disk has no room to write over it
        write_atomically(path, data)


def clear(folder: Path) -> bool:
    """Notes in `folder` that no e-stop stands, for a person; returns whether one did. Raises DescriptionError and OSError.

    Refused while a vehicle runs there: its own e-stop would stand on.
    """
    if not (folder / NOTE).exists():
        raise DescriptionError(f"{folder} holds no {NOTE}: no vehicle has logged there; give the folder of modcube run --out")
    handle = hold(folder)
    if handle is None:
        raise DescriptionError(f"a vehicle that runs logs into {folder}: end it first, or send it CLEAR_ESTOP")
    try:
        stood = estop_stands(folder)
        write_note(folder, False)
    finally:
        os.close(handle)
    return stood


def hold(folder: Path) -> int | None:
    """A handle, to be closed to let go of `folder`; until then nobody else has it. None where somebody else does. Raises OSError."""
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
    """Writes the note by a thread of its own: no tick waits for a disk. To be made before this process takes its real-time priority.
    Until `close`, nobody else writes it. Raises DescriptionError where somebody else has the folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._handle: int | None = None
        with suppress(OSError):  # a folder that cannot be opened is said by the first note that it does not take
            self._handle = hold(folder)
            if self._handle is None:
                raise DescriptionError(f"another vehicle that runs logs into {folder}: end it first, or give this one another --out")
        self._queue: SimpleQueue[bool | None] = SimpleQueue()
        self._failed: SimpleQueue[OSError] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="e-stop note", daemon=True)
        self._thread.start()

    def write(self, stands: bool) -> None:
        """As soon as the disk takes it: what it does not take is tried again, until something else is to be written."""
        self._queue.put(stands)

    def failures(self) -> list[Event]:
        """A warning for one that could not be written, where there is any that was not told of."""
        if self._failed.empty():
            return []
        return [Event(WARNING, f"the next start will not know of an e-stop: {NOTE}: {self._failed.get().strerror}")]

    def close(self) -> None:
        """Writes what waits, for CLOSE_S at the most; a second time does nothing."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def _run(self) -> None:
        waiting: bool | None = None
        ended = False
        while not ended:
            fresh = False
            with suppress(Empty):
                told = self._queue.get(timeout=None if waiting is None else AGAIN_S)
                fresh, ended = told is not None, told is None
                waiting = waiting if ended else told
            try:
                if waiting is not None:
                    write_note(self._folder, waiting)
                waiting = None
            except OSError as error:
                if fresh:
                    self._failed.put(error)
            if self._handle is None:  # there was no folder before
                with suppress(OSError):
                    self._handle = hold(self._folder)


def noting_estop(note: EstopNote, stands: bool, recorder: Recorder | None = None) -> Observer:
    """An observer that notes for the next process whether an e-stop stands: from one on, and where one stood before this process
    (`stands`), until a person clears it or arms. The note is there from the first tick on, for a disk that is full later; it and the log
    (`recorder`) are soon on the disk when one is raised: who has pressed a stop pulls the plug next. Each that is raised is noted, also
    while one stands: a person may have cleared that by hand meanwhile.
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
