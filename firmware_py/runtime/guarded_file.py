"""Files that cannot stop the vehicle: an error ends only the log, and a stalled disk blocks no tick."""

from __future__ import annotations

import errno
import fcntl
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue

MOST_WAITING_BYTES = 8_000_000
"""A minute and a half of one module's log at 100 Hz; a longer backlog ends the log."""
DATED_BACK_NS = 0
"""Modification time, Unix, of a log that was ended before its flight."""
CLOSE_S = 5.0
"""How long the end of a run waits for a disk."""


class GuardedFile:
    """A file that never raises. After its first error it silently drops every write, and its modification time is set to 1970: such a log
    lacks its end, so `app.last_flight`, which trusts only recent logs, must not use it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.error: OSError | None = None
        self._position = 0
        self._file = None
        try:
            self._file = path.open("wb", buffering=0)  # unbuffered: written bytes survive kill -9
        except OSError as error:
            self.error = error
            return
        with suppress(OSError):
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # marks the log as being written until it is closed

    def write(self, data: bytes | bytearray) -> int:
        """Append `data`; always returns its full length."""
        self._attempt(partial(self._append, data))
        self._position += len(data)
        return len(data)

    def _append(self, data: bytes | bytearray) -> None:
        view = memoryview(data)
        while view and self._file is not None:
            view = view[self._file.write(view) :]

    def seek(self, offset: int, whence: int = 0) -> int:
        """The position; the log is written forward only."""
        return self._position

    def flush(self) -> None:
        """Does nothing: the file is unbuffered."""

    def sync(self) -> None:
        """Syncs everything written to the disk, so that it survives a power cut."""
        self._attempt(self._to_disk)

    def _attempt(self, job: Callable[[], None]) -> None:
        """Runs a disk operation, unless one failed before; stores its error."""
        if self.error is None:
            try:
                job()
            except OSError as error:
                self.error = error
                self._date_back()

    def give_up(self) -> None:
        """Ends the file here, as an error of the disk does, for a writer that fails otherwise."""
        if self.error is None:
            self.error = OSError(errno.ECANCELED, os.strerror(errno.ECANCELED))
            self._date_back()

    def _to_disk(self) -> None:
        if self._file is not None:
            os.fsync(self._file.fileno())

    def _date_back(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                os.utime(self._file.fileno(), ns=(DATED_BACK_NS, DATED_BACK_NS))

    def close(self) -> None:
        """Close; a second call does nothing."""
        if self._file is not None:
            try:
                self._file.close()
            except OSError as error:
                self.error = self.error or error
            self._file = None


class QueuedFile(GuardedFile):
    """A GuardedFile written by its own thread. Create it before this process takes its real-time priority."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._queue: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._given = self._written = 0
        self._broken = False
        self._thread = threading.Thread(target=self._run, name=f"log {path.name}", daemon=True)
        self._thread.start()

    def _append(self, data: bytes | bytearray) -> None:
        if self._given - self._written > MOST_WAITING_BYTES:
            raise OSError(errno.ENOBUFS, "the disk does not keep up")
        kept = bytes(data)
        self._given += len(kept)
        self._queue.put(partial(self._try, partial(super()._append, kept), len(kept)))

    def _to_disk(self) -> None:
        self._queue.put(partial(self._try, super()._to_disk))

    def _date_back(self) -> None:
        self._queue.put(super()._date_back)

    def _run(self) -> None:
        while (job := self._queue.get()) is not None:
            job()
        super().close()

    def _try(self, job: Callable[[], None], length: int = 0) -> None:
        """Runs a disk operation in the thread; an error ends the log."""
        try:
            if not self._broken:
                job()
        except OSError as error:
            self._broken, self.error = True, self.error or error
            super()._date_back()
        self._written += length

    def close(self) -> None:
        """Writes what is queued, waiting at most CLOSE_S; a second call does nothing."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
