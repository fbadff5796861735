"""tune_gains --live against a robot that flies in its tank: one confirmed step at a time, and the old values back whatever happens."""

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from firmware_py.description.parameters import Parameters
from tests.clients.bench_process import ROOT, flying_bench, free_port

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil

PATIENCE_S = 180.0
ARM, SET_MODE, TERMINATE, HOLD = 400, 176, 185, (1, 4, 3)
SHIPPED = {"POS_BW": Parameters().control.position_bandwidth, "POS_DAMP": Parameters().control.position_damping}
OBJECTIVE = """
help = "place alone"
flight = [{ scenario = "hover" }]
seeds = [0]
unseen_seeds = [1]
search = [
    { parameter = "control.position_bandwidth", low = 0.5, high = 8.0 },
    { parameter = "control.position_damping", low = 0.3, high = 3.0 },
]
term = [{ metric = "position_rmse_m", per = 0.001 }, { metric = "thrust_rms_n", per = 1.0 }]
"""

pytestmark = pytest.mark.slow


class Pilot:
    """Somebody else at another link of the same robot."""

    def __init__(self, port: int) -> None:
        self._link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", dialect="all")

    def close(self) -> None:
        self._link.close()

    def wait(self, name: str, fits: Any = lambda message: True) -> Any:
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            message = self._link.recv_match(type=name, blocking=True, timeout=1.0)
            if message is not None and fits(message):
                return message
        raise TimeoutError(name)

    def command(self, number: int, *values: float) -> None:
        self._link.mav.command_long_send(1, 1, number, 0, *values, *[float("nan")] * (7 - len(values)))
        assert self.wait("COMMAND_ACK", lambda m: m.command == number).result == 0

    def hover(self) -> None:
        """Armed, holding its place."""
        self.wait("SYS_STATUS", lambda m: m.onboard_control_sensors_health & 0x10000000)
        self.command(ARM, 1)
        self.command(SET_MODE, *HOLD)
        self.wait("HEARTBEAT", lambda m: m.system_status == 4)

    def sees(self, name: str, value: float) -> None:
        """Somebody has set it: the vehicle tells everybody."""
        self.wait("PARAM_VALUE", lambda m: m.param_id == name and m.param_value == value)

    def parameters(self) -> dict[str, float]:
        found = {}
        for name in SHIPPED:
            self._link.mav.param_request_read_send(1, 1, name.encode(), -1)
            found[name] = self.wait("PARAM_VALUE", lambda m, n=name: m.param_id == n).param_value
        return found


class Tuner:
    """tune_gains --live as a person sees it."""

    def __init__(self, port: int, folder: Path) -> None:
        (folder / "objective.toml").write_text(OBJECTIVE)
        command = [sys.executable, "-u", str(ROOT / "tools/tune_gains.py"), str(folder / "objective.toml")]
        self.process = subprocess.Popen(
            [*command, "--live", f"mavlink:udpin:127.0.0.1:{port}", "--seconds", "2", "--out", str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        self.text = ""

    def read_until(self, words: str) -> None:
        """Until the program has said so; what it said before is forgotten."""
        assert self.process.stdout is not None
        end = time.monotonic() + PATIENCE_S
        while words not in self.text:
            assert time.monotonic() < end, self.text
            if select.select([self.process.stdout], [], [], 1.0)[0]:
                piece = os.read(self.process.stdout.fileno(), 4096).decode()
                assert piece, f"ended: {self.text}"
                self.text += piece
        self.text = self.text.partition(words)[2]

    def type(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def end(self) -> tuple[int, str]:
        """Its status, and the rest of what it said."""
        rest, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, self.text + rest.decode()

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="module")
def robot() -> Iterator[tuple[Pilot, int]]:
    """A robot that hovers, somebody who flies it, and the port for the tuner."""
    mine, theirs = free_port(), free_port()
    with flying_bench(f"udpout:127.0.0.1:{mine}", f"udpout:127.0.0.1:{theirs}", "--pace", "4"), closing(Pilot(mine)) as pilot:
        pilot.hover()
        yield pilot, theirs


@pytest.fixture
def pilot(robot: tuple[Pilot, int]) -> Pilot:
    return robot[0]


@pytest.fixture
def tuner(robot: tuple[Pilot, int], tmp_path: Path) -> Iterator[Tuner]:
    """The tuner at its first question; everything is as shipped."""
    with closing(Tuner(robot[1], tmp_path)) as tuner:
        tuner.read_until("step 1: POS_BW 2.5 -> 3.125? [y/n/q]")
        assert robot[0].parameters() == pytest.approx(SHIPPED)
        yield tuner


def test_step_is_taken_when_it_is_confirmed_and_all_is_as_before_when_nothing_is_kept(pilot: Pilot, tuner: Tuner) -> None:
    tuner.type("n")
    tuner.read_until("step 2: POS_BW 2.5 -> 2? [y/n/q]")
    tuner.type("y")
    pilot.sees("POS_BW", 2.0)
    tuner.read_until("step 3:")
    tuner.type("q")
    tuner.read_until("? [y/n]")
    tuner.type("n")
    status, said = tuner.end()
    assert status == 0 and "old values are back: POS_BW 2.5, POS_DAMP 1" in said
    assert pilot.parameters() == pytest.approx(SHIPPED)


def test_interrupt_puts_the_old_values_back(pilot: Pilot, tuner: Tuner, tmp_path: Path) -> None:
    tuner.type("y")
    pilot.sees("POS_BW", 3.125)
    tuner.process.send_signal(signal.SIGINT)
    status, said = tuner.end()
    assert status == 1 and "interrupted" in said and "old values are back" in said
    assert pilot.parameters() == pytest.approx(SHIPPED)
    assert not (tmp_path / "live-before.json").exists()


def test_tuner_that_was_killed_puts_the_old_values_back_when_it_is_started_again(
    robot: tuple[Pilot, int], tuner: Tuner, tmp_path: Path
) -> None:
    tuner.type("y")
    robot[0].sees("POS_BW", 3.125)
    tuner.close()
    with closing(Tuner(robot[1], tmp_path)) as again:
        again.read_until("old values are back: POS_BW 2.5, POS_DAMP 1")
    assert robot[0].parameters() == pytest.approx(SHIPPED)


def test_e_stop_puts_the_old_values_back(pilot: Pilot, tuner: Tuner) -> None:
    """The last one: the robot is stopped after it."""
    tuner.type("y")
    pilot.sees("POS_BW", 3.125)
    pilot.command(TERMINATE, 1)
    status, said = tuner.end()
    assert status == 1 and ("stopped, or in an emergency" in said or "the vehicle says" in said)
    assert "old values are back" in said
    assert pilot.parameters() == pytest.approx(SHIPPED)
