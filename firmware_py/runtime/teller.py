"""Prints the messages of the vehicle's process line by line, in its own thread, so that a stalled reader blocks no tick."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue

MOST_WAITING_LINES = 1000
"""Longest queue of lines, 100 kB of memory. Further lines are dropped and counted."""
CLOSE_S = 1.0
"""How long the end of a run waits for a reader."""
_STDOUT = 1


def write_line(line: str) -> None:
    """Writes one line to standard output. Bypasses Python's buffer, in which a blocked thread makes the process abort at its end."""
    data = f"{line}\n".encode(errors="backslashreplace")  # file names need not be valid text
    while data:
        data = data[os.write(_STDOUT, data) :]


class Teller:
    """Prints lines in order, beside the loop. Create it before this process takes its real-time priority."""

    def __init__(self, write: Callable[[str], None] = write_line) -> None:
        """`write` may block for any time; after it raises OSError or ValueError (no reader) nothing more is printed."""
        self._write = write
        self._queue: SimpleQueue[str | None] = SimpleQueue()
        self._given = self._said = self._dropped = 0
        self._thread = threading.Thread(target=self._run, name="teller", daemon=True)
        self._thread.start()

    def say(self, line: str) -> None:
        """Queues a line; never blocks. Call it from one thread only."""
        if self._given - self._said >= MOST_WAITING_LINES:
            self._dropped += 1
            return
        self._put_count()
        self._put(line)

    def close(self) -> None:
        """Prints what is queued, waiting at most CLOSE_S; a second call does nothing."""
        self._put_count()
        self._queue.put(None)
        self._thread.join(CLOSE_S)

    def _put_count(self) -> None:
        if self._dropped:
            self._put(f"warning: {self._dropped} lines dropped here: they were not read in time")
            self._dropped = 0

    def _put(self, line: str) -> None:
        self._given += 1
        self._queue.put(line)

    def _run(self) -> None:
        try:
            while (line := self._queue.get()) is not None:
                self._write(line)
                self._said += 1
        except (OSError, ValueError):
            return  # from here on the queue fills up, and `say` drops further lines
