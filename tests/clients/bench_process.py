"""The flying bench as a process that a test starts, waits for and stops."""

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
CLIENT_PYTHON = ROOT / ".venv-clients" / "bin" / "python"
STOP_S = 60


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class FlyingBench:
    """A flying bench, and its measurements once it has landed."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "tests.clients.flying_bench", *arguments]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.summary: dict[str, dict[str, float]] = {}

    def wait_until_it_swims(self) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n", "the bench did not start"

    def land(self) -> dict[str, Any]:
        """Ends the flight; returns the errors of each mode."""
        try:
            output, _ = self._process.communicate(timeout=STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            raise
        assert self._process.returncode == 0
        return dict(json.loads(output.splitlines()[-1]))

    def stop(self) -> None:
        """Ends the process, however the test went. It lands by itself when its input is closed."""
        if self._process.poll() is None:
            self.land()


@contextmanager
def flying_bench(*arguments: str) -> Iterator[FlyingBench]:
    bench = FlyingBench(*arguments)
    try:
        bench.wait_until_it_swims()
        yield bench
    finally:
        bench.stop()
