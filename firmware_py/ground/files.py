"""Files that must never be half written, and a thread that writes them, so that nothing else waits for a disk."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue

RETRY_S = 1.0
"""Delay before a failed write is tried again."""
Write = Callable[[Path, bytes, int], None]
"""Writes contents into a file, with its mode. Raises OSError."""


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
    """Writes files in a thread of its own. Of several contents for one file it writes the newest, and tries again until that succeeds.

    Create it before this process takes its real-time priority, which the thread would inherit.
    """

    def __init__(self, close_s: float, write: Write = write_atomically) -> None:
        """`close_s`: how long `close` waits for a disk at most."""
        self._close_s, self._write = close_s, write
        self._wanted: dict[Path, tuple[bytes, int]] = {}
        """Contents and mode of each file that is still to be written."""
        self._failing: set[Path] = set()
        self._failed: SimpleQueue[tuple[Path, OSError]] = SimpleQueue()
        self._changed = threading.Condition()
        self._fresh = self._ended = False
        """Whether contents were queued that were not tried yet; whether the thread is to end."""
        self._thread = threading.Thread(target=self._run, name="file writer", daemon=True)
        self._thread.start()

    def write(self, path: Path, data: bytes, mode: int = 0o644) -> None:
        """Queues the new contents of a file."""
        with self._changed:
            self._wanted[path], self._fresh = (data, mode), True
            self._changed.notify()

    def failures(self) -> list[tuple[Path, OSError]]:
        """Files that began to fail since the last call, and why. A file is named again only after it was written meanwhile."""
        return [self._failed.get() for _ in range(self._failed.qsize())]

    def close(self) -> None:
        """Tries once more what is queued, and ends the thread; a second call does nothing."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(self._close_s)

    def _run(self) -> None:
        ended = False
        while not ended:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._fresh, RETRY_S if self._wanted else None)
                ended, wanted, self._fresh = self._ended, self._wanted.copy(), False
            for path, content in wanted.items():
                self._try(path, content)

    def _try(self, path: Path, content: tuple[bytes, int]) -> None:
        try:
            self._write(path, *content)
        except OSError as error:
            if path not in self._failing:
                self._failed.put((path, error))
            self._failing.add(path)
            return
        self._failing.discard(path)
        with self._changed:
            if self._wanted[path] is content:  # else it was queued again meanwhile
                del self._wanted[path]
