"""MAVProxy flies the robot in its tank under ArduSub's identity, with the commands that a person types."""

import os
import re
import selectors
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_py.description.parameters import Parameters, registry
from tests.clients.bench_process import CLIENT_PYTHON, flying_bench, free_port

pytestmark = [pytest.mark.clients, pytest.mark.slow]

MISSION = """QGC WPL 110
0\t1\t0\t16\t0\t0\t0\t0\t30.2084\t120.1614\t0\t1
1\t0\t3\t16\t0\t0\t0\t0\t30.208401\t120.161401\t-0.35\t1
2\t0\t3\t16\t0\t0\t0\t0\t30.2084\t120.1614\t-0.38\t1
"""
PATIENCE_S = 60.0


class MavProxy:
    """A person at MAVProxy's prompt: types commands and reads until the answer appears."""

    def __init__(self, port: int, home: Path) -> None:
        command = [
            str(CLIENT_PYTHON), "-u", str(CLIENT_PYTHON.with_name("mavproxy.py")), f"--master=udpin:127.0.0.1:{port}",
            f"--state-basedir={home}", "--source-system=255",
        ]  # fmt: skip
        environment = {**os.environ, "HOME": str(home), "PYTHONWARNINGS": "ignore"}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment, cwd=home
        )
        self._text = ""

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode() + b"\n")
        self._process.stdin.flush()

    def read(self, pattern: str) -> re.Match[str]:
        """Reads until `pattern` appears; the text before it is discarded."""
        assert self._process.stdout is not None
        end = time.monotonic() + PATIENCE_S
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while (found := re.search(pattern, self._text)) is None:
                assert selector.select(end - time.monotonic()), f"no {pattern!r} in {self._text[-2000:]}"
                data = os.read(self._process.stdout.fileno(), 65536)
                assert data, f"MAVProxy ended: {self._text[-2000:]}"
                self._text += data.decode(errors="replace")
        self._text = self._text[found.end() :]
        return found

    def ask(self, line: str, pattern: str) -> re.Match[str]:
        self.type(line)
        return self.read(pattern)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


@pytest.fixture
def mavproxy(tmp_path: Path) -> Iterator[MavProxy]:
    port = free_port()
    with flying_bench(f"udpout:127.0.0.1:{port}", "--identity", "ardusub"):
        client = MavProxy(port, tmp_path)
        try:
            yield client
        finally:
            client.close()


def test_mavproxy_flies_the_robot(mavproxy: MavProxy, tmp_path: Path) -> None:
    exposed = sum(bool(limits.mavlink) for _, limits in registry())
    mission = tmp_path / "mission.txt"
    mission.write_text(MISSION)
    mavproxy.read(r"Mode POSHOLD")
    # MAVProxy requests all parameters by itself; one is fetched by hand too
    mavproxy.read(rf"Received {exposed} parameters")
    fetched = mavproxy.ask("param fetch POS_BW", r"POS_BW = (\S+)")
    assert float(fetched[1]) == pytest.approx(Parameters().control.position_bandwidth)
    mavproxy.type("param set POS_BW 2.7")  # prints nothing on success
    while float(mavproxy.ask("param fetch POS_BW", r"POS_BW = (\S+)")[1]) != pytest.approx(2.7):
        pass
    mavproxy.ask("arm throttle", r"ARMED POSHOLD")
    mavproxy.ask(f"wp load {mission}", r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED")
    mavproxy.ask("wp list", r"16 6 30\.2084010000 120\.1614010000 -0\.350000")
    mavproxy.ask("mode MANUAL", r"ARMED POSHOLD -> ARMED MANUAL|Mode MANUAL")
    mavproxy.type("rc 5 1550")
    mavproxy.ask("mode ALT_HOLD", r"Mode ALT_HOLD")
    mavproxy.ask("mode POSHOLD", r"Mode POSHOLD")
    mavproxy.ask("mode AUTO", r"waypoint 2|Mode AUTO")
    mavproxy.read(r"mission complete")
    mavproxy.ask("disarm", r"DISARMED")
