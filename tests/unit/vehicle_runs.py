"""Runs of the vehicle's process on a bus where no module answers, and the files that they leave."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

from firmware_py.app.vehicle_process import run_vehicle
from firmware_py.description.fleet import Fleet, single
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.notify import Notifier
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG

LOGS = (CAN_LOG, SIGNAL_LOG)


def bus_of(path: Path) -> str:
    """Address of a bus that only this test uses."""
    return f"virtual:{path.name}"


def fly(
    tmp_path: Path, out: Path | None = None, then: Callable[[], None] = lambda: None, parameters: Parameters | None = None,
    fleet: Fleet | None = None, hold: bool = False, ending: signal.Signals = signal.SIGTERM, notifier: Notifier | None = None,
) -> list[str]:  # fmt: skip
    """Runs the process and signals its end as soon as it says that it runs; `then` runs in the thread that says so. Returns the lines."""
    said: list[str] = []

    def say(line: str) -> None:
        said.append(line)
        if line.startswith("running at"):
            os.kill(os.getpid(), ending)
            then()

    run_vehicle(fleet or single(bus=bus_of(tmp_path)), parameters or Parameters(), hold=hold, out=out, say=say, notifier=notifier)
    return said


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
