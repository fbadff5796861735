"""Files that cannot stop the vehicle: an error ends the log and nothing else, and a disk that stalls holds nobody up."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path
from queue import SimpleQueue

MOST_WAITING_BYTES = 8_000_000
"""A minute and a half of one module at 100 Hz; a disk that is farther behind ends the log."""
CLOSE_S = 5.0
"""How long the end of a run waits for a disk."""
_SYNC = b""
"""Among what waits for the thread of a QueuedFile: all before it is to be on the disk."""


class GuardedFile:
    """A file whose errors are kept instead of raised: after the first one it takes everything and writes nothing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.error: OSError | None = None
        self._position = 0
        self._file = None
        try:
            self._file = path.open("wb", buffering=0)  # bytes given are with the system: kill -9 loses none
        except OSError as error:
            self.error = error

    def write(self, data: bytes | bytearray) -> int:
        """Append; always says that all was taken."""
        if self.error is None:
            try:
                self._append(data)
            except OSError as error:
                self.error = error
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
        if self.error is None:
            try:
                self._to_disk()
            except OSError as error:
                self.error = error

    def _to_disk(self) -> None:
        if self._file is not None:
            os.fsync(self._file.fileno())

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
        self._queue: SimpleQueue[bytes | None] = SimpleQueue()
        self._given = self._written = 0
        self._thread = threading.Thread(target=self._run, name=f"log {path.name}", daemon=True)
        self._thread.start()

    def _append(self, data: bytes | bytearray) -> None:
        if self._given - self._written > MOST_WAITING_BYTES:
            raise OSError(errno.ENOBUFS, "the disk does not keep up")
        self._given += len(data)
        if data:
            self._queue.put(bytes(data))

    def _to_disk(self) -> None:
        self._queue.put(_SYNC)

    def _run(self) -> None:
        broken = False
        while (data := self._queue.get()) is not None:
            try:
                if not broken:
                    super()._append(data) if data else super()._to_disk()
            except OSError as error:
                broken, self.error = True, self.error or error
            self._written += len(data)
        super().close()

    def close(self) -> None:
        """Writes what waits, for CLOSE_S at the most; a second time does nothing."""
        self._queue.put(None)
        self._thread.join(CLOSE_S)
