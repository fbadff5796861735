"""Commands of `modcube` as processes of their own, which end by a deadline, and with the test, however it goes."""

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
"""Longest that a process may take on a machine that is busy with other tests."""


def free_group() -> str:
    """A multicast address that nobody else on this machine uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"udp:239.74.163.9:{probe.getsockname()[1]}"


class Running:
    """A command that runs, in a session of its own."""

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
        """Sends the signal. Returns what else was said, when nobody is left who could say more."""
        self._process.send_signal(how)
        rest, _ = self._process.communicate(timeout=DEADLINE_S)
        assert self._process.returncode == (0 if how == signal.SIGINT else -how), rest
        return rest


@contextmanager
def running(*words: str) -> Iterator[Running]:
    """`modcube WORDS`, killed at the end with all that it started, unless it has ended."""
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
