"""Files that must never be half written, and a thread that writes them, so that nothing else waits for a disk."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue

RETRY_S = 1.0
"""Delay before a failed write is tried again."""
CLOSE_S = 1.0
"""How long the end of a run waits for a disk: the log and the e-stop note are closed after it, within the service's five seconds."""


def write_atomically(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Replaces the file by `data`, or leaves it unchanged. On return both contents and directory entry are on disk. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(path.name + ".new")
    fresh.unlink(missing_ok=True)
    descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(descriptor)
        os.replace(fresh, path)
    except OSError:
        with suppress(OSError):
            fresh.unlink()
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class FileWriter:
    """Writes files in a thread of its own. Of several contents for one file it writes the newest, and tries again until that succeeds."""

    def __init__(self) -> None:
        self._wanted: dict[Path, tuple[bytes, int]] = {}
        """Contents and mode of each file that is still to be written."""
        self._failing: set[Path] = set()
        self._failed: SimpleQueue[tuple[Path, OSError]] = SimpleQueue()
        self._changed = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="file writer", daemon=True)
        self._thread.start()

    def write(self, path: Path, data: bytes, mode: int = 0o644) -> None:
        """Queues the new contents of a file."""
        with self._changed:
            self._wanted[path] = data, mode
            self._changed.notify()

    def failures(self) -> list[tuple[Path, OSError]]:
        """Files that began to fail since the last call, and why. A file is named again only after it was written meanwhile."""
        return [self._failed.get() for _ in range(self._failed.qsize())]

    def close(self) -> None:
        """Tries once more what is queued, waiting at most CLOSE_S, and ends the thread; a second call does nothing."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        ended = False
        while not ended:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._wanted.keys() - self._failing, RETRY_S if self._failing else None)
                ended, wanted = self._ended, self._wanted.copy()
            for path, (data, mode) in wanted.items():
                self._write(path, data, mode)

    def _write(self, path: Path, data: bytes, mode: int) -> None:
        try:
            write_atomically(path, data, mode)
        except OSError as error:
            if path not in self._failing:
                self._failed.put((path, error))
            self._failing.add(path)
            return
        self._failing.discard(path)
        with self._changed:
            if self._wanted[path] == (data, mode):
                del self._wanted[path]
