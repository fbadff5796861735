"""A run of the vehicle's process on a bus where nobody answers, and what it leaves in its folder."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

from firmware_py.app.vehicle import run_vehicle
from firmware_py.description.fleet import Fleet, single
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG

LOGS = (CAN_LOG, SIGNAL_LOG)


def bus_of(path: Path) -> str:
    """A bus of this test's own."""
    return f"virtual:{path.name}"


def fly(
    tmp_path: Path, out: Path | None = None, then: Callable[[], None] = lambda: None, parameters: Parameters | None = None,
    fleet: Fleet | None = None, hold: bool = False, ending: signal.Signals = signal.SIGTERM,
) -> list[str]:  # fmt: skip
    """Starts, and asks for the end in the first tick. `then` is done by whoever says so. Returns what was said."""
    said: list[str] = []

    def say(line: str) -> None:
        said.append(line)
        if line.startswith("running at"):
            os.kill(os.getpid(), ending)
            then()

    run_vehicle(fleet or single(bus=bus_of(tmp_path)), parameters or Parameters(), hold=hold, out=out, say=say)
    return said


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
