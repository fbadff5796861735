"""The vehicle's process from outside: how soon it flies, how soon again when it was killed, how much memory it takes.

Beside other tests only its own processor time is held to the limits; with MODCUBE_FULL=1 (`make accept`) the clock's.
"""

import os
import signal
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.closed_loop.processes import free_group, running
from tests.figures import figure

READY_S = 3.0
BACK_S = 4.0
MEMORY_MB = 250.0
RESTART_S = 0.2
"""RestartSec of modcube.service."""
FULL = "MODCUBE_FULL" in os.environ
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Start(NamedTuple):
    """What it took until the vehicle was armed and held its place."""

    clock_s: float
    processor_s: float

    @property
    def counted_s(self) -> float:
        return self.clock_s if FULL else self.processor_s


def fly(bus: str, out: Path, how: signal.Signals) -> tuple[Start, float]:
    """Starts the vehicle, whose compiled code the plant has cached, and ends it once it holds its place; its peak of memory, MB."""
    began = time.monotonic()
    with running("run", "--bus", bus, "--hold", "--out", str(out), "--ground", "udpin:127.0.0.1:0") as vehicle:
        vehicle.wait_for("-> ARMED POSHOLD")
        clock_s, proc = time.monotonic() - began, Path(f"/proc/{vehicle.pid}")
        times = proc.joinpath("stat").read_text().rpartition(")")[2].split()
        peak_kb = proc.joinpath("status").read_text().partition("VmHWM:")[2].split()[0]
        vehicle.end(how)
    return Start(clock_s, (int(times[11]) + int(times[12])) / TICKS_PER_S), int(peak_kb) / 1024


@pytest.mark.slow
def test_vehicle_is_soon_armed_and_soon_back_when_killed_and_stays_small(tmp_path: Path) -> None:
    bus = free_group()
    with running("hil", "plant", "hover", "--bus", bus) as plant:
        plant.wait_for("plant of hover")
        first, _ = fly(bus, tmp_path / "first", signal.SIGKILL)
        again, memory_mb = fly(bus, tmp_path / "again", signal.SIGINT)
        plant.end()
    figure("vehicle's process, warm cache: armed and holding after", first.clock_s, "s")
    figure("vehicle's process, killed: armed and holding again after", again.clock_s + RESTART_S, "s")
    figure("vehicle's process: peak of memory", memory_mb, "MB")
    assert memory_mb < MEMORY_MB
    assert first.counted_s <= READY_S
    assert again.counted_s + RESTART_S <= BACK_S
