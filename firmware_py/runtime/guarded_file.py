"""Files that cannot stop the vehicle: an error ends the log and nothing else, and a disk that stalls holds nobody up."""

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
"""A minute and a half of one module at 100 Hz; a disk that is farther behind ends the log."""
CLOSE_S = 5.0
"""How long the end of a run waits for a disk."""


class GuardedFile:
    """A file that never raises. After its first error it accepts and drops every write, and its modification time is set to 1970: such a
    log lacks its end, and `app.last_flight`, which trusts recent logs alone, must not go by it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.error: OSError | None = None
        self._position = 0
        self._file = None
        try:
            self._file = path.open("wb", buffering=0)  # bytes given are with the system: kill -9 loses none
        except OSError as error:
            self.error = error
            return
        with suppress(OSError):
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until it is closed: it is being written

    def write(self, data: bytes | bytearray) -> int:
        """Append; always says that all was taken."""
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
        """Nothing is held back."""

    def sync(self) -> None:
        """What was written is to outlive a power cut too."""
        self._attempt(self._to_disk)

    def _attempt(self, job: Callable[[], None]) -> None:
        """Does what the disk may refuse, unless it has before."""
        if self.error is None:
            try:
                job()
            except OSError as error:
                self.error = error
                self._date_back()

    def _to_disk(self) -> None:
        if self._file is not None:
            os.fsync(self._file.fileno())

    def _date_back(self) -> None:
        if self._file is not None:
            with suppress(OSError):
                os.utime(self._file.fileno(), ns=(0, 0))

    def close(self) -> None:
        """Close; a second time does nothing."""
        if self._file is not None:
            try:
                self._file.close()
            except OSError as error:
                self.error = self.error or error
            self._file = None


class QueuedFile(GuardedFile):
    """The same, written by a thread of its own. It is to be made before this process takes its real-time priority."""

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
        """By the thread: what the disk does not take ends the log."""
        try:
            if not self._broken:
                job()
        except OSError as error:
            self._broken, self.error = True, self.error or error
            super()._date_back()
        self._written += length

    def close(self) -> None:
        """Writes what waits, for CLOSE_S at the most; a second time does nothing."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
