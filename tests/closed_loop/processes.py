"""Commands of `modcube` as separate processes, which end at a deadline or with the test, however it goes."""

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

DIE_WITH_TEST = f"from firmware_py.runtime.realtime import die_with; die_with({os.getpid()})"
MODCUBE = [sys.executable, "-c", f"{DIE_WITH_TEST}; from firmware_py.cli import main; main()"]
DEADLINE_S = 300.0
"""Longest time that a process may take on a machine that is busy with other tests."""


def free_group() -> str:
    """A multicast address that no other process on this machine uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"udp:239.74.163.9:{probe.getsockname()[1]}"


class Running:
    """A running command, in its own session."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.pid = process.pid

    def wait_for(self, *words: str) -> None:
        """Reads until a line holds all of `words`."""
        assert self._process.stdout is not None
        said = []
        for line in self._process.stdout:
            said.append(line)
            if all(word in line for word in words):
                return
        raise AssertionError(f"it ended by itself or after {DEADLINE_S:.0f} s, and never said {words}: {said}")

    def end(self, how: signal.Signals = signal.SIGINT) -> str:
        """Sends the signal, waits until every process has closed the output, and returns the rest of it."""
        self._process.send_signal(how)
        rest, _ = self._process.communicate(timeout=DEADLINE_S)
        assert self._process.returncode == (0 if how == signal.SIGINT else -how), rest
        return rest


@contextmanager
def running(*words: str) -> Iterator[Running]:
    """Runs `modcube WORDS`; kills it at the end with all its children, unless they have ended."""
    process = subprocess.Popen([*MODCUBE, *words], stdout=subprocess.PIPE, text=True, start_new_session=True)

    def kill() -> None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)

    deadline = threading.Timer(DEADLINE_S, kill)
    deadline.start()
    try:
        yield Running(process)
    finally:
        deadline.cancel()
        kill()
        process.communicate()
