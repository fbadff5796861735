"""What the vehicle's process says, a line each. It is said by a thread of its own: a reader who stops reading holds up no tick."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue

MOST_WAITING_LINES = 1000
"""What does not fit is dropped and counted: 100 kB of memory."""
CLOSE_S = 1.0
"""How long the end of a run waits for a reader."""
_STDOUT = 1


def write_line(line: str) -> None:
    """One line on standard output. Past Python's buffer: a thread that stands still in it ends the process by an abort."""
    data = f"{line}\n".encode(errors="backslashreplace")  # what the system calls a file need be no text
    while data:
        data = data[os.write(_STDOUT, data) :]


class Teller:
    """Says lines in order, beside the loop. It is to be made before this process takes its real-time priority."""

    def __init__(self, write: Callable[[str], None] = write_line) -> None:
        """`write` may wait as long as it likes; once it raises OSError or ValueError (nobody listens) no more is said."""
        self._write = write
        self._queue: SimpleQueue[str | None] = SimpleQueue()
        self._given = self._said = self._dropped = 0
        self._thread = threading.Thread(target=self._run, name="teller", daemon=True)
        self._thread.start()

    def say(self, line: str) -> None:
        """Queue a line; never waits. For one thread."""
        if self._given - self._said >= MOST_WAITING_LINES:
            self._dropped += 1
            return
        self._put_count()
        self._put(line)

    def close(self) -> None:
        """Says what waits, for CLOSE_S at the most; a second time does nothing."""
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
            return  # the queue fills up, and takes no more
